"""Every number on a page is that of the published file which it names.

A page says where its numbers come from by a comment above a table, a list or a paragraph:

    <!-- numbers: report.md -->

names files in `benchmarks/published`, or none, and why. A number of a table must stand in a row
of these files with the same label; the rows of a table without such labels follow the sections
of the file. A number of a text, or of an item of a list, must stand in a row that the text
names, if it names one. A page may have fewer digits than the file, or millions (M).
"""

import re
from functools import cache
from pathlib import Path

import pytest

from mptc_gym import IDS
from tests.conftest import ROOT

PUBLISHED = ROOT / "benchmarks/published"
PAGES = {
    str(path.relative_to(ROOT)): path.read_text("utf-8")
    for path in [
        ROOT / "README.md",
        ROOT / "mptc_gym/README.md",
        *sorted((ROOT / "benchmarks").rglob("*.md")),
    ]
    if PUBLISHED not in path.parents
}
MARK = re.compile(r"<!-- numbers: (.*?) -->\n\n?(.*?)(?:\n\n|\Z)", re.DOTALL)
NUMBER = re.compile(r"(?<![\w.,#])(\d[\d,]*(?:\.\d+)?)(?![\w,.]*[\w])( M\b| %| t/h)?")
INTERVAL = re.compile(r" \([^()]* to [^()]*\)|(?<=\|) *[\d.,]+ to [\d.,]+ *(?=\|)")  # or a cell
CELLS = {".md": r"(?<!\\)\|", ".csv": ",", ".txt": " {2,}"}  # what lies between them


def read(text):
    """Return the numbers of a text and their units: first those outside of intervals."""
    parts = INTERVAL.sub("", text), " ".join(INTERVAL.findall(text))
    return [[(n.replace(",", ""), unit) for n, unit in NUMBER.findall(part)] for part in parts]


def plain(label):
    return re.sub(r"\[(.*?)\]\(.*?\)", r"\1", label).strip(" `*")


def rows_of(text, kind=".md"):
    """Return the cells of each line."""
    lines = text.strip().splitlines()
    return [[plain(cell) for cell in re.split(CELLS[kind], line.strip("| "))] for line in lines]


@cache
def rows_in(file):
    """Return the rows of a file, and the columns of presets with their ids as labels."""
    found = []
    for block in re.split(r"\n\s*\n", (PUBLISHED / file).read_text("utf-8")):
        rows, heads = rows_of(block, Path(file).suffix), 2 if file.endswith(".md") else 0
        columns = zip(*rows, strict=False)
        found += rows[heads:] + [[IDS[head], *cells] for head, *cells in columns if head in IDS]
    return [row for row in found if len(row) > 1]


def same(number, unit, known):
    scale = 1e-6 if unit == " M" else 1.0
    digits = len(number.partition(".")[2])
    # A half may have been rounded either way before.
    return any(f"{float(known) * scale + e:.{digits}f}" == number for e in (1e-9, -1e-9))


def faults_of(block, files):
    """Return the numbers on a page that its files do not have where it says."""
    rows = [row for file in files for row in rows_in(file)]
    if not block.startswith("|"):
        items = re.split(r"\n(?=- )", block)
        return [number for item in items for number in unknown(item, named_in(item, rows))]
    table = rows_of(block)[2:]
    known = [[row for row in rows if label in row[:2]] for label, *_ in table]
    if not all(known):
        known = [
            [[each]] for each in (PUBLISHED / files[0]).read_text("utf-8").split("\n## ")[1:]
        ]
    pairs = zip(table, known, strict=True)
    return [
        number for (_, *cells), there in pairs for number in unknown(" | ".join(cells), there)
    ]


def named_in(text, rows):
    """Return the rows that a text names, or all rows if it names none."""
    named = [
        row
        for row in rows
        if row[0] and re.search(rf"(?<![\w.]){re.escape(row[0])}(?!\.?\w)", text)
    ]
    return named or rows


def unknown(text, rows):
    """Return the numbers of a text, but for its integers without a unit, that no row has.

    Means must be means, and ends of intervals such ends.
    """
    known = " ; ".join(cell for row in rows for cell in row).replace("*", "")
    return [
        number
        for here, there in zip(read(text), read(known), strict=True)
        for number, unit in here
        if ("." in number or unit) and not any(same(number, unit, each) for each, _ in there)
    ]


SOURCED = [
    (name, files.split(", "), block)
    for name, page in PAGES.items()
    for files, block in MARK.findall(page)
    if not files.startswith("none")
]


@pytest.mark.parametrize(("page", "files", "block"), SOURCED, ids=range(len(SOURCED)))
def test_numbers_of_a_page_are_those_of_its_source(page, files, block):
    assert not faults_of(block, files), f"{page}, against {files}"


@pytest.mark.parametrize("page", PAGES)
def test_every_table_of_results_names_its_source(page):
    marked = "".join(block for _, block in MARK.findall(PAGES[page]))
    for table in re.findall(r"^\|.*?(?:\n\n|\Z)", PAGES[page], re.DOTALL | re.MULTILINE):
        if len(re.findall(r"\d\.\d", table)) > 8:
            assert table.strip() in marked, table[:200]
