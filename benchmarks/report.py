"""What a comparison found, as one page: Markdown, and HTML with the pictures inside."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from benchmarks.storage import write_text

_STYLE = """
body { font-family: sans-serif; max-width: 75rem; margin: 2rem auto; padding: 0 1rem;
       color: #222; line-height: 1.4; }
table { border-collapse: collapse; font-size: 0.9rem; }
th, td { padding: 0.25rem 0.7rem; text-align: right; border-bottom: 1px solid #ddd; }
th:first-child, td:first-child { text-align: left; }
.table { overflow-x: auto; }
img { max-width: 100%; }
"""


@dataclass(frozen=True)
class Section:
    """A part of a report.

    Attributes
    ----------
    title
        Its heading.
    text
        What there is to say, in paragraphs.
    table
        All cells are text.
    pictures
        Names of PNG files in the report's folder.
    """

    title: str
    text: Sequence[str] = ()
    table: pd.DataFrame | None = None
    pictures: Sequence[str] = ()


def write_report(folder: Path, title: str, sections: Sequence[Section]) -> None:
    """Write `report.md` and `report.html`, whole or not at all."""
    write_text(folder / "report.md", _markdown(title, sections))
    write_text(folder / "report.html", _html(folder, title, sections))


def _markdown(title: str, sections: Sequence[Section]) -> str:
    parts = [f"# {title}"]
    for section in sections:
        parts += [f"## {section.title}", *section.text]
        if section.table is not None:
            parts.append(section.table.to_markdown(index=False, disable_numparse=True))
        parts += [f"![{section.title}]({picture})" for picture in section.pictures]
    return "\n\n".join([*parts, ""])


def _html(folder: Path, title: str, sections: Sequence[Section]) -> str:
    parts = [
        "<!doctype html>",
        f'<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>',
        f"<style>{_STYLE}</style></head><body><h1>{html.escape(title)}</h1>",
    ]
    for section in sections:
        parts.append(f"<h2>{html.escape(section.title)}</h2>")
        parts += [f"<p>{html.escape(paragraph)}</p>" for paragraph in section.text]
        if section.table is not None:
            table = section.table.to_html(index=False, border=0)
            parts.append(f'<div class="table">{table}</div>')
        for picture in section.pictures:
            data = base64.b64encode((folder / picture).read_bytes()).decode()
            alternative = html.escape(f"{section.title}: {picture}")
            parts.append(f'<img alt="{alternative}" src="data:image/png;base64,{data}">')
    return "\n".join([*parts, "</body></html>", ""])
