"""Write a report as Markdown, and as one HTML page with its pictures; print its tables."""

from __future__ import annotations

import base64
import html
import re
import shlex
import shutil
import sys
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.lib.storage import write_text

_STYLE = """
:root { color-scheme: light dark; }
body { font-family: sans-serif; max-width: 75rem; margin: 2rem auto; padding: 0 1rem;
       color: light-dark(#222, #ddd); background: light-dark(#fff, #181818); line-height: 1.4; }
table { border-collapse: collapse; font-size: 0.9rem; display: block; overflow-x: auto; }
th, td { padding: 0.25rem 0.7rem; text-align: right; border-bottom: 1px solid #8885; }
th:first-child, td:first-child { text-align: left; }
small { display: block; opacity: 0.7; white-space: nowrap; }
img { max-width: 100%; background: #fff; }
"""
_INTERVAL = re.compile(r" (\([^()]* to [^()]*\))</td>")  # shown small, below its number
_PICTURE = re.compile(r'src="([\w.-]+\.png)"')


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
    pictures: Mapping[str, str] = field(default_factory=dict)
    """Names of PNG files in the report's folder, and for each what it shows, in a sentence."""


def write_report(folder: Path, title: str, sections: Sequence[Section], made: str) -> None:
    """Write `report.md` and `report.html`, with the pictures that there are.

    `made` is their provenance line.
    """
    import markdown

    page = _markdown(folder, title, sections, made)
    write_text(folder / "report.md", page)
    body = markdown.markdown(page, extensions=["tables", "toc"])
    body = _INTERVAL.sub(r" <small>\1</small></td>", body)
    body = _PICTURE.sub(lambda found: f'src="{_embedded(folder / found[1])}"', body)
    head = (
        '<meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style>"
    )
    page = f'<!doctype html><html lang="en"><head>{head}</head><body>\n{body}\n</body></html>\n'
    write_text(folder / "report.html", page)


def provenance_line(command: str, origin: Mapping[str, Any]) -> str:
    """Return the time, the commit and the command of `benchmarks` that made a report."""
    called = sys.argv[1:] if command in sys.argv[0] else []
    commit = origin["commit"]  # a hash of 40 digits, possibly with "-dirty"
    line = shlex.join(["python", "-m", f"benchmarks.{command}", *called])
    return f"{origin['started']}, commit {commit[:12]}{commit[40:]}: {line}"


def show(sections: Sequence[Section]) -> None:
    """Print sections, without their pictures."""
    width = shutil.get_terminal_size((150, 24)).columns
    for section in sections:
        for text in filter(None, [section.title, *section.text]):
            print(textwrap.fill(text, width))
        if section.table is not None:
            print(on_screen(section.table))


def on_screen(table: pd.DataFrame) -> str:
    """Return a table of text for the terminal, or as wide as COLUMNS says.

    Nothing is cut: columns that find no room follow below, beside the first column again.
    """
    width = shutil.get_terminal_size((150, 24)).columns
    cells = table.astype(str).set_index(table.columns[0])
    cells.index.name = None
    with pd.option_context("display.max_colwidth", None):
        shown = cells.to_string(line_width=width + 2, max_rows=None)
    return re.sub(r"[ \\]+$", "", shown, flags=re.MULTILINE)  # pandas marks what goes on below


def _markdown(folder: Path, title: str, sections: Sequence[Section], made: str) -> str:
    parts = [f"# {_plain(title)}"]
    for section in sections:
        parts += [f"## {_plain(section.title)}"] * bool(section.title)
        parts += map(_plain, section.text)
        if section.table is not None:
            table = section.table.map(_cell).rename(columns=_cell)
            parts.append(table.to_markdown(index=False, disable_numparse=True))
        there = {
            name: shown for name, shown in section.pictures.items() if (folder / name).exists()
        }
        parts += [f"![{_plain(shown)}]({name})" for name, shown in there.items()]
    return "\n\n".join([*parts, _plain(made)]) + "\n"


def _plain(text: str) -> str:
    """Escape text that Markdown would read as HTML."""
    return text.replace("&", "&amp;").replace("<", "&lt;")


def _cell(text: str) -> str:
    plain = _plain(text).replace("|", r"\|")
    return f"**{plain}**" if isinstance(text, Best) else plain


def _embedded(picture: Path) -> str:
    return "data:image/png;base64," + base64.b64encode(picture.read_bytes()).decode()
