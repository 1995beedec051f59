"""Write a report as Markdown, and as one HTML page with the pictures embedded."""

from __future__ import annotations

import base64
import html
import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
from rich.console import Console

from benchmarks.lib.storage import write_text
from benchmarks.lib.tables import ScreenTable

_STYLE = """
body { font-family: sans-serif; max-width: 75rem; margin: 2rem auto; padding: 0 1rem;
       color: #222; line-height: 1.4; }
table { border-collapse: collapse; font-size: 0.9rem; }
th, td { padding: 0.25rem 0.7rem; text-align: right; border-bottom: 1px solid #ddd; }
th:first-child, td:first-child { text-align: left; }
.table { overflow-x: auto; }
label input { display: none; }
label input:checked + img { max-width: none; }
.interval { display: block; color: #777; font-size: 0.75em; white-space: nowrap; }
img { max-width: 100%; margin-top: 1.5rem; }
.made { color: #666; font-size: 0.85rem; overflow-wrap: anywhere; }
"""
_INTERVAL = re.compile(r" (\([^()]* to [^()]*\))")  # shown small, below its number


class Best(str):
    """Text of a cell that is set in bold."""


@dataclass(frozen=True)
class Section:
    """A section of a report."""

    title: str
    """Heading; "" for none."""
    text: Sequence[str] = ()
    """Paragraphs."""
    table: pd.DataFrame | None = None
    """Table of text cells."""
    pictures: Sequence[str] = ()
    """Names of PNG files in the report's folder."""
    caption: str = ""
    """What the pictures show."""


def provenance_line(command: str, origin: Mapping[str, Any]) -> str:
    """Return the time, the commit and the command of `benchmarks` that made a report."""
    called = sys.argv[1:] if command in sys.argv[0] else []
    commit = origin["commit"]  # a hash of 40 digits, possibly with "-dirty"
    line = shlex.join(["python", "-m", f"benchmarks.{command}", *called])
    return f"{origin['started']}, commit {commit[:12]}{commit[40:]}: {line}"


def show(sections: Sequence[Section], console: Console) -> None:
    """Print sections, without their pictures."""
    for section in sections:
        console.print(*filter(None, [section.title, *section.text]), sep="\n")
        if section.table is not None:
            console.print(ScreenTable(section.table))


def write_report(folder: Path, title: str, sections: Sequence[Section], made: str) -> None:
    """Write `report.md` and `report.html`; `made` is their provenance line."""
    write_text(folder / "report.md", _markdown(title, sections, made))
    write_text(folder / "report.html", _html(folder, title, sections, made))


def _plain(text: str) -> str:
    """Escape text that Markdown would read as HTML."""
    return text.replace("&", "&amp;").replace("<", "&lt;")


def _cell(text: str) -> str:
    plain = _plain(text).replace("|", r"\|")
    return f"**{plain}**" if isinstance(text, Best) else plain


def _html_cell(text: str) -> str:
    plain = html.escape(text, quote=False)
    return f"<b>{plain}</b>" if isinstance(text, Best) else plain


def _markdown(title: str, sections: Sequence[Section], made: str) -> str:
    parts = [f"# {_plain(title)}"]
    for section in sections:
        parts += [f"## {_plain(section.title)}"] * bool(section.title)
        parts += map(_plain, section.text)
        if section.table is not None:
            table = section.table.map(_cell).rename(columns=_cell)
            parts.append(table.to_markdown(index=False, disable_numparse=True))
        parts += [_plain(section.caption)] * bool(section.caption)
        parts += [f"![{_plain(section.title)}]({picture})" for picture in section.pictures]
    return "\n\n".join([*parts, _plain(made)]) + "\n"


def _html(folder: Path, title: str, sections: Sequence[Section], made: str) -> str:
    parts = [
        "<!doctype html>",
        f'<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<style>{_STYLE}</style></head><body><h1>{html.escape(title)}</h1>",
    ]
    titles = [html.escape(section.title) for section in sections]
    links = [f'<a href="#{i}">{name}</a>' for i, name in enumerate(titles) if name]
    parts.append(f"<p>{'<br>'.join(links)}</p>")
    for i, (section, name) in enumerate(zip(sections, titles, strict=True)):
        parts += [f'<h2 id="{i}">{name}</h2>'] * bool(name)
        parts += [f"<p>{html.escape(paragraph)}</p>" for paragraph in section.text]
        if section.table is not None:
            with pd.option_context("display.max_colwidth", None):
                cells = section.table.map(_html_cell)
                table = cells.to_html(index=False, border=0, escape=False)
            smaller = _INTERVAL.sub(r'<span class="interval">\1</span>', table)
            parts.append(f'<div class="table">{smaller}</div>')
        parts += [f"<p>{html.escape(section.caption)}</p>"] * bool(section.caption)
        for picture in section.pictures:
            data = base64.b64encode((folder / picture).read_bytes()).decode()
            alternative = html.escape(f"{section.title}: {picture}")
            image = f'<img alt="{alternative}" src="data:image/png;base64,{data}">'
            parts.append(
                f'<label><input type="checkbox">{image}</label>'
            )  # a click enlarges it
    parts.append(f'<p class="made">{html.escape(made)}</p>')
    return "\n".join([*parts, "</body></html>", ""])
