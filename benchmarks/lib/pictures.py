"""Make the pictures of reports in one style.

A picture is 975 pixels wide, and has text that is still readable when a page shows the picture
750 pixels wide. A picture has a white background with a margin, so that the picture is readable
on a dark page, too. The title of a picture is a sentence that states the main result in the
picture.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH = 7.5  # width of a picture, inches: 975 pixels at 130 dots per inch
TITLE_CHARACTERS = 90  # number of characters that fit in a line of a title
PALETTE_SIZE = 128  # number of colours in a PNG file; fewer colours make the file smaller
# matplotlib's `rcParams` for all pictures.
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
    "text.parse_math": False,  # The name of a user's controller may contain a dollar sign.
}

# Arguments of matplotlib's functions that draw the set point, the dead zone of the actuator,
# and the limits of the actuator over time.
SETPOINT: Any = {"color": "black", "linestyle": "--", "linewidth": 0.8}
DEAD_ZONE: Any = {"color": "0.5", "alpha": 0.2, "linewidth": 0}
LIMIT: Any = {"color": "0.4", "linestyle": ":", "linewidth": 1.0}

# The signs for "at most" and "at least" at the ticks of an axis.
AT_MOST = "\N{LESS-THAN OR EQUAL TO}"
AT_LEAST = "\N{GREATER-THAN OR EQUAL TO}"

RATIO_LABEL = (
    "error ratio: mean error / least possible error\n(axis logarithmic in the ratio minus 1)"
)
# The smallest error ratio on the axis; smaller error ratios are drawn at `RATIO_FLOOR`. An
# error ratio of 1 would lie at minus infinity on an axis that is logarithmic in the error ratio
# minus 1.
RATIO_FLOOR = 1.001
# Error ratios with a label on the axis of error ratios, about equally far apart.
RATIO_TICKS = 1.001, 1.003, 1.01, 1.03, 1.1, 1.3, 2.0, 4.0, 11.0, 31.0


def percent(share: float) -> str:
    """Return a share from 0 to 1 as text in whole percent, such as "5 %" for 0.05."""
    return f"{100.0 * share:.0f} %"


@contextmanager
def open_picture(path: Path, height: float, title: str) -> Iterator[Figure]:
    """Yield a figure with a title, for use in a `with` statement: `with open_picture(...)`.

    The figure is saved as a PNG file when the block of the `with` statement ends without an
    error.

    Parameters
    ----------
    path : Path
        The PNG file.
    height : float
        Height of the picture, inches. The width is `WIDTH`.
    title : str
        A sentence above the picture, broken into lines of at most `TITLE_CHARACTERS`
        characters.
    """
    from matplotlib import rc_context  # imported here, as the import is slow
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from PIL import Image

    with rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, height))
        sentence = title[0].upper() + title[1:]
        lines = textwrap.wrap(sentence, TITLE_CHARACTERS, break_on_hyphens=False)
        figure.suptitle("\n".join(lines), x=0.015, ha="left", fontsize=10, weight="bold")
        yield figure
        canvas: Any = FigureCanvasAgg(figure)
        canvas.draw()  # `Figure.savefig` would draw twice because of the layout.
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    picture.quantize(PALETTE_SIZE, Image.Quantize.FASTOCTREE).save(path)


def excess(ratios: ArrayLike) -> NDArray[np.float64]:
    """Return error ratios minus 1, an array of the shape of `ratios`, for a logarithmic axis.

    Error ratios below `RATIO_FLOOR` are replaced by `RATIO_FLOOR`, so that all results are
    positive.
    """
    return np.maximum(ratios, RATIO_FLOOR) - 1.0


def scale_by_ratio(axes: Axes, ratios: ArrayLike) -> None:
    """Make the y axis of a panel logarithmic in the error ratio minus 1, with ratios as ticks.

    The ends of the axis follow from `ratios`, which are all error ratios in the panel. If an
    error ratio is below `RATIO_FLOOR`, the label of the lowest tick begins with the sign
    `AT_MOST`.
    """
    from matplotlib.ticker import NullLocator

    heights = excess(ratios)
    labels = [f"{ratio:g}" for ratio in RATIO_TICKS]
    if np.min(ratios) < RATIO_FLOOR:
        labels[0] = f"{AT_MOST} {labels[0]}"
    axes.set_yscale("log")
    axes.set_yticks(excess(RATIO_TICKS), labels)
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set_ylim(heights.min() / 1.4, heights.max() * 1.4)
