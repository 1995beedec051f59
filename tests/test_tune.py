"""The search for gains, on small budgets."""

from dataclasses import replace
from functools import partial
from unittest.mock import DEFAULT, Mock

import numpy as np
import optuna
import pandas as pd
import pytest

from agents import DirectNNController, PIController
from agents.pi import SEARCHED_GAINS
from benchmarks.claims.runs import Batch
from benchmarks.compare import comparison
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.fan_out import FanOut
from benchmarks.loop import scenarios
from benchmarks.tune import objective
from benchmarks.tune import search as tune
from benchmarks.tune.__main__ import TUNED, main
from tests.conftest import ROOT

optuna.logging.set_verbosity(optuna.logging.WARNING)


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Few runs for the finalists, and a sampler that learns soon."""
    for name in TUNED:
        tuning = replace(ROSTER[name].tuning, finalists=2, startup=4)
        monkeypatch.setitem(ROSTER, name, replace(ROSTER[name], tuning=tuning))
    monkeypatch.setattr(tune, "FINAL_RUNS", 3)


def run_tune(out, controller="pi", trials=6, jobs=1):
    options = ["--trials", str(trials), "--runs", "2", "--out", str(out), "--jobs", str(jobs)]
    return main([controller, *options])


def assert_the_same(one, other):
    for name in ("pi.csv", "pi.md"):
        assert (one / name).read_text() == (other / name).read_text()


def score(name, runs, first_run=0, **gains):
    """Judge a controller with these gains."""
    (factory,) = ROSTER[name].members()
    factory = replace(factory, make=partial(factory.make, **gains))
    return tune.score(factory, {}, runs, first_run, penalty=5.0)


class TestScore:
    def test_scenarios_and_seeds_are_met_by_no_comparison(self):
        compared = [scenario.parameters for scenario in scenarios.SCENARIOS.values()]
        assert not any(scenario.parameters in compared for scenario, _ in tune.SCENARIOS)
        assert tune.FIRST_RUN < tune.FINAL_FIRST_RUN < comparison.SEED - 1_000_000

    def test_an_idle_controller_pays_for_not_settling(self):
        found = score("pi", 2, kp=0.0, ki=0.0)
        assert found["constant"] == pytest.approx(4.8)  # all of the set point, all the time
        assert found["learnt"] == pytest.approx(5.2)
        assert found["not converged"] == 1.0
        medians = [found[scenario.name] for scenario, _ in tune.SCENARIOS]
        assert found["objective"] == pytest.approx(np.mean(medians) + 5.0)

    def test_what_comes_before_the_first_sample_does_not_count(self):
        found = score("pi", 1)["learnt"]
        scenario, first = {s.name: (s, n) for s, n in tune.SCENARIOS}["learnt"]
        runs = Batch(1).run(PIController(), scenario.samples, **scenario.arguments)
        error = np.abs(runs.error)
        assert found == pytest.approx(error[first:].mean())
        assert found != pytest.approx(error.mean())

    def test_the_defaults_converge(self):
        found = score("nn", 20)
        assert found["not converged"] == 0.0
        assert found["objective"] < 1.5

    def test_the_first_run_is_honoured(self):
        first, again, other = (score("nn", 2, first_run) for first_run in (0, 0, 7))
        assert first == again
        assert first["noise"] != other["noise"]


@pytest.fixture
def short(monkeypatch):
    """Make the runs short, so that a score takes no time."""
    scenarios = [(replace(scenario, samples=60), 0) for scenario, _ in tune.SCENARIOS]
    monkeypatch.setattr(objective, "SCENARIOS", scenarios)


@pytest.mark.usefixtures("short")
class TestSearch:
    @pytest.mark.parametrize("controller", ["nn", "pi"])
    def test_files(self, controller, tmp_path, capsys):
        assert run_tune(tmp_path, controller) == 0
        space = ROSTER[controller].tuning.space
        table = pd.read_csv(tmp_path / f"{controller}.csv")
        assert len(table) == 6
        for name, (low, high) in space.items():
            assert table[name].between(low, high).all()
        page = (tmp_path / f"{controller}.md").read_text()
        assert all(name in page for name in space)
        assert "The best" in capsys.readouterr().out

    def test_finalists_are_judged_rounded_on_new_runs(self, tmp_path):
        run_tune(tmp_path)
        search = tune.Search(ROSTER["pi"], 2, {}, tmp_path, FanOut(jobs=1))
        report = search.report(search.run(6))
        assert len(report) == 2
        for _, best in report.iterrows():
            gains = {name: float(f"{best[name]:.3g}") for name in ("kp", "ki")}
            assert (best["kp"], best["ki"]) == tuple(gains.values())
            again = score("pi", 3, tune.FINAL_FIRST_RUN, **gains)
            assert best["objective"] == again["objective"]
            assert best["objective"] != best["in the search"]

    def test_a_stopped_search_ends_where_it_would_have_ended(
        self, tmp_path, monkeypatch, capsys
    ):
        run_tune(tmp_path / "whole")
        at_the_fifth = [*[DEFAULT] * 4, KeyboardInterrupt]
        with monkeypatch.context() as patch:
            patch.setattr(tune, "score", Mock(wraps=tune.score, side_effect=at_the_fifth))
            assert run_tune(tmp_path / "halves") == 130
        assert "Interrupted" in capsys.readouterr().out
        assert len(pd.read_csv(tmp_path / "halves/pi.csv")) == 4
        assert run_tune(tmp_path / "halves") == 0
        assert_the_same(tmp_path / "whole", tmp_path / "halves")

    def test_side_by_side_is_one_after_the_other(self, tmp_path, monkeypatch):
        # Other processes have the scenarios as they are.
        monkeypatch.setattr(objective, "SCENARIOS", tune.SCENARIOS)
        for jobs in (1, 2):
            run_tune(tmp_path / str(jobs), jobs=jobs)
        assert_the_same(tmp_path / "1", tmp_path / "2")

    @pytest.mark.parametrize("sign", [1.0, -1.0])
    def test_it_learns_from_its_trials(self, sign, tmp_path, monkeypatch):
        # The best is the lowest gain, or the highest.
        judged = lambda factory, *_: {"objective": sign * factory.make.keywords["kp"]}  # noqa: E731
        monkeypatch.setattr(tune, "score", judged)
        rows = tune.Search(ROSTER["pi"], 2, {}, tmp_path, FanOut(jobs=1)).run(30)
        tried = np.log(rows["objective"].abs())
        assert sign * tried[20:].mean() < sign * tried[:10].mean() - 0.3

    def test_defaults_are_the_best_of_the_published_searches(self):
        # Up to rounding; the page of the PI controller says how its search differs.
        defaults = {"nn": DirectNNController(), "pi": PIController(**SEARCHED_GAINS)}
        for controller, default in defaults.items():
            text = (ROOT / f"benchmarks/published/tune_{controller}.md").read_text("utf-8")
            rows = [line.split("|") for line in text.splitlines() if line.startswith("|")]
            best = {name.strip(): value for name, value in zip(rows[0], rows[2], strict=True)}
            for name in ROSTER[controller].tuning.space:
                assert getattr(default, name) == pytest.approx(float(best[name]), rel=0.005)


@pytest.fixture
def search(tmp_path, short, monkeypatch):
    """Return a function that searches to a number of trials, and says how many were new."""
    score = Mock(wraps=tune.score)
    monkeypatch.setattr(tune, "score", score)

    def go(trials, runs=1):
        score.reset_mock()
        rows = tune.Search(ROSTER["pi"], runs, {}, tmp_path, FanOut(jobs=1)).run(trials)
        return rows, score.call_count

    return go


class TestKeptTrials:
    def test_those_of_another_search_are_not_mixed(self, search):
        first, _ = search(2)
        assert search(2, runs=2)[1] == 2
        again, new = search(2)
        pd.testing.assert_frame_equal(first, again)
        assert new == 0
