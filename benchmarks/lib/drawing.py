"""Make and save all figures in one style and one palette."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.lib.storage import replacing

# Okabe and Ito's palette for colour-blind readers, then darker shades of it.
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
    """Return a colour for each name; the same names in the same order get the same colours."""
    return {name: COLOURS[i % len(COLOURS)] for i, name in enumerate(names)}


@contextmanager
def drawn(path: Path, width: float, height: float, *, grid: bool = True) -> Iterator[Figure]:
    """Yield a figure of this size, in inches, and save it, completely or not at all."""
    with mpl.rc_context(STYLE | {"axes.grid": grid}):
        figure = Figure(figsize=(width, height))
        yield figure
        with replacing(path) as partial:
            figure.savefig(partial)


@contextmanager
def panels(
    path: Path,
    names: Sequence[str],
    size: tuple[float, float],
    columns: int,
    margin: tuple[float, float] = (0.0, 0.0),
    *,
    grid: bool = True,
) -> Iterator[tuple[Figure, list[Axes]]]:
    """Yield a figure with one panel per name, and save it.

    The size of a panel is in inches, as is the margin at the right and below for shared items.
    """
    columns = min(columns, len(names))
    rows = math.ceil(len(names) / columns)
    width, height = size[0] * columns + margin[0], size[1] * rows + margin[1]
    with drawn(path, width, height, grid=grid) as figure:
        axes = list(figure.subplots(rows, columns, squeeze=False).flat)
        for panel, name in zip(axes, names, strict=False):
            panel.set_title(name, loc="left")
        for panel in axes[len(names) :]:
            panel.set_visible(False)
        yield figure, axes[: len(names)]


def draw_actuator(axes: Axes, parameters: Any) -> None:
    """Shade the dead zone and mark the limits of a plant's `Parameters`, t/h.

    Where they are drawn from ranges, these are the smallest dead zone and the widest limits.
    """
    zone, _ = parameters.range_of("dead_zone")
    axes.axhspan(-zone, zone, color="0.5", alpha=0.15, linewidth=0, label="dead zone")
    for limit in (parameters.range_of("u_min")[0], parameters.range_of("u_max")[1]):
        axes.axhline(limit, color="0.4", linestyle=":", linewidth=1)
