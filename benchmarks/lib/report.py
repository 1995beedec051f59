"""Write the report of a command as a Markdown file, and print the tables of the report."""

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
    """A section of a report.

    All texts of a section are plain text, in which characters such as `*` have no meaning.

    Attributes
    ----------
    title : str
        Heading of the section; "" for a section without a heading.
    text : sequence of str
        Paragraphs of the section, above the table.
    table : pandas.DataFrame, optional
        Table whose cells are texts; None for a section without a table.
    bold : collection of str
        Texts that are shown in bold type in the cells of the table.
    pictures : mapping
        Caption of each picture, by the name of the PNG file in the folder of the report.
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
    """Write a report to the file `report.md` in a folder, and print its first sections.

    Parameters
    ----------
    folder
        Folder of the report, which already has the PNG files of the sections. If the file of a
        picture is missing, the report leaves the picture out.
    title
        Heading of the report, as plain text.
    sections
        Sections of the report, in order.
    origin
        Provenance of the results, as `provenance.origin` returns it. If results are missing,
        `origin["missing"]` is a text that says which results are missing, and the report begins
        with this text.
    printed
        Number of sections to print on the terminal; None prints all sections.
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
    """Return a section as blocks of Markdown, such as a heading, a paragraph or a table.

    A picture whose PNG file is not in `folder` is left out of the blocks.
    """

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
    """Return one line of Markdown that a reader sees as the plain text `str(text)`.

    Users choose the names of controllers, files and columns in a report. Without `escape`, such
    a name could end a cell of a table, or bring HTML and links into the report.
    """
    escaped = " ".join(str(text).split()).replace("\\", "\\\\")
    escaped = escaped.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    escaped = escaped.replace("|", "\\|").replace("](", "]\\(")
    for mark in "*_`":  # A single mark has no meaning in Markdown, but a pair of marks has.
        if escaped.count(mark) > 1:
            escaped = escaped.replace(mark, f"\\{mark}")
    return escaped


def _source(origin: Mapping[str, Any]) -> str:
    """Return the last line of a report: start time, version of the code, and command."""
    version = f"code {origin['code'][:12]}"
    commit = origin["commit"]  # 40 digits, and "-dirty" if files have changed; "" without git
    if commit:
        version = f"commit {commit[:12]}{commit[40:]}"
    command = origin["command"] or "called from Python"
    return f"{origin['started']}, {version}: {command}"


def _print(section: Section) -> None:
    """Print the heading, the paragraphs and the table of a section on the terminal."""
    width = shutil.get_terminal_size((150, 24)).columns
    for text in (section.title, *section.text):
        if text:
            print(textwrap.fill(text, width))
    if section.table is not None:
        print(on_screen(section.table))


def on_screen(table: pd.DataFrame) -> str:
    """Return a table as text whose lines are no wider than the terminal, if possible.

    A table that is too wide for the terminal is split into several tables, one below the other,
    each with the first column and some of the remaining columns.
    """
    width = shutil.get_terminal_size((150, 24)).columns
    first = table.columns[0]
    cells = table.astype(str).set_index(first).rename_axis(index=None, columns=first)
    with pd.option_context("display.max_colwidth", None):
        return cells.to_string(line_width=width - 2, max_rows=None)
