"""What a comparison found, as one page: Markdown, and HTML with the pictures inside."""

from __future__ import annotations

import base64
import html
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.lib.storage import write_text

_STYLE = """
body { font-family: sans-serif; max-width: 75rem; margin: 2rem auto; padding: 0 1rem;
       color: #222; line-height: 1.4; }
table { border-collapse: collapse; font-size: 0.9rem; }
th, td { padding: 0.25rem 0.7rem; text-align: right; border-bottom: 1px solid #ddd; }
th:first-child, td:first-child { text-align: left; }
.table { overflow-x: auto; }
img { max-width: 100%; margin-top: 1.5rem; }
.made { color: #666; font-size: 0.85rem; overflow-wrap: anywhere; }
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


def provenance_line(command: str, origin: Mapping[str, Any]) -> str:
    """Return when, from which commit and by which command a report was made.

    Parameters
    ----------
    command
        Name of the command of `benchmarks`.
    origin
        Holds `started` and `commit`.
    """
    called = sys.argv[1:] if command in sys.argv[0] else []
    line = shlex.join(["python", "-m", f"benchmarks.{command}", *called])
    return f"{origin['started']}, commit {origin['commit'][:12]}: {line}"


def write_report(folder: Path, title: str, sections: Sequence[Section], made: str) -> None:
    """Write `report.md` and `report.html`, whole or not at all; `made` says how it was made."""
    write_text(folder / "report.md", _markdown(title, sections, made))
    write_text(folder / "report.html", _html(folder, title, sections, made))


def _markdown(title: str, sections: Sequence[Section], made: str) -> str:
    parts = [f"# {title}", made]
    for section in sections:
        parts += [f"## {section.title}", *section.text]
        if section.table is not None:
            parts.append(section.table.to_markdown(index=False, disable_numparse=True))
        parts += [f"![{section.title}]({picture})" for picture in section.pictures]
    return "\n\n".join([*parts, ""])


def _html(folder: Path, title: str, sections: Sequence[Section], made: str) -> str:
    parts = [
        "<!doctype html>",
        f'<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<style>{_STYLE}</style></head><body><h1>{html.escape(title)}</h1>",
        f'<p class="made">{html.escape(made)}</p>',
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
