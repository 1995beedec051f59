"""Write a report as Markdown, and as one HTML page with its pictures; print its tables.

All pictures have one style: white, 750 pixels wide on a page, few colours.
"""

from __future__ import annotations

import base64
import html
import math
import re
import shutil
import textwrap
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from benchmarks.lib.storage import replacing, write_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_HEAD = """\
<!doctype html><html lang="en">
<meta charset="utf-8"><meta name="viewport" content="width=device-width"><style>
:root { color-scheme: light dark; }
body { font-family: sans-serif; max-width: 75rem; margin: 2rem auto; padding: 0 1rem;
       color: light-dark(#222, #ddd); background: light-dark(#fff, #181818); line-height: 1.4; }
table { border-collapse: collapse; font-size: 0.9rem; display: block; overflow-x: auto; }
th, td { padding: 0.25rem 0.7rem; text-align: right; border-bottom: 1px solid #8885; }
th:first-child, td:first-child { text-align: left; }
img { max-width: 100%; }
</style>"""


@dataclass(frozen=True)
class Section:
    """A section of a report. Its texts are plain: nothing in them is read as Markdown."""

    title: str  # "" for none
    text: Sequence[str] = ()  # paragraphs
    table: pd.DataFrame | None = None  # of text
    bold: Collection[str] = ()  # cells that are shown in bold type
    # PNG files in the report's folder, and for each what it shows, in a sentence.
    pictures: Mapping[str, str] = field(default_factory=dict)


def write_report(
    folder: Path,
    title: str,
    sections: Sequence[Section],
    origin: Mapping[str, Any],
    printed: int | None = None,
) -> None:
    """Write `report.md` and `report.html`, and print the first `printed` sections, or all.

    The first line says what is missing, if `origin` has the key "missing"; the last line is the
    time, the commit and the command line.
    """
    unfinished = f"Unfinished: {origin['missing']}." if "missing" in origin else ""
    page = _page(folder, title, sections, origin, unfinished)
    write_text(folder / "report.md", page)
    write_text(folder / "report.html", _html(folder, title, page))
    if unfinished:
        print(unfinished)
    width = shutil.get_terminal_size((150, 24)).columns
    for section in sections[:printed]:
        for text in filter(None, [section.title, *section.text]):
            print(textwrap.fill(text, width))
        if section.table is not None:
            print(on_screen(section.table))


def escape(text: object) -> str:
    """Return Markdown, on one line, that shows a text as it is.

    A text may come from outside: the name of a controller, of a file or of a column. Without
    this it could end a cell of a table, or bring tags and links into the page.
    """
    escaped = " ".join(str(text).split()).replace("\\", "\\\\")
    escaped = escaped.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    escaped = escaped.replace("|", "\\|").replace("](", "]\\(")
    for pair in "*_`":  # which have a meaning if they enclose something
        if escaped.count(pair) > 1:
            escaped = escaped.replace(pair, f"\\{pair}")
    return escaped


def _page(
    folder: Path,
    title: str,
    sections: Sequence[Section],
    origin: Mapping[str, Any],
    unfinished: str,
) -> str:
    """Return a report in Markdown, with the pictures that are in the folder."""
    parts = [f"# {escape(title)}"]
    if unfinished:
        parts.append(f"**{escape(unfinished)}**")
    for section in sections:
        if section.title:
            parts.append(f"## {escape(section.title)}")
        parts += map(escape, section.text)
        if section.table is not None:
            parts.append(_table(section.table, section.bold))
        for name, caption in section.pictures.items():
            if (folder / name).exists():
                parts.append(f"![{escape(caption)}]({name})")
    commit = origin["commit"]  # a hash of 40 digits, possibly with "-dirty", or ""
    version = f"commit {commit[:12]}{commit[40:]}" if commit else f"code {origin['code'][:12]}"
    command = origin["command"] or "called from Python"
    parts.append(f"{origin['started']}, {version}: {escape(command)}\n")
    return "\n\n".join(parts)


