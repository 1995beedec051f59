"""Each run writes to a new folder, which says where the results come from."""

import json
import subprocess
from concurrent.futures import ThreadPoolExecutor

import pandas as pd
import pytest

from benchmarks.lib import outputs
from benchmarks.lib.command import CommandError
from benchmarks.lib.outputs import commit, new_folder
from benchmarks.lib.sections import Section, on_screen, write_report


@pytest.fixture(autouse=True)
def inside(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_runs_at_once_meet_nowhere():
    with ThreadPoolExecutor(8) as pool:
        folders = list(pool.map(lambda i: new_folder(None, "compare", {"run": i}), range(8)))
    names = {"compare", *(f"compare-{number}" for number in range(2, 9))}
    assert {folder.name for folder in folders} == names
    for i, folder in enumerate(folders):
        assert json.loads((folder / "provenance.json").read_text()) == {"run": i}


def test_a_folder_with_files_is_refused_unless_the_command_goes_on(tmp_path):
    chosen = tmp_path / "a" / "mine"
    chosen.mkdir(parents=True)
    assert new_folder(chosen, "compare", {}) == chosen
    with pytest.raises(CommandError, match=r"--out must be a new or empty folder, got .*mine"):
        new_folder(chosen, "compare", {})
    assert new_folder(chosen, "tune-pi", {"run": 2}, goes_on=True) == chosen
    assert json.loads((chosen / "provenance.json").read_text()) == {}  # that of the first run
    thesis = (chosen / "provenance.json").rename(chosen / "thesis.tex")
    for out in (chosen, thesis):
        with pytest.raises(CommandError, match="must be a new or empty folder"):
            new_folder(out, "tune-pi", {}, goes_on=True)
    assert [path.name for path in chosen.iterdir()] == ["thesis.tex"]


def test_the_commit_is_that_of_the_checkout_itself_and_says_whether_files_differ(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(outputs, "ROOT", tmp_path)
    assert commit() == "unknown"
    user = "-c", "user.name=a", "-c", "user.email=a"
    subprocess.run(["git", "init", "-q"], check=True)
    (tmp_path / "mine.py").touch()
    subprocess.run(["git", "add", "mine.py"], check=True)
    subprocess.run(["git", *user, "commit", "-q", "-m", "a"], check=True)
    assert len(commit()) == 40
    (tmp_path / "mine.py").write_text("pass")
    assert commit().endswith("-dirty")
    # A copy without a repository of its own, unpacked in another one.
    (tmp_path / "unpacked").mkdir()
    monkeypatch.setattr(outputs, "ROOT", tmp_path / "unpacked")
    assert commit() == "unknown"


PROVENANCE = {"started": "made today", "commit": "abcd-dirty", "command": "python -m x"}


class TestReport:
    def test_a_page(self, tmp_path):
        table = pd.DataFrame({"a": ["b", "c"], "value": ["1.0 (0.9 to 1.1)", "[1, 2]"]})
        pictures = {"picture.png": "What it shows"}
        first = Section("First", ["Some text."], table, pictures)
        error = CommandError("1 of 2 tasks are missing\npi: why")
        write_report(tmp_path, "Title", [first, Section("Second")], PROVENANCE, error)
        page = (tmp_path / "report.md").read_text()
        assert page.startswith("# Title\n\n**Unfinished: 1 of 2 tasks are missing.**\n\n## Fir")
        assert "## First\n\nSome text.\n\n| a   | value " in page
        assert "| b   | 1.0 (0.9 to 1.1) |" in page
        assert "| c   | [1, 2] " in page
        assert "\n\n![What it shows](picture.png)\n\n## Second\n\nmade today" in page
        assert page.endswith("made today, commit abcd-dirty: python -m x\n")

    @pytest.mark.parametrize("width", [60, 200])
    def test_on_screen_nothing_is_cut(self, width, monkeypatch):
        monkeypatch.setenv("COLUMNS", str(width))
        cells = {f"square-dead-zone-{i}": ["1.00 (0.99 to 1.01)", "11.5"] for i in range(7)}
        table = pd.DataFrame({"agent": ["neural self-tuning", "NN (1992)"], **cells})
        shown = on_screen(table)
        assert width / 2 < max(map(len, shown.splitlines())) <= width
        assert shown.count("11.5") == shown.count("1.00 (0.99 to 1.01)") == 7
        assert shown.startswith("agent ")
