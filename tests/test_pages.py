"""Every number on a page is that of the published file which it names.

A page says where its numbers come from by a comment above a table, a list or a paragraph:

    <!-- numbers: report.md -->

names files in `benchmarks/published`, or none, and why. A number of a table must be in a
line of these files that has the row's label, if there is one; any other must be anywhere in
them. A number on a page may have fewer digits than the file, and may be in millions (M).
"""

import re

import pytest

from tests.conftest import ROOT

PUBLISHED = ROOT / "benchmarks/published"
PAGES = {
    str(path.relative_to(ROOT)): path.read_text("utf-8")
    for path in [ROOT / "README.md", *sorted((ROOT / "benchmarks").rglob("*.md"))]
    if PUBLISHED not in path.parents
}
MARK = re.compile(r"<!-- numbers: (.*?) -->\n\n?(.*?)(?:\n\n|\Z)", re.DOTALL)
# Outside rows with a label, integers without one of these units are words of the text.
NUMBER = re.compile(r"(?<![\w.,#])(\d[\d,]*(?:\.\d+)?)(?![\w,.]*[\w])( M\b| %| t/h)?")
INTERVAL = re.compile(r" \([^()]* to [^()]*\)")


def read(text: str) -> list[tuple[str, str]]:
    return [(number.replace(",", ""), unit) for number, unit in NUMBER.findall(text)]


def rounded(number: float, like: str) -> str:
    return f"{number + 1e-9:.{len(like.partition('.')[2])}f}"


def missing(text: str, lines: list[str], *, all_numbers: bool) -> list[str]:
    """Return the numbers of a text that none of the lines has."""
    means = read(INTERVAL.sub("", "\n".join(lines)))
    ends = read("\n".join(found for line in lines for found in INTERVAL.findall(line)))
    without = INTERVAL.sub("", text)
    faults = []
    for part, known in ((without, means), (" ".join(INTERVAL.findall(text)), ends)):
        for number, unit in read(part):
            scale = 1e-6 if unit == " M" else 1.0
            values = {rounded(float(value) * scale, number) for value, _ in known}
            # A half may have been rounded either way before.
            values |= {rounded(float(value) * scale - 2e-9, number) for value, _ in known}
            if (all_numbers or "." in number or unit) and number not in values:
                faults.append(number)
    return faults


def faults_of(block: str, source: str) -> list[str]:
    lines = source.replace("*", "").splitlines()
    if not block.startswith("|"):
        return missing(block, lines, all_numbers=False)
    faults = []
    for row in block.splitlines()[2:]:
        label, *cells = (cell.strip(" `*") for cell in row.strip("|").split("|"))
        label = re.sub(r"\[(.*?)\]\(.*?\)", r"\1", label)
        named = re.compile(rf"(^|[|,]) *{re.escape(label)} *([|,]|  )")
        own = [line for line in lines if named.search(line) and read(named.sub("", line))]
        faults += [f"{label}: {each}" for each in missing(
            " | ".join(cells), own or lines, all_numbers=bool(own)
        )]  # fmt: skip
    return faults


MARKED = [(name, *found) for name, page in PAGES.items() for found in MARK.findall(page)]
SOURCED = [each for each in MARKED if not each[1].startswith("none")]


@pytest.mark.parametrize(("page", "files", "block"), SOURCED, ids=range(len(SOURCED)))
def test_numbers_of_a_page_are_those_of_its_source(page, files, block):
    texts = [(PUBLISHED / file).read_text("utf-8") for file in files.split(", ")]
    source = "\n".join(texts).replace(",", ", ") if "csv" in files else "\n".join(texts)
    assert not faults_of(block, source), f"{page}, against {files}"
    digit = re.search(r"(?<=\.)\d(?=[ ,;|°)]|\d)", block)
    if digit:  # changed, it is noticed
        before, after = block[: digit.start()], block[digit.end() :]
        assert any(faults_of(f"{before}{other}{after}", source) for other in range(10))


@pytest.mark.parametrize("page", PAGES)
def test_every_table_of_results_names_its_source(page):
    marked = "".join(block for name, _, block in MARKED if name == page)
    for table in re.findall(r"^\|.*?(?:\n\n|\Z)", PAGES[page], re.DOTALL | re.MULTILINE):
        if len(re.findall(r"\d\.\d", table)) > 8:
            assert table.strip() in marked, table[:200]
