"""Write the sections of a report to a Markdown file, or print them on the terminal."""

from __future__ import annotations

import shutil
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.lib.command import CommandError


@dataclass(frozen=True)
class Section:
    """A section of a report.

    Attributes
    ----------
    title : str
        Heading of the section; "" for a section without a heading.
    text : sequence of str
        Paragraphs of the section, above the table.
    table : pandas.DataFrame, optional
        Table whose cells are texts; None for a section without a table.
    pictures : mapping
        Caption of each picture, by the name of the PNG file in the folder of the report.
    """

    title: str
    text: Sequence[str] = ()
    table: pd.DataFrame | None = None
    pictures: Mapping[str, str] = field(default_factory=dict)


def write_report(
    folder: Path,
    title: str,
    sections: Sequence[Section],
    provenance: Mapping[str, Any],
    error: CommandError | None = None,
) -> None:
    """Write a report to the file `report.md` in a folder.

    Parameters
    ----------
    folder
        Folder of the report.
    title
        Heading of the report.
    sections
        Sections of the report, in order.
    provenance
        Provenance of the results, as `outputs.provenance_of` returns it.
    error
        Error that says which results are missing. The report begins with its first line.
    """
    page = [f"# {title}"]
    if error:
        first_line, _, _ = str(error).partition("\n")
        page.append(f"**Unfinished: {first_line}.**")
    for section in sections:
        page += _in_markdown(section)
    page.append("{started}, commit {commit}: {command}\n".format_map(provenance))
    (folder / "report.md").write_text("\n\n".join(page), encoding="utf-8")


def _in_markdown(section: Section) -> list[str]:
    """Return a section as blocks of Markdown, such as a heading, a paragraph or a table."""
    blocks = list(section.text)
    if section.title:
        blocks.insert(0, f"## {section.title}")
    if section.table is not None:
        blocks.append(str(section.table.to_markdown(index=False, disable_numparse=True)))
    blocks += [f"![{caption}]({name})" for name, caption in section.pictures.items()]
    return blocks


def show(section: Section) -> None:
    """Print a section of a report, without pictures, on the terminal."""
    width = shutil.get_terminal_size((150, 24)).columns
    for text in filter(None, (section.title, *section.text)):
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
    return cells.to_string(line_width=width - 2)
