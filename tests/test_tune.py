"""The search for gains, on small budgets."""

import json
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np
import optuna
import pandas as pd
import pytest

from agents import DirectNNController, PIController
from agents.pi import SEARCHED_GAINS
from benchmarks.claims.runs import Batch
from benchmarks.compare import comparison
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib import fingerprint, storage
from benchmarks.lib.fan_out import FanOut
from benchmarks.loop import scenarios
from benchmarks.train import ppo, ppo_training
from benchmarks.tune import command as command
from benchmarks.tune import objective
from benchmarks.tune import search as tune
from benchmarks.tune.__main__ import main
from benchmarks.tune.options import TUNED
from tests.small_training import SMALL

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


def made(name, **gains):
    """Return the factory of a controller, with these gains."""
    (factory,) = ROSTER[name].members()
    return replace(factory, make=partial(factory.make, **gains))


class TestScore:
    def test_scenarios_and_seeds_are_met_by_no_comparison(self):
        compared = [scenario.parameters for scenario in scenarios.SCENARIOS.values()]
        assert not any(scenario.parameters in compared for scenario, _ in tune.SCENARIOS)
        assert tune.FIRST_RUN < tune.FINAL_FIRST_RUN < comparison.SEED - 1_000_000

    def test_an_idle_controller_pays_for_not_settling(self):
        score = tune.score(made("pi", kp=0.0, ki=0.0), runs=2, first_run=0)
        assert score["constant"] == pytest.approx(4.8)  # all of the set point, all the time
        assert score["learnt"] == pytest.approx(5.2)
        assert score["not converged"] == 1.0
        medians = [score[scenario.name] for scenario, _ in tune.SCENARIOS]
        assert score["objective"] == pytest.approx(np.mean(medians) + 5.0)

    def test_what_comes_before_the_first_sample_does_not_count(self):
        score = tune.score(made("pi"), runs=1, first_run=0)
        scenario, first = {s.name: (s, n) for s, n in tune.SCENARIOS}["learnt"]
        runs = Batch(1).run(PIController(), scenario.samples, **scenario.arguments)
        error = np.abs(runs.error)
        assert score["learnt"] == pytest.approx(error[first:].mean())
        assert score["learnt"] != pytest.approx(error.mean())

    def test_the_defaults_converge(self):
        score = tune.score(made("nn"), runs=20, first_run=0)
        assert score["not converged"] == 0.0
        assert score["objective"] < 1.5

    def test_the_first_run_is_honoured(self):
        first, again, other = (
            tune.score(made("nn"), runs=2, first_run=run) for run in (0, 0, 7)
        )
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
        search = tune.Search(ROSTER["pi"], 2, tmp_path, FanOut(1))
        report = search.report(6)
        assert len(report) == 2
        for _, best in report.iterrows():
            gains = {name: float(f"{best[name]:.3g}") for name in ("kp", "ki")}
            assert (best["kp"], best["ki"]) == tuple(gains.values())
            again = tune.score(made("pi", **gains), 3, tune.FINAL_FIRST_RUN)
            assert best["objective"] == again["objective"]
            assert best["objective"] != best["in the search"]

    def test_a_stopped_search_ends_where_it_would_have_ended(
        self, tmp_path, monkeypatch, capsys
    ):
        run_tune(tmp_path / "whole")
        calls, score = iter(range(5)), tune.score

        def stop_at_the_fifth(*arguments):
            if next(calls) == 4:
                raise KeyboardInterrupt
            return score(*arguments)

        with monkeypatch.context() as patch:
            patch.setattr(tune, "score", stop_at_the_fifth)
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

    def test_it_learns_from_its_trials(self, tmp_path):
        # Otherwise other scores would bring the same gains.
        run_tune(tmp_path / "one")
        table = pd.read_csv(tmp_path / "one/pi.csv")
        (tmp_path / "two").mkdir()
        kept = storage.unseal((tmp_path / "one/pi.json").read_text())
        turned = table.head(5).assign(objective=-table["objective"])
        kept["trials"] = turned.to_dict("records")
        (tmp_path / "two/pi.json").write_text(storage.seal(kept))
        run_tune(tmp_path / "two")
        other = pd.read_csv(tmp_path / "two/pi.csv")
        assert other["kp"].iloc[5] != pytest.approx(table["kp"].iloc[5])

    def test_another_search_is_not_continued(self, tmp_path, refused):
        run_tune(tmp_path)
        assert "other runs" in refused(main, ["pi", "--runs", 3, "--out", tmp_path])
        assert len(pd.read_csv(tmp_path / "pi.csv")) == 6

    def test_defaults_are_in_the_space(self):
        # Those of PPO are not from its search.
        defaults = {"nn": DirectNNController(), "pi": PIController(**SEARCHED_GAINS)}
        for controller, default in defaults.items():
            for name, (low, high) in ROSTER[controller].tuning.space.items():
                assert low < getattr(default, name) < high

    def test_ppo_is_trained_once_a_trial(self, tmp_path, monkeypatch):
        trained = []

        state = ppo_training.begin(SMALL).policy.state_dict()
        network = ppo_training.exported(state, SMALL)

        def train(arguments):
            trained.append(arguments)
            return network

        monkeypatch.setattr(ppo_training, "train", train)
        assert run_tune(tmp_path, "ppo", trials=2) == 0
        search = [ppo.TUNING_SEED + i for i in range(2)]
        final = [ppo.FINAL_SEED + i for i in range(4)]
        assert [arguments.seed for arguments in trained] == [*search * 2, *final * 2]
        table = pd.read_csv(tmp_path / "ppo.csv")
        assert list(table["gamma"]) == [trained[0].gamma, trained[2].gamma]


