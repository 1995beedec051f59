"""Write a report in Markdown with its pictures, and print its tables."""

from __future__ import annotations

import shutil
import textwrap
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.lib.storage import write_text


@dataclass(frozen=True)
class Section:
    """A section of a report. Its texts are shown as they are, not read as Markdown.

    Attributes
    ----------
    title : str
        The heading; "" for none.
    text : sequence of str
        Paragraphs.
    table : pandas.DataFrame, optional
        A table of texts.
    bold : collection of str
        Cells of the table that are shown in bold type.
    pictures : mapping
        The captions of PNG files, by their names in the report's folder.
    """

    title: str
    text: Sequence[str] = ()
    table: pd.DataFrame | None = None
    bold: Collection[str] = field(default=(), kw_only=True)
    pictures: Mapping[str, str] = field(default_factory=dict, kw_only=True)


def write_report(
    folder: Path,
    title: str,
    sections: Sequence[Section],
    origin: Mapping[str, Any],
    printed: int | None = None,
) -> None:
    """Write `report.md`, and print its first sections.

    Parameters
    ----------
    folder
        The folder of the report and its pictures. A picture that is missing is left out.
    title
        The heading of the report.
    sections
        The parts of the report.
    origin
        The provenance of the results, as `provenance.origin` returns it. If it has the key
        "missing", the first line of the report says that these results are missing.
    printed
        Number of sections to print; None prints all.
    """
    unfinished = f"Unfinished: {origin['missing']}." if "missing" in origin else ""
    page = [f"# {escape(title)}"]
    if unfinished:
        page.append(f"**{escape(unfinished)}**")
        print(unfinished)
    for section in sections:
        page += _in_markdown(section, folder)
    page.append(f"{escape(_source(origin))}\n")
    write_text(folder / "report.md", "\n\n".join(page))
    for section in sections[:printed]:
        _print(section)


def _in_markdown(section: Section, folder: Path) -> list[str]:
    """Return the blocks of a section in Markdown, with the pictures that are in the folder."""

    def cell(text: object) -> str:
        escaped = escape(text)
        return f"**{escaped}**" if text in section.bold else escaped

    blocks = []
    if section.title:
        blocks.append(f"## {escape(section.title)}")
    blocks += [escape(text) for text in section.text]
    if section.table is not None:
        cells = section.table.astype(object).map(cell).rename(columns=escape)
        blocks.append(str(cells.to_markdown(index=False, disable_numparse=True)))
    for name, caption in section.pictures.items():
        if (folder / name).exists():
            blocks.append(f"![{escape(caption)}]({name})")
    return blocks


def escape(text: object) -> str:
    """Return Markdown, on one line, that shows a text as it is.

    The name of a controller, a file or a column comes from outside. Without this function it
    could end a cell of a table, or bring HTML and links into the page.
    """
    escaped = " ".join(str(text).split()).replace("\\", "\\\\")
    escaped = escaped.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    escaped = escaped.replace("|", "\\|").replace("](", "]\\(")
    for mark in "*_`":  # A single mark has no meaning, two enclose a text.
        if escaped.count(mark) > 1:
            escaped = escaped.replace(mark, f"\\{mark}")
    return escaped


def _source(origin: Mapping[str, Any]) -> str:
    """Return when, with which code and by which command results were made, in a line."""
    commit = origin["commit"]  # a hash of 40 digits, "-dirty" after it or not; or ""
    version = f"commit {commit[:12]}{commit[40:]}" if commit else f"code {origin['code'][:12]}"
    command = origin["command"] or "called from Python"
    return f"{origin['started']}, {version}: {command}"


def _print(section: Section) -> None:
    """Print a section without its pictures."""
    width = shutil.get_terminal_size((150, 24)).columns
    for text in (section.title, *section.text):
        if text:
            print(textwrap.fill(text, width))
    if section.table is not None:
        print(on_screen(section.table))


def on_screen(table: pd.DataFrame) -> str:
    """Return a table of texts as lines that are no wider than the terminal.

    If the columns do not fit on a line, the table is broken into blocks below each other, which
    all begin with the first column.
    """
    width = shutil.get_terminal_size((150, 24)).columns
    first = table.columns[0]
    cells = table.astype(str).set_index(first).rename_axis(index=None, columns=first)
    with pd.option_context("display.max_colwidth", None):
        return cells.to_string(line_width=width - 2, max_rows=None)
