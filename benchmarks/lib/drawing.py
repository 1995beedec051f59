"""Make and save all figures in one style: white, 750 pixels wide on a page, few colours."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator
from PIL import Image

from benchmarks.lib.storage import replacing

# Okabe and Ito's palette for colour-blind readers, for lines that stand for no controller.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
WIDTH = 7.5  # of every figure, inches
SHADES = 128  # colours of a picture, which make it small
MULTIPLE = "multiple of the least possible\n(log scale of the excess over 1)"
NEAREST = 1e-3  # excess over the least possible error at which a logarithmic axis begins
EXCESSES = (0.001, 0.01, 0.1, 0.5, 1.0, 4.0, 9.0, 29.0)
STYLE: Any = {
    "axes.grid": True,
    "axes.labelsize": "medium",
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": "medium",
    "figure.constrained_layout.h_pad": 0.08,  # inches; a margin, for pages that are dark
    "figure.constrained_layout.use": True,
    "figure.constrained_layout.w_pad": 0.08,
    "figure.dpi": 130,
    "font.size": 9,
    "grid.alpha": 0.3,
    "legend.frameon": False,
}


@contextmanager
def drawn(path: Path, height: float, title: str = "", *, grid: bool = True) -> Iterator[Figure]:
    """Yield a figure of a height in inches, and save it, completely or not at all.

    The title says what the figure shows.
    """
    with mpl.rc_context(STYLE | {"axes.grid": grid}):
        figure = Figure(figsize=(WIDTH, height))
        if title:
            lines = textwrap.fill(title[0].upper() + title[1:], 86)
            figure.suptitle(lines, x=0.01, ha="left", fontsize=10, weight="bold")
        yield figure
        canvas: Any = FigureCanvasAgg(figure)
        canvas.draw()
        picture = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
        with replacing(path) as partial:
            # Without dithering, areas stay even and the file small.
            few = picture.quantize(SHADES, dither=Image.Dither.NONE)
            few.save(partial, optimize=True)


@contextmanager
def panels(
    path: Path,
    names: Sequence[str],
    height: float,
    columns: int,
    title: str = "",
    *,
    grid: bool = True,
) -> Iterator[tuple[Figure, list[Axes], list[Axes]]]:
    """Yield a figure with a panel of a height in inches for each name, and save it.

    Then come the panels, and places in the last row that are free for a legend.
    """
    columns = min(columns, len(names))
    rows = math.ceil(len(names) / columns)
    with drawn(path, height * rows + 0.9, title, grid=grid) as figure:
        axes = list(figure.subplots(rows, columns, squeeze=False).flat)
        for panel, name in zip(axes, names, strict=False):
            panel.set_title(name)
        for panel in axes[len(names) :]:
            panel.set_axis_off()
        yield figure, axes[: len(names)], axes[len(names) :]


def draw_legend(figure: Figure, free: Sequence[Axes], entries: dict[str, Any]) -> None:
    """Put a legend of handles by label in a free place, or else below the panels."""
    if free:
        columns = 1 + (len(entries) > 7)
        legend = free[0].legend(entries.values(), entries, loc="center left", ncols=columns)
        legend.set_in_layout(len(free) < 2)  # with room beside it, it may be wider than a panel
    elif entries:
        figure.legend(entries.values(), entries, loc="outside lower center", ncols=4)


def scale_by_excess(axes: Axes, name: str, low: float, high: float) -> None:
    """Make the axis "x" or "y" of `multiple - 1` logarithmic, with multiples as its ticks."""
    axes.set(**{f"{name}scale": "log", f"{name}lim": (low / 1.3, high * 1.3)})
    axis = getattr(axes, f"{name}axis")
    axis.set_major_locator(FixedLocator(EXCESSES))
    axis.set_major_formatter(lambda excess, _: f"{1 + excess:g}")
    axis.set_minor_locator(NullLocator())


def draw_actuator(axes: Axes, parameters: Any) -> None:
    """Shade the dead zone and mark the limits of a plant's `Parameters`, t/h.

    Where they are drawn from ranges, these are the smallest dead zone and the widest limits.
    """
    zone, _ = parameters.range_of("dead_zone")
    axes.axhspan(-zone, zone, color="0.5", alpha=0.15, linewidth=0, label="dead zone")
    for limit in (parameters.range_of("u_min")[0], parameters.range_of("u_max")[1]):
        axes.axhline(limit, color="0.4", linestyle=":", linewidth=1)
