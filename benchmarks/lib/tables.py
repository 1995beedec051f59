"""Write tables to files and to the terminal, and take percentiles over runs."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.table import Table

from benchmarks.lib.storage import replacing

PERCENTILES = {"median": 50, "p10": 10, "p90": 90}
_NAMES = ("scenario", "agent", "controller", "case")
_TEXTS = (*_NAMES, "claim", "verdict")


def write_csv(path: Path, table: pd.DataFrame) -> None:
    """Write a table without its index, completely or not at all, the same on every system."""
    with replacing(path) as partial:
        table.to_csv(partial, index=False, lineterminator="\n")


def percentiles(
    values: NDArray[np.float64], method: Literal["linear", "nearest", "higher"] = "linear"
) -> dict[str, Any]:
    """Return the median, 10th and 90th percentiles along the last axis.

    Infinite values ("not settled") cannot be interpolated. If there are any, the next higher
    value is used.
    """
    method = method if np.isfinite(values).all() else "higher"
    return {
        name: np.percentile(values, percentile, axis=-1, method=method)
        for name, percentile in PERCENTILES.items()
    }


def groups(table: pd.DataFrame, column: str) -> Iterator[tuple[str, pd.DataFrame]]:
    """Yield each name in a column with its rows, in order of first appearance."""
    for name, rows in table.groupby(column, sort=False):
        yield str(name), rows


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
