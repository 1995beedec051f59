"""Reads a log."""
from __future__ import annotations
from dataclasses import dataclass, field
import numpy as np
from numpy.typing import NDArray
Array = NDArray[np.float64]

@dataclass(frozen=True)
class Log:
    flow: Array
    temperature: Array
    sampling_interval: float
    notes: list[str] = field(default_factory=list)
