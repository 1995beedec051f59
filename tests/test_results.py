"""Results of one run in one folder, unfinished ones apart, kept ones only of the same code."""

import json
import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from benchmarks.lib import provenance
from benchmarks.lib.errors import UnfinishedError, UsageError
from benchmarks.lib.parallel import FanOut
from benchmarks.lib.results import KeptResults, conditions_of, results_folder
from tests.conftest import python

CONDITIONS = {"options": {"runs": 3}}


def run(target, files, conditions=None, error=None):
    """Write files to a folder of results, and end with an error if there is one."""
    with results_folder(target, conditions) as folder:
        for name, text in files.items():
            (folder / name).write_text(text)
        if error:
            raise error


def contents(folder):
    """Return the text of each file in a folder, but for the record of the run."""
    return {file.name: file.read_text() for file in folder.iterdir() if file.name != "run.json"}


@pytest.fixture
def target(tmp_path):
    """Return a folder that holds the results of a finished run."""
    target = tmp_path / "results" / "toy"
    run(target, {"report.md": "old", "old.csv": "1"})
    return target


def unfinished(target):
    return target.with_name("toy.unfinished")


class TestFolder:
    def test_no_file_of_an_earlier_run_stays_beside_a_new_one(self, target):
        run(target, {"report.md": "new"})
        assert contents(target) == {"report.md": "new"}
        visible = [path.name for path in target.parent.iterdir() if path.name[0] != "."]
        assert visible == ["toy"]

    @pytest.mark.parametrize("error", [KeyboardInterrupt, ArithmeticError])
    def test_an_error_leaves_the_earlier_results_and_keeps_the_new_ones_apart(
        self, error, target, capsys
    ):
        with pytest.raises(error):
            run(target, {"report.md": "half"}, error=error())
        assert contents(target) == {"report.md": "old", "old.csv": "1"}
        assert contents(unfinished(target)) == {"report.md": "half"}
        assert f"results so far are in {unfinished(target)}/." in capsys.readouterr().out
        run(target, {"new.csv": "2"})  # which begins anew
        assert contents(target) == {"new.csv": "2"}
        assert not unfinished(target).exists()

    def test_of_a_run_that_wrote_nothing_nothing_is_left(self, target, capsys):
        with pytest.raises(KeyboardInterrupt):
            run(target, {}, error=KeyboardInterrupt())
        assert not unfinished(target).exists()
        assert capsys.readouterr().out == ""

    def test_a_second_run_on_a_folder_is_refused_in_a_sentence(self, target):
        second = (
            "import sys; from pathlib import Path\n"
            "from benchmarks.lib.results import results_folder\n"
            "with results_folder(Path(sys.argv[1])): pass"
        )
        with results_folder(target) as folder:
            (folder / "report.md").write_text("first")
            done = python("-c", second, str(target))
        assert f"UsageError: --out: another run writes to {target}: wait" in done.stderr
        assert contents(target) == {"report.md": "first"}
        assert python("-c", second, str(target)).returncode == 0  # the lock is free again

    def test_files_that_no_run_wrote_are_never_removed(self, target):
        (target / "thesis.tex").write_text("years of work")
        with pytest.raises(UsageError, match=r"holds files that .* did not write \(thesis.tex"):
            run(target, {"report.md": "new"})
        (target / "thesis.tex").unlink()
        folder = results_folder(target)
        (folder.__enter__() / "report.md").write_text("newer")
        (target / "thesis.tex").write_text("years of work")  # while it runs
        with pytest.raises(UnfinishedError, match=r"thesis.tex.*; the results are in .*toy.un"):
            folder.__exit__(None, None, None)
        assert contents(target)["thesis.tex"] == "years of work"
        assert contents(unfinished(target)) == {"report.md": "newer"}
        (unfinished(target) / "run.json").unlink()
        (target / "thesis.tex").unlink()
        with pytest.raises(UsageError, match="holds files that no run wrote: remove it"):
            run(target, {})

    @pytest.mark.parametrize("name", [".toy.earlier", "toy.unfinished"])
    def test_files_beside_the_folder_are_never_removed(self, name, target):
        other = target.with_name(name)
        other.mkdir()
        (other / "thesis.tex").write_text("years of work")
        (other / "run.json").write_text('{"title": "thesis"}')
        with pytest.raises(UsageError, match="holds files that"):
            run(target, {"report.md": "new"})
        assert (other / "thesis.tex").read_text() == "years of work"
        assert contents(target) == {"report.md": "old", "old.csv": "1"}

    def test_odd_things_in_the_way_are_named(self, target):
        unfinished(target).write_text("a file")
        with pytest.raises(UsageError, match=r"toy\.unfinished must be a folder"):
            run(target, {})
        unfinished(target).unlink()
        (target / "run.json").write_text("[1]")
        with pytest.raises(UsageError, match="did not write"):
            run(target, {})
        lock = target.with_name(".other.lock")
        lock.mkdir()
        for name in ("other", 300 * "x"):
            with pytest.raises(UsageError, match=r"--out: .* cannot be used: "):
                run(target.with_name(name), {})

    @pytest.mark.parametrize(
        ("folder", "reason"),
        [
            ("/proc/here/toy", "/proc/here cannot be"),
            ("/", "/ must not be the current folder or a folder above it"),
            ("..", ".. must not be"),
        ],
    )
    def test_a_folder_that_cannot_be_written_to_is_refused(self, folder, reason):
        with pytest.raises(UsageError, match=f"--out: {reason}"):
            run(Path(folder), {})


