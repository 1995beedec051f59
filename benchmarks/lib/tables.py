"""Tables on the screen, and percentiles over runs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.table import Table

PERCENTILES = {"median": 50, "p10": 10, "p90": 90}
_NAMES = ("scenario", "agent", "controller", "case")
_TEXTS = (*_NAMES, "claim", "verdict", "question", "command", "page")


def percentiles(values: NDArray[np.float64], method: str = "linear") -> dict[str, Any]:
    """Return median, 10th and 90th percentile along the last axis.

    Nothing can be interpolated where a value is infinite ("not settled"). The next higher value
    is taken there.
    """
    method = method if np.isfinite(values).all() else "higher"
    return {
        name: np.percentile(values, percentile, axis=-1, method=method)  # type: ignore[call-overload]
        for name, percentile in PERCENTILES.items()
    }


def on_screen(table: pd.DataFrame) -> Table:
    """Return a table of text for the terminal."""
    screen = Table(box=SIMPLE_HEAD)
    for name in table.columns:
        screen.add_column(
            name, justify="left" if name in _TEXTS else "right", no_wrap=name in _NAMES
        )
    for row in table.itertuples(index=False):
        screen.add_row(*row)
    return screen
