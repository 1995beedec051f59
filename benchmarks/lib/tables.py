"""Write tables to files and to the terminal, and take percentiles over runs."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table

from benchmarks.lib.storage import replacing

PERCENTILES = {"median": 50, "p10": 10, "p90": 90}
ROOMY = 120  # columns of a terminal in which intervals have room
_INTERVAL = re.compile(r"^(\S+) \([^()]* to [^()]*\)$")
_HYPHEN = re.compile(r"(?<=\w)-(?=[a-z])")
_NAMES = ("scenario", "agent", "controller", "case")
_SENTENCES = ("claim", "verdict")
_TEXTS = (*_NAMES, *_SENTENCES)
EDGES = 3  # columns around each column of a table


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


@dataclass(frozen=True)
class ScreenTable:
    """A table of text for a terminal, which cuts and breaks no cell.

    In a narrow one it has no intervals, and comes in parts if there are too many columns.
    """

    table: pd.DataFrame

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield the parts that fit."""
        table = self.table
        if options.max_width < ROOMY:
            table = table.replace(_INTERVAL, r"\1", regex=True)
            table = table.rename(columns=lambda name: _HYPHEN.sub("- ", name))
        widths = [  # headings may break between words
            20 if name in _SENTENCES else max(map(len, [*str(name).split(), *cells]), default=0)
            for name, cells in table.items()
        ]
        start = 1
        while start < len(widths) or start == 1:
            stop, left = start, options.max_width - 1 - widths[0] - EDGES
            while stop < len(widths) and (left >= widths[stop] + EDGES or stop == start):
                left -= widths[stop] + EDGES
                stop += 1
            screen = Table(box=SIMPLE_HEAD)
            for i in (0, *range(start, stop)):
                name = str(table.columns[i])
                side: Literal["left", "right"] = "left" if name in _TEXTS else "right"
                width = None if name in _SENTENCES else widths[i]
                screen.add_column(name, justify=side, width=width)
            for row in table.itertuples(index=False):
                screen.add_row(row[0], *row[start:stop])
            yield screen
            start = max(stop, start + 1)