class TestUnfinished:
    def stop(self, target, conditions):
        with pytest.raises(KeyboardInterrupt):
            run(target, {"half.csv": "1"}, conditions, KeyboardInterrupt())

    def test_the_same_run_goes_on_and_ends_with_the_files_of_both(self, target, capsys):
        self.stop(target, CONDITIONS)
        assert "The same command continues with these results." in capsys.readouterr().out
        (unfinished(target) / "tasks").mkdir()
        run(target, {"report.md": "new"}, CONDITIONS)
        assert "The run continues with the results in" in capsys.readouterr().out
        assert contents(target) == {"half.csv": "1", "report.md": "new"}

    @pytest.mark.parametrize("conditions", [None, {"options": {"runs": 4}}])
    def test_under_other_conditions_it_begins_anew(self, conditions, target, capsys):
        self.stop(target, CONDITIONS)
        run(target, {"report.md": "new"}, conditions)
        assert contents(target) == {"report.md": "new"}
        said = "are of other options, code or packages."
        assert (said in capsys.readouterr().out) == (conditions is not None)

    def test_options_count_but_not_where_tasks_run(self, tmp_path):
        @dataclass
        class Options:
            plant: Path
            runs: int = 3
            out: Path = Path("here")
            fan_out: FanOut = field(default_factory=FanOut)

        plant = tmp_path / "plant.json"
        plant.write_text("{}")
        first = conditions_of("toy", Options(plant))
        assert conditions_of("toy", Options(plant, 3, Path("there"), FanOut(jobs=2))) == first
        assert conditions_of("toy", Options(plant, 4)) != first
        assert conditions_of("other", Options(plant)) != first
        plant.write_text('{"delay": 3}')  # the same name
        assert conditions_of("toy", Options(plant)) != first
        assert json.loads(json.dumps(first)) == first

    def test_code_and_versions_count(self, tmp_path, monkeypatch):
        @dataclass
        class Options:
            runs: int = 3

        first = conditions_of("toy", Options())
        monkeypatch.setattr(provenance.metadata, "version", lambda _: "99")
        assert conditions_of("toy", Options())["versions"] != first["versions"]
        monkeypatch.setattr(provenance, "ROOT", tmp_path)
        (tmp_path / "agents").mkdir()
        law = tmp_path / "agents" / "law.py"
        hashes = set()
        for code in ("gain = 1", "gain = 2"):
            law.write_text(code)
            hashes.add(provenance.code_hash.__wrapped__())
        law.rename(law.with_name("rule.py"))
        hashes.add(provenance.code_hash.__wrapped__())
        law.with_name("notes.md").touch()  # no code
        hashes.add(provenance.code_hash.__wrapped__())
        assert len(hashes) == 3


RESULT = {"mae": np.array([0.1, np.nan, np.inf]), "limit": 1.0 / 3.0}


class TestKeptResults:
    def test_numbers_come_back_as_they_were(self, tmp_path):
        kept = KeptResults(tmp_path)
        name = "plant 3, ../../a|b\n"  # which stays in the folder
        assert kept.load(name) is None
        kept.save(name, RESULT)
        assert kept.path(name).parent == tmp_path / "tasks"
        loaded = kept.load(name)
        np.testing.assert_array_equal(loaded["mae"], RESULT["mae"])
        assert loaded["limit"] == RESULT["limit"]
        assert type(loaded["limit"]) is float

    def test_half_a_result_is_missing(self, tmp_path):
        def save_half(path, result):
            path.write_bytes(b"PK")
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            KeptResults(tmp_path, save_half).save("task", RESULT)
        kept = KeptResults(tmp_path)
        assert kept.load("task") is None
        kept.save("task", RESULT)
        assert kept.load("task")["limit"] == RESULT["limit"]

    def test_no_code_in_a_file_is_run(self, tmp_path):
        kept, ran = KeptResults(tmp_path), tmp_path / "ran"

        class Planted:
            def __reduce__(self):
                return ran.touch, ()

        kept.save("task", {"mae": np.array([Planted()], dtype=object)})
        with pytest.raises(ValueError, match="allow_pickle=False"):
            kept.load("task")
        assert not ran.exists()

    def test_tasks_that_have_finished_are_not_run_again(self, tmp_path):
        kept, calls = KeptResults(tmp_path), []

        def task():
            calls.append(None)
            return {"number": 0.1}

        for _ in range(2):
            done = dict(FanOut(jobs=1).stream({"a": task, "b": task}, "tasks", kept))
            assert done == {"a": {"number": 0.1}, "b": {"number": 0.1}}
        assert len(calls) == 2


def test_the_commit_is_that_of_the_checkout_itself_and_says_whether_files_differ(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(provenance, "ROOT", tmp_path)
    commit = provenance.commit.__wrapped__
    assert commit() == ""
    env = {"HOME": str(tmp_path), "PATH": os.environ["PATH"]}
    code = (
        "from subprocess import run; git = ['git', '-c', 'user.name=a', '-c', 'user.email=a']\n"
        "run([*git, 'init', '-q']); run([*git, 'commit', '-q', '--allow-empty', '-m', 'a'])"
    )
    python("-c", code, cwd=tmp_path, env=env, check=True)
    assert len(commit()) == 40
    (tmp_path / "mine.py").touch()
    assert commit().endswith("-dirty")
    # A copy without a repository of its own, unpacked in another one.
    (tmp_path / "unpacked").mkdir()
    monkeypatch.setattr(provenance, "ROOT", tmp_path / "unpacked")
    assert commit() == ""
