"""The search for gains, on small budgets."""

import subprocess
import sys
import time
from functools import partial

import numpy as np
import optuna
import pandas as pd
import pytest

from agents import DirectNNController, PIController
from agents.pi import SEARCHED_GAINS
from benchmarks import tune
from benchmarks.compare import comparison
from benchmarks.controllers.roster import ROSTER
from benchmarks.loop.scenarios import SCENARIOS
from tests.conftest import ROOT


class TestScore:
    def test_cases_and_seeds_are_met_by_no_comparison(self):
        compared = [case.arguments for case in SCENARIOS.values()]
        assert not any(arguments in compared for _, _, arguments in tune.CASES.values())
        assert tune.FIRST_RUN < tune.FINAL_FIRST_RUN < comparison.SEED - 1_000_000

    def test_no_control_pays_for_not_settling(self):
        found = tune.score("pi", {}, 2, 0, {"kp": 0.0, "ki": 0.0})
        assert found["constant"] == pytest.approx(4.8)  # all of the set point, all the time
        assert found["learnt"] == pytest.approx(5.2)
        assert found["not converged"] == 1.0
        assert found["objective"] == pytest.approx(
            np.mean([found[c] for c in tune.CASES]) + 5.0
        )


@pytest.fixture
def short(monkeypatch):
    """Make runs and finals short, and let the sampler learn soon."""
    monkeypatch.setattr(tune, "FINALISTS", 2)
    monkeypatch.setattr(tune, "STARTUP", 4)
    monkeypatch.setattr(tune, "FINAL_RUNS", 3)
    cases = {name: (60, 0, arguments) for name, (_, _, arguments) in tune.CASES.items()}
    monkeypatch.setattr(tune, "CASES", cases)


def search(out, controller="pi", trials=6, runs=2, status=0):
    """Run a search, and return its trials."""
    numbers = ["--trials", str(trials), "--runs", str(runs), "--jobs", "1"]
    assert tune.main([controller, *numbers, "--out", str(out)]) == status
    return pd.read_csv(out / controller / "trials.csv")


@pytest.mark.usefixtures("short")
class TestSearch:
    def test_finalists_are_judged_rounded_on_new_runs(self, tmp_path, capsys):
        trials = search(tmp_path)
        assert len(trials) == 6
        assert trials["kp"].between(*tune.TUNED["pi"]["kp"]).all()
        assert "The best" in capsys.readouterr().out
        page = (tmp_path / "pi/report.md").read_text().splitlines()
        table = [line for line in page if line.startswith("|")]
        rows = [[*map(float, line.split("|")[1:-1])] for line in table[2:]]
        assert len(rows) == 2
        for kp, ki, *_, objective, in_search in rows:
            again = tune.score("pi", {}, 3, tune.FINAL_FIRST_RUN, {"kp": kp, "ki": ki})
            assert objective == pytest.approx(again["objective"], rel=1e-3)
            assert np.isclose(trials["objective"], in_search, rtol=1e-3).any()

    def test_a_stopped_search_ends_where_it_would_have_ended(
        self, tmp_path, monkeypatch, capsys
    ):
        search(tmp_path / "whole")
        judged = []

        def interrupted(*arguments):
            judged.append(arguments)
            if len(judged) == 5:
                raise KeyboardInterrupt
            return score(*arguments)

        score = tune.score
        with monkeypatch.context() as patch:
            patch.setattr(tune, "score", interrupted)
            assert len(search(tmp_path / "halves", status=130)) == 4
        assert "Interrupted" in capsys.readouterr().out
        with (tmp_path / "halves/pi/trials.log").open("a") as log:
            log.write('{"op_code": 5, "wor')  # as where a disk is full
        search(tmp_path / "halves")
        files = (tmp_path / part / "pi/trials.csv" for part in ("whole", "halves"))
        assert len({file.read_text() for file in files}) == 1

    @pytest.mark.parametrize("sign", [1.0, -1.0])
    def test_it_learns_from_its_trials(self, sign, tmp_path):
        # The best is the lowest gain, or the highest.
        judge = lambda gains: {"objective": sign * gains["kp"]}  # noqa: E731
        rows = tune.search("by hand", tune.TUNED["pi"], judge, 25, tmp_path / "pi.csv")
        tried = np.log(rows["objective"].abs())
        assert sign * tried[15:].mean() < sign * tried[:10].mean() - 0.3

    def test_trials_of_another_search_are_not_mixed(self, tmp_path, monkeypatch):
        first = search(tmp_path, trials=2)
        assert not search(tmp_path, trials=2, runs=1).equals(first)
        monkeypatch.setattr(optuna.Study, "ask", None)  # none is new
        assert search(tmp_path, trials=2).equals(first)

    def test_a_second_search_in_the_same_folder_is_refused(self, tmp_path, refused):
        held = (
            "import sys, time; from pathlib import Path; from benchmarks import tune\n"
            "with tune._storage(Path(sys.argv[1])): print('up', flush=True); time.sleep(60)"
        )
        log = tmp_path / "pi/trials.log"
        given = ["pi", "--trials", "1", "--runs", "1", "--out", tmp_path]
        log.parent.mkdir()
        command = [sys.executable, "-c", held, str(log)]
        with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as other:
            assert other.stdout.readline() == "up\n"
            assert "--out: another search is under way" in refused(tune.main, given)
            other.kill()  # which leaves nothing that would refuse the next one
        search(tmp_path, trials=1, runs=1)

    def test_a_damaged_log_and_one_that_is_a_folder_end_in_a_sentence(self, tmp_path, capsys):
        log = tmp_path / "pi/trials.log"
        log.mkdir(parents=True)
        run = partial(tune.main, ["pi", "--trials", "1", "--runs", "1", "--out", str(tmp_path)])
        assert run() == 1
        assert "trials.log could not be written: Is a directory" in capsys.readouterr().out
        log.rmdir()
        for line in ("no JSON\n{}\n", '{"worker_id": 1}\n', "[]\n"):
            log.write_text(line)
            assert run() == 1
            assert "trials.log is damaged; delete it" in capsys.readouterr().out


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGTERM to another process")
def test_an_ended_search_shows_no_traceback(tmp_path):
    # Ended at any time of a trial: in the storage, too, where most of the time goes here.
    program = (
        "import sys; from benchmarks import tune\n"
        "tune.score = lambda *a: {'objective': 1.0, **a[-1]}; print('up', flush=True)\n"
        "sys.exit(tune.main(sys.argv[1:]))"
    )
    given = ["pi", "--trials", "100000", "--runs", "1", "--out", str(tmp_path)]
    command = [sys.executable, "-c", program, *given]
    ends = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, cwd=ROOT, **ends) as run:
        assert run.stdout.readline() == "up\n"
        time.sleep(1.0)
        run.terminate()
        out, err = run.communicate(timeout=60)
    assert (run.returncode, err) == (143, "")
    assert "Interrupted" in out


def test_defaults_are_the_best_of_the_published_searches():
    # Up to rounding; the page of the PI controller says how its search differs.
    defaults = {"nn": DirectNNController(), "pi": PIController(**SEARCHED_GAINS)}
    for controller, default in defaults.items():
        text = (ROOT / f"benchmarks/published/tune_{controller}.md").read_text("utf-8")
        rows = [line.split("|") for line in text.splitlines() if line.startswith("|")]
        best = {name.strip(): value for name, value in zip(rows[0], rows[2], strict=True)}
        for name in ROSTER[controller].gains:
            assert getattr(default, name) == pytest.approx(float(best[name]), rel=0.005)
