"""Write a report as Markdown, and as one HTML page with its pictures; print its tables."""

from __future__ import annotations

import base64
import html
import re
import shutil
import textwrap
from collections.abc import Collection, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.lib.storage import write_text

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
    _: KW_ONLY
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
