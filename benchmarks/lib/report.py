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
    """A section of a report."""

    title: str  # "" for none
    text: Sequence[str] = ()  # paragraphs
    table: pd.DataFrame | None = None  # of text
    # PNG files in the report's folder, and for each what it shows, in a sentence.
    pictures: Mapping[str, str] = field(default_factory=dict)


def write_report(
    folder: Path,
    title: str,
    sections: Sequence[Section],
    command: str,
    origin: Mapping[str, Any],
    printed: int | None = None,
) -> None:
    """Write `report.md` and `report.html`, and print the first `printed` sections, or all.

    The last line is the origin and the command of `benchmarks`, the first one what is missing.
    """
    import markdown

    called = sys.argv[1:] if command in sys.argv[0] else []
    line = shlex.join(["python", "-m", f"benchmarks.{command}", *called])
    commit = origin["commit"]  # a hash of 40 digits, possibly with "-dirty"
    unfinished = [f"**Unfinished: {origin['missing']}.**"] if "missing" in origin else []
    parts = [f"# {title}", *unfinished]
    for section in sections:
        parts += [f"## {section.title}"] * bool(section.title) + [*section.text]
        if section.table is not None:
            parts.append(section.table.to_markdown(index=False, disable_numparse=True))
        there = [name for name in section.pictures if (folder / name).exists()]
        parts += [f"![{section.pictures[name]}]({name})" for name in there]
    made = f"{origin['started']}, commit {commit[:12]}{commit[40:]}: {line}\n"
    page = "\n\n".join([*parts, made])
    write_text(folder / "report.md", page)
    body = markdown.markdown(page, extensions=["tables", "toc"])
    head = f"{_HEAD}<title>{html.escape(title)}</title>"
    for name in re.findall(r'src="([\w.-]+\.png)"', body):
        data = base64.b64encode((folder / name).read_bytes()).decode()
        body = body.replace(f'src="{name}"', f'src="data:image/png;base64,{data}"')
    page = f"{head}\n{body}\n</html>\n"
    write_text(folder / "report.html", page)
    width = shutil.get_terminal_size((150, 24)).columns
    for text in unfinished:
        print(text)
    for section in sections[:printed]:
        for text in filter(None, [section.title, *section.text]):
            print(textwrap.fill(text, width))
        if section.table is not None:
            print(on_screen(section.table))


def on_screen(table: pd.DataFrame) -> str:
    """Return a table of text for the terminal, or as wide as COLUMNS says.

    Nothing is cut: columns that find no room follow below, beside the first column again.
    """
    width = shutil.get_terminal_size((150, 24)).columns
    first = table.columns[0]
    cells = table.astype(str).set_index(first).rename_axis(index=None, columns=first)
    with pd.option_context("display.max_colwidth", None):
        return cells.to_string(line_width=width - 2, max_rows=None)
