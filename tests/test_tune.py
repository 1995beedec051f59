"""The search for gains, on small budgets."""

import logging
from dataclasses import replace
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
from benchmarks.loop import scenarios
from benchmarks.tune import command as tune
from benchmarks.tune.__main__ import TUNED, main
from tests.conftest import ROOT


class TestScore:
    def test_scenarios_and_seeds_are_met_by_no_comparison(self):
        compared = [scenario.parameters for scenario in scenarios.SCENARIOS.values()]
        assert not any(scenario.parameters in compared for scenario, _ in tune.SCENARIOS)
        assert tune.FIRST_RUN < tune.FINAL_FIRST_RUN < comparison.SEED - 1_000_000

    def test_an_idle_controller_pays_for_not_settling(self):
        found = tune.score("pi", {}, 2, 0, {"kp": 0.0, "ki": 0.0})
        assert found["constant"] == pytest.approx(4.8)  # all of the set point, all the time
        assert found["learnt"] == pytest.approx(5.2)
        assert found["not converged"] == 1.0
        medians = [found[scenario.name] for scenario, _ in tune.SCENARIOS]
        assert found["objective"] == pytest.approx(np.mean(medians) + 5.0)

    def test_what_comes_before_the_first_sample_does_not_count(self):
        found = tune.score("pi", {}, 1, 0, {})["learnt"]
        scenario, first = {s.name: (s, n) for s, n in tune.SCENARIOS}["learnt"]
        runs = Batch(1).run(PIController(), scenario.samples, **scenario.arguments)
        error = np.abs(runs.error)
        assert found == pytest.approx(error[first:].mean())
        assert found != pytest.approx(error.mean())

    def test_the_defaults_converge_and_the_first_run_is_honoured(self):
        first, other = (tune.score("nn", {}, 10, first_run, {}) for first_run in (0, 7))
        assert first["not converged"] == 0.0
        assert first["objective"] < 1.5
        assert first["noise"] != other["noise"]


@pytest.fixture
def short(monkeypatch):
    """Make runs and finals short, and let the sampler learn soon."""
    for name in TUNED:
        tuning = replace(ROSTER[name].tuning, finalists=2, startup=4)
        monkeypatch.setitem(ROSTER, name, replace(ROSTER[name], tuning=tuning))
    monkeypatch.setattr(tune, "FINAL_RUNS", 3)
    scenarios = [(replace(scenario, samples=60), 0) for scenario, _ in tune.SCENARIOS]
    monkeypatch.setattr(tune, "SCENARIOS", scenarios)


def search(out, controller="pi", trials=6, runs=2, status=0):
    """Run a search, and return its trials."""
    numbers = ["--trials", str(trials), "--runs", str(runs), "--jobs", "1"]
    assert main([controller, *numbers, "--out", str(out)]) == status
    return pd.read_csv(out / f"{controller}.csv")


@pytest.mark.usefixtures("short")
class TestSearch:
    @pytest.mark.parametrize("controller", ["nn", "pi"])
    def test_files(self, controller, tmp_path, capsys):
        table = search(tmp_path, controller)
        assert len(table) == 6
        page = (tmp_path / f"{controller}.md").read_text()
        for name, (low, high) in ROSTER[controller].tuning.space.items():
            assert table[name].between(low, high).all()
            assert name in page
        assert "The best" in capsys.readouterr().out

    def test_finalists_are_judged_rounded_on_new_runs(self, tmp_path, monkeypatch):
        pages = Mock(return_value="")
        monkeypatch.setattr(tune, "_page", pages)
        trials = search(tmp_path)
        _, finals, *_ = pages.call_args.args
        assert len(finals) == 2
        for _, best in finals.iterrows():
            gains = {name: float(f"{best[name]:.3g}") for name in ("kp", "ki")}
            assert (best["kp"], best["ki"]) == tuple(gains.values())
            again = tune.score("pi", {}, 3, tune.FINAL_FIRST_RUN, gains)
            assert best["objective"] == again["objective"]
            assert best["in the search"] in set(trials["objective"])

    def test_a_stopped_search_ends_where_it_would_have_ended(
        self, tmp_path, monkeypatch, capsys, caplog
    ):
        monkeypatch.setattr(logging.getLogger("optuna"), "propagate", True)
        search(tmp_path / "whole")
        at_the_fifth = [*[DEFAULT] * 4 * len(tune.SCENARIOS), KeyboardInterrupt]
        with monkeypatch.context() as patch:
            judged = Mock(wraps=tune.mean_error, side_effect=at_the_fifth)
            patch.setattr(tune, "mean_error", judged)
            assert len(search(tmp_path / "halves", status=130)) == 4
        assert "Interrupted" in capsys.readouterr().out
        assert not caplog.records  # no traceback of the trial that was interrupted
        with (tmp_path / "halves/trials.log").open("a") as log:
            log.write('{"op_code": 5, "wor')  # as where a disk is full
        search(tmp_path / "halves")
        for name in ("pi.csv", "pi.md"):
            one, other = ((tmp_path / part / name).read_text() for part in ("whole", "halves"))
            assert one == other

    @pytest.mark.parametrize("sign", [1.0, -1.0])
    def test_it_learns_from_its_trials(self, sign, tmp_path):
        # The best is the lowest gain, or the highest.
        rows = tune.search(
            tune.tuning_of("pi"),
            lambda gains: {"objective": sign * gains["kp"]},
            30,
            tmp_path / "pi.csv",
        )
        tried = np.log(rows["objective"].abs())
        assert sign * tried[20:].mean() < sign * tried[:10].mean() - 0.3

    def test_trials_of_another_search_are_not_mixed(self, tmp_path, monkeypatch):
        first = search(tmp_path, trials=2)
        assert not search(tmp_path, trials=2, runs=1).equals(first)
        monkeypatch.setattr(optuna.Study, "optimize", None)  # none is new
        assert search(tmp_path, trials=2).equals(first)


def test_defaults_are_the_best_of_the_published_searches():
    # Up to rounding; the page of the PI controller says how its search differs.
    defaults = {"nn": DirectNNController(), "pi": PIController(**SEARCHED_GAINS)}
    for controller, default in defaults.items():
        text = (ROOT / f"benchmarks/published/tune_{controller}.md").read_text("utf-8")
        rows = [line.split("|") for line in text.splitlines() if line.startswith("|")]
        best = {name.strip(): value for name, value in zip(rows[0], rows[2], strict=True)}
        for name in ROSTER[controller].tuning.space:
            assert getattr(default, name) == pytest.approx(float(best[name]), rel=0.005)
