"""The look of all plots: colours, style, and how a figure is made and saved."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from benchmarks.lib.storage import replacing

# Okabe and Ito's colours, which colour-blind readers can tell apart; then darker ones of them.
COLOURS = (
    "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000",
    "#004B77", "#8A3D00", "#00664B", "#8F4A72",
)  # fmt: skip
STYLE: Any = {
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "figure.constrained_layout.use": True,
    "figure.dpi": 110,
    "grid.alpha": 0.3,
    "legend.frameon": False,
}


def colours(names: Sequence[str]) -> dict[str, str]:
    """Give each name a colour; the same names in the same order get the same ones."""
    return {name: COLOURS[i % len(COLOURS)] for i, name in enumerate(names)}


@contextmanager
def drawn(path: Path, width: float, height: float, *, grid: bool = True) -> Iterator[Figure]:
    """Give a figure of this size, inches, to draw on, and write it, whole or not at all."""
    with mpl.rc_context(STYLE | {"axes.grid": grid}):
        figure = Figure(figsize=(width, height))
        yield figure
        with replacing(path) as partial:
            figure.savefig(partial)
