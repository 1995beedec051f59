"""Make the pictures of reports in one style.

A picture is 975 pixels wide, readable when a page shows it at 750, and stands on a white
background with a margin, so that it can also be read on a dark page. Its title is a sentence
that says what the picture shows.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = "#0072B2", "#D55E00"  # of lines that stand for no controller
WIDTH = 7.5  # of a picture, inches
TITLE_CHARACTERS = 90  # on a line of a title
PALETTE = 128  # colours of a saved picture; fewer make the file smaller
STYLE: Any = {
    "axes.grid": True,
    "axes.titlelocation": "left",
    "axes.titlesize": "medium",
    "figure.constrained_layout.h_pad": 0.08,  # inches; the default lets text touch the edge
    "figure.constrained_layout.use": True,
    "figure.constrained_layout.w_pad": 0.1,
    "figure.dpi": 130,
    "figure.facecolor": "white",
    "font.size": 9,
    "grid.alpha": 0.3,
    "legend.frameon": False,
    "text.parse_math": False,  # a user's name of a controller may contain a dollar sign
}

# How a set point, an actuator's dead zone and its limits are drawn over time.
SETPOINT: Any = {"color": "black", "linestyle": "--", "linewidth": 0.8}
DEAD_ZONE: Any = {"color": "0.5", "alpha": 0.2, "linewidth": 0}
LIMIT: Any = {"color": "0.4", "linestyle": ":", "linewidth": 1.0}

RATIO_LABEL = "error / least possible error\n(axis logarithmic in the ratio minus 1)"
RATIO_FLOOR = 1.001  # Smaller ratios cannot be shown on a logarithmic axis: they stand here.
RATIO_TICKS = 1.001, 1.003, 1.01, 1.03, 1.1, 1.3, 2.0, 4.0, 11.0, 31.0


def percent(share: float) -> str:
    """Return a share as text in whole percent, such as "5 %"."""
    return f"{100.0 * share:.0f} %"


@contextmanager
def open_picture(path: Path, height: float, title: str) -> Iterator[Figure]:
    """Yield an empty figure, and save it as a PNG file when the block ends without an error.

    Parameters
    ----------
    path : Path
        The file.
    height : float
        Height of the picture, inches. The width is `WIDTH`.
    title : str
        A sentence, which is broken into lines.
    """
    from matplotlib import rc_context  # imported here, as it is slow
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from PIL import Image

    with rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, height))
        sentence = textwrap.fill(title[0].upper() + title[1:], TITLE_CHARACTERS)
        figure.suptitle(sentence, x=0.015, ha="left", fontsize=10, weight="bold")
        yield figure
        canvas: Any = FigureCanvasAgg(figure)
        canvas.draw()  # `Figure.savefig` would draw twice because of the layout.
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    picture.quantize(PALETTE, Image.Quantize.FASTOCTREE).save(path)


@dataclass(frozen=True)
class Panels:
    """A figure with a panel for each of several names, in rows.

    Attributes
    ----------
    figure : Figure
        The figure.
    axes : sequence of Axes
        The panels, one for each name.
    unused : sequence of Axes
        The empty places at the end of the last row.
    columns : int
        Number of panels in a full row.
    """

    figure: Figure
    axes: Sequence[Axes]
    unused: Sequence[Axes]
    columns: int

    def label_edges(self, x: str, y: str) -> None:
        """Name the axes: `y` at the left of each row, `x` below each column."""
        for panel in self.axes[:: self.columns]:
            panel.set_ylabel(y)
        for panel in self.axes[-self.columns :]:
            panel.set_xlabel(x)

    def add_legend(self, entries: Mapping[str, Artist], columns: int) -> None:
        """Put a legend in the unused places of the last row, or else below all panels.

        `entries` has an artist for each text. A legend below the panels has `columns` columns.
        """
        handles = list(entries.values())
        texts = list(entries)
        if self.unused:
            legend = self.unused[0].legend(handles, texts, loc="center left")
            legend.set_in_layout(False)  # It may be wider than a panel.
            return
        self.figure.legend(handles, texts, loc="outside lower center", ncols=columns)


@contextmanager
def open_panels(
    path: Path, names: Sequence[str], height: float, columns: int, title: str
) -> Iterator[Panels]:
    """Yield a figure with a panel for each name, and save it as `open_picture` does.

    Parameters
    ----------
    path : Path
        The PNG file.
    names : sequence of str
        Headings of the panels.
    height : float
        Height of a panel, inches.
    columns : int
        Number of panels in a full row.
    title : str
        A sentence.
    """
    columns = min(columns, len(names))
    rows = math.ceil(len(names) / columns)
    with open_picture(path, height * rows + 1.2, title) as figure:
        places = list(figure.subplots(rows, columns, squeeze=False).flat)
        axes = places[: len(names)]
        unused = places[len(names) :]
        for panel, name in zip(axes, names, strict=True):
            panel.set_title(name)
        for panel in unused:
            panel.set_axis_off()
        yield Panels(figure, axes, unused, columns)


def excess(ratios: ArrayLike) -> NDArray[np.float64]:
    """Return `ratio - 1`, at least that of `RATIO_FLOOR`, to be drawn on a logarithmic axis."""
    return np.maximum(ratios, RATIO_FLOOR) - 1.0


def scale_by_ratio(axes: Axes, direction: Literal["x", "y"], ratios: ArrayLike) -> None:
    """Make an axis of `excess(ratios)` logarithmic, with ratios as the labels of its ticks.

    The axis is as long as the ratios need. If one of them is below `RATIO_FLOOR`, the label
    of the lowest tick says that marks at this tick stand for smaller ratios, too.
    """
    from matplotlib import ticker

    values = excess(ratios)
    labels = [f"{ratio:g}" for ratio in RATIO_TICKS]
    if np.min(ratios) < RATIO_FLOOR:
        labels[0] = f"< {labels[0]}"
    limits = (values.min() / 1.4, values.max() * 1.4)
    axes.set(**{f"{direction}scale": "log", f"{direction}lim": limits})
    axis = getattr(axes, f"{direction}axis")
    axis.set_major_locator(ticker.FixedLocator([ratio - 1.0 for ratio in RATIO_TICKS]))
    axis.set_major_formatter(ticker.FixedFormatter(labels))
    axis.set_minor_locator(ticker.NullLocator())
