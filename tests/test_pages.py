"""Every number on a page is that of the published file which it names.

A page says where its numbers come from by a comment above a table, a list or a paragraph:

    <!-- numbers: report.md -->

names files in `benchmarks/published`, or none, and why. A number of a table must stand in a row
of these files with the same label; the rows of a table without such labels follow the sections
of the file. A number of a text must stand in a row that the text names, if it names one. A page
may have fewer digits than the file, or millions (M).
"""

import csv
import re
from collections import defaultdict
from functools import cache

import pytest

from mptc_gym import IDS
from tests.conftest import ROOT

UNTOLD = {
    *("PPO", "PPO (hard)", "NN (1992)", "PI (SIMC)", "PI (1992)", "Smith", "neural Smith"),
    *("self-tuning", "neural self-tuning"),
}
PUBLISHED = ROOT / "benchmarks/published"
PAGES = {
    str(path.relative_to(ROOT)): path.read_text("utf-8")
    for path in [ROOT / "README.md", *sorted((ROOT / "benchmarks").rglob("*.md"))]
    if PUBLISHED not in path.parents
}
MARK = re.compile(r"<!-- numbers: (.*?) -->\n\n?(.*?)(?:\n\n|\Z)", re.DOTALL)
NUMBER = re.compile(r"(?<![\w.,#])(\d[\d,]*(?:\.\d+)?)(?![\w,.]*[\w])( M\b| %| t/h)?")
INTERVAL = re.compile(r" \([^()]* to [^()]*\)")
# Of a screen: a number with its interval, or words with one space between them.
CELL = re.compile(r"[\d.,]+(?: \([^()]*\))?(?= |$)|\S+(?: \S+)*")


def read(text):
    """Return the numbers of a text and their units: first those outside of intervals."""
    parts = INTERVAL.sub("", text), " ".join(INTERVAL.findall(text))
    return [[(n.replace(",", ""), unit) for n, unit in NUMBER.findall(part)] for part in parts]


def plain(label):
    return re.sub(r"\[(.*?)\]\(.*?\)", r"\1", label).strip(" `*")


def rows_of(lines):
    """Return the cells of the rows of a Markdown table, without its head."""
    return [re.split(r"(?<!\\)\|", line.strip().strip("|")) for line in lines[2:]]


@cache
def tables(file):
    """Return the tables of a file, each as {label: {column: text}}."""
    text = (PUBLISHED / file).read_text("utf-8")
    if file.endswith(".csv"):
        by_agent = defaultdict(dict)
        for row in csv.DictReader(text.splitlines()):
            of = row.pop("scenario"), row.pop("metric", "")
            by_agent[row.pop("agent")] |= {(*of, name): value for name, value in row.items()}
        return [dict(by_agent)]
    found = []
    for block in re.split(r"\n\s*\n", text):
        lines = block.strip("\n").splitlines()
        if block.lstrip().startswith("|"):
            table = {plain(row[0]): dict(enumerate(row)) for row in rows_of(lines)}
            found.append(by_id(lines, table))
        else:  # columns of a screen end below one another
            table = {}
            for line in lines:
                cells = {each.end(): each[0] for each in CELL.finditer(line)}
                table[plain(next(iter(cells.values())))] = cells
        found.append(table)
    return found


def by_id(lines, table):
    """Return a table with a row for each preset, and the best that are not told the plant."""
    turned = {}
    for j, name in enumerate(map(plain, rows_of(["", "", lines[0]])[0])):
        if name in IDS:
            column = {label: row[j] for label, row in table.items()}
            for who in ("", "PPO"):
                untold = [column[each] for each in UNTOLD if each in column and who in each]
                column["best", who] = min(
                    untold, key=lambda text: float(read(text)[0][0][0]), default=""
                )
            turned[IDS[name]] = column
    return turned


def same(number, unit, known):
    scale = 1e-6 if unit == " M" else 1.0
    digits = len(number.partition(".")[2])
    # A half may have been rounded either way before.
    return any(f"{float(known) * scale + e:.{digits}f}" == number for e in (1e-9, -1e-9))


def faults_of(block, files):
    """Return the numbers on a page that its files do not have."""
    found = [table for file in files for table in tables(file)]
    if not block.startswith("|"):
        return faults_of_text(block, found)
    rows = rows_of(block.splitlines())
    known = [
        " ; ".join(text for table in found for text in table.get(plain(label), {}).values())
        for label, *_ in rows
    ]
    if not all(known):
        known = (PUBLISHED / files[0]).read_text("utf-8").split("\n## ")[1:]
    return [
        number
        for (_, *cells), there in zip(rows, known, strict=True)
        for number in unknown(" | ".join(cells), there)
    ]


def unknown(text, known):
    """Return the numbers of a text, but for its integers without a unit, that are not known.

    Means must be means, and ends of intervals such ends.
    """
    return [
        number
        for here, there in zip(read(text), read(known.replace("*", "")), strict=True)
        for number, unit in here
        if ("." in number or unit) and not any(same(number, unit, each) for each, _ in there)
    ]


def faults_of_text(text, found):
    named = [
        cells for table in found for label, cells in table.items()
        if re.search(rf"(?<!\w){re.escape(label)}(?!\w)", text) and len(cells) > 1
    ]  # fmt: skip
    rows = named or [cells for table in found for cells in table.values()]
    return unknown(text, " ; ".join(cell for row in rows for cell in row.values()))


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