def _table(table: pd.DataFrame, bold: Collection[str]) -> str:
    """Return a table of text in Markdown."""

    def cell(text: object) -> str:
        return f"**{escape(text)}**" if text in bold else escape(text)

    shown = table.astype(object).map(cell).rename(columns=escape)
    return str(shown.to_markdown(index=False, disable_numparse=True))


def _html(folder: Path, title: str, page: str) -> str:
    """Return a page of Markdown as one file of HTML, with the pictures in it."""
    import markdown

    body = markdown.markdown(page, extensions=["tables", "toc"])
    for name in re.findall(r'src="([\w.-]+\.png)"', body):
        data = base64.b64encode((folder / name).read_bytes()).decode()
        body = body.replace(f'src="{name}"', f'src="data:image/png;base64,{data}"')
    return f"{_HEAD}<title>{html.escape(title)}</title>\n{body}\n</html>\n"


def on_screen(table: pd.DataFrame) -> str:
    """Return a table of text for the terminal, or as wide as COLUMNS says.

    Nothing is cut: columns that find no room follow below, beside the first column again.
    """
    width = shutil.get_terminal_size((150, 24)).columns
    first = table.columns[0]
    cells = table.astype(str).set_index(first).rename_axis(index=None, columns=first)
    with pd.option_context("display.max_colwidth", None):
        return cells.to_string(line_width=width - 2, max_rows=None)


COLOURS = "#0072B2", "#D55E00"  # of lines that stand for no controller
MULTIPLE = "multiple of the least possible\n(log scale of the excess over 1)"
NEAREST = 1e-3  # excess over the least possible error at which a logarithmic axis begins
STYLE: Any = {
    "axes.grid": True,
    "axes.titlelocation": "left",
    "axes.titlesize": "medium",
    "figure.constrained_layout.use": True,
    "figure.dpi": 130,
    "font.size": 9,
    "grid.alpha": 0.3,
    "text.parse_math": False,  # names of controllers may have a dollar
}


@contextmanager
def drawn(path: Path, height: float, title: str) -> Iterator[Figure]:
    """Yield a figure of a height in inches, and save it, completely or not at all."""
    import matplotlib as mpl  # here: slow to import, and many reports have no picture
    from matplotlib.figure import Figure
    from PIL import Image

    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.5, height))
        lines = textwrap.fill(title[0].upper() + title[1:], 86)
        figure.suptitle(lines, x=0.01, ha="left", fontsize=10, weight="bold")
        yield figure
        with replacing(path) as partial:
            figure.savefig(partial)
            # A quarter of the size. The clustering keeps the colours of small marks.
            picture = Image.open(partial).convert("RGB")
            picture.quantize(128, Image.Quantize.MAXCOVERAGE, kmeans=3).save(partial)


@contextmanager
def panels(
    path: Path, names: Sequence[str], height: float, columns: int, title: str
) -> Iterator[tuple[Figure, list[Axes]]]:
    """Yield a figure with a panel of a height in inches for each name, and save it."""
    columns = min(columns, len(names))
    rows = math.ceil(len(names) / columns)
    with drawn(path, height * rows + 1.2, title) as figure:
        axes = list(figure.subplots(rows, columns, squeeze=False).flat)
        for panel, name in zip(axes, names, strict=False):
            panel.set_title(name)
        for panel in axes[len(names) :]:
            panel.set_axis_off()
        yield figure, axes[: len(names)]


def scale_by_excess(axes: Axes, name: str, low: float, high: float) -> None:
    """Make the axis "x" or "y" of `multiple - 1` logarithmic, with multiples as its ticks."""
    from matplotlib import ticker

    axes.set(**{f"{name}scale": "log", f"{name}lim": (low / 1.3, high * 1.3)})
    axis = getattr(axes, f"{name}axis")
    axis.set_major_locator(ticker.FixedLocator([0.001, 0.01, 0.1, 0.5, 1.0, 4.0, 9.0, 29.0]))
    axis.set_major_formatter(lambda excess, _: f"{1 + excess:g}")
    axis.set_minor_locator(ticker.NullLocator())