@pytest.fixture
def search(tmp_path, short):
    """Return a function that begins a search, or goes on with it, to a number of trials."""

    def go(trials):
        search = tune.Search(ROSTER["pi"], 1, tmp_path, FanOut(1))
        search.run(trials)
        return search.trials

    return go


class TestKeptTrials:
    @pytest.mark.parametrize(
        "edited", ["agents.pi", "benchmarks.tune.objective", "benchmarks.loop.metrics"]
    )
    def test_those_before_and_after_an_edit_are_not_mixed(self, search, edited, monkeypatch):
        search(2)
        self.edit(edited, monkeypatch)
        with pytest.raises(ValueError, match="with other code: to begin anew, remove"):
            search(3)

    @pytest.mark.parametrize(
        "edited", ["benchmarks.controllers.engineered", "benchmarks.tune.search"]
    )
    def test_an_edit_elsewhere_does_not_matter(self, search, edited, monkeypatch):
        before = search(2)
        self.edit(edited, monkeypatch)
        pd.testing.assert_frame_equal(search(3).head(2), before)

    @staticmethod
    def edit(edited, monkeypatch):
        real = fingerprint.code
        for module in (fingerprint, tune):
            monkeypatch.setattr(
                module, "code", lambda name: "edited" if name == edited else real(name)
            )

    def test_without_its_json_a_search_is_not_continued(self, search, tmp_path):
        search(2)
        (tmp_path / "pi.json").unlink()
        with pytest.raises(ValueError, match=r"pi\.json, which .*pi\.csv .* is missing: bring"):
            search(3)

    def test_damage_is_named(self, search, tmp_path, rng):
        search(2)
        kept = tmp_path / "pi.json"
        text = kept.read_text()
        digits = [i for i, letter in enumerate(text) if letter.isdigit()]
        flipped = [
            text[:i] + str(9 - int(text[i])) + text[i + 1 :] for i in rng.choice(digits, 20)
        ]
        cut = [text[:i] for i in rng.integers(len(text), size=20)]
        for damaged in (*flipped, *cut, "", "null", "[]", "{}", "\0\0"):
            # The last of 17 digits can be another without a change of the number.
            with suppress(ValueError):
                if json.loads(damaged) == json.loads(text):
                    continue
            kept.write_text(damaged)
            with pytest.raises(ValueError, match=r"pi\.json is damaged .* remove"):
                search(3)
        kept.write_text(text)
        assert len(search(3)) == 3

    def test_the_table_for_readers_is_written_anew(self, search, tmp_path):
        search(2)
        (tmp_path / "pi.csv").write_bytes(b"\0\xff")
        pd.testing.assert_frame_equal(search(3), pd.read_csv(tmp_path / "pi.csv"))
