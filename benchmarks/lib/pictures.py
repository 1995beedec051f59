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

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH = 7.5  # width of a picture, inches: 975 pixels at 130 dots per inch
TITLE_CHARACTERS = 90  # number of characters that fit in a line of a title
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
    from matplotlib import style  # imported here, as the import is slow
    from matplotlib.figure import Figure

    # A matplotlibrc of the caller, which may ask for LaTeX, has no influence on the picture.
    with style.context(["default", STYLE]):
        figure = Figure(figsize=(WIDTH, height))
        sentence = title[0].upper() + title[1:]
        lines = textwrap.wrap(sentence, TITLE_CHARACTERS, break_on_hyphens=False)
        figure.suptitle("\n".join(lines), x=0.015, ha="left", fontsize=10, weight="bold")
        yield figure
        figure.savefig(path)
