"""The search for gains, on small budgets."""

import json
import re

import numpy as np
import pandas as pd
import pytest

from agents import DirectNNController
from agents.pi import SEARCHED_GAINS
from benchmarks import tune
from benchmarks.controllers.own import own_controllers
from benchmarks.controllers.roster import ROSTER
from benchmarks.controllers.spans import NN_SPANS, PI_SPANS
from benchmarks.lib.command import CommandError
from benchmarks.loop.scenarios import SCENARIOS
from mptc_gym import Parameters
from tests.conftest import ROOT


class TestScore:
    def test_cases_are_met_by_no_comparison(self):
        compared = [case.arguments for case in SCENARIOS.values()]
        assert not any(case.arguments in compared for case in tune.CASES.values())

    def test_no_control_pays_for_not_settling(self):
        row = tune.score("pi", {}, 2, 0, {"kp": 0.0, "ki": 0.0})
        assert row["constant"] == pytest.approx(4.8)  # all of the set point, all the time
        assert row["learnt"] == pytest.approx(5.2)
        assert row["not converged"] == 1.0
        assert row["objective"] == pytest.approx(np.mean([row[c] for c in tune.CASES]) + 5.0)


@pytest.fixture
def short(monkeypatch):
    """Make runs and finals short, and let the sampler learn soon."""
    monkeypatch.setattr(tune, "FINALISTS", 2)
    monkeypatch.setattr(tune, "STARTUP", 4)
    monkeypatch.setattr(tune, "FINAL_RUNS", 3)
    for name, case in tune.CASES.items():
        monkeypatch.setitem(tune.CASES, name, case._replace(samples=60, first=0))


def search(out, trials=6, runs=2):
    """Run a search, and return its trials."""
    words = f"pi --trials {trials} --runs {runs} --out {out}"
    assert tune.main(words.split()) == 0
    return pd.read_csv(out / "trials.csv")


def tables_of(page):
    """Return the rows of each table on a page, with numbers as floats."""
    tables = []
    for text in re.findall(r"(?:^\|.*\n)+", page.read_text(), re.MULTILINE):
        rows = [line.strip("|\n").split("|") for line in text.splitlines()[2:]]
        tables.append([[number_or_text(cell.strip()) for cell in row] for row in rows])
    return tables


def number_or_text(cell):
    try:
        return float(cell)
    except ValueError:
        return cell


def final_objective(kp, ki):
    gains = {"kp": kp, "ki": ki}
    return tune.score("pi", {}, 3, tune.FINAL_FIRST_RUN, gains)["objective"]


class TestOtherPlants:
    PLANT = {  # noqa: RUF012
        "b": [0.0912, 0.00808], "setpoint_amplitude": 10.0, "dead_zone": 3.0, "u_max": 20.0,
        "noise_variance": 1.0, "disturbance_amplitude": 2.0, "setpoint_period": 300,
    }  # fmt: skip

    def test_a_search_on_the_paper_plant_is_the_one_of_before(self):
        for name, case in tune.cases({}).items():
            expected = Parameters(**tune.CASES[name].arguments)
            assert (case.samples, case.first) == tune.CASES[name][:2]
            assert Parameters(**case.arguments) == expected
        assert tune.spans_of("pi", {}) == PI_SPANS
        assert tune.spans_of("nn", {}) == NN_SPANS

    def test_cases_and_spans_scale_with_the_plant(self):
        cases = tune.cases(self.PLANT)
        learnt, quiet = (Parameters(**cases[name].arguments) for name in ("learnt", "constant"))
        assert (learnt.setpoint_amplitude, learnt.setpoint_period) == (10.4, 280)
        assert learnt.disturbance_amplitude == 2.0
        assert (quiet.setpoint, quiet.noise_variance, quiet.is_disturbed) == (9.6, 0.0, False)
        assert cases["learnt"].samples == 1120
        assert cases["dead zone"].arguments["dead_zone"] == pytest.approx(3.9)
        assert cases["noise"].arguments["noise_variance"] == pytest.approx(0.8)
        # Twice the gain, of the other sign: half the gains of the controller, likewise.
        low, high = tune.spans_of("pi", self.PLANT)["kp"]
        assert (low, high) == pytest.approx((-0.05, -5.0))


def test_gains_searched_on_a_plant_are_run_by_compare(short, tmp_path):
    plant = tmp_path / "plant.json"
    plant.write_text(json.dumps({"b": [0.0456, 0.00404]}))
    words = f"pi --trials 3 --runs 2 --plant {plant} --out {tmp_path}/pi"
    assert tune.main(words.split()) == 0
    file = tmp_path / "pi/gains.json"
    gains = json.loads(file.read_text())["gains"]
    assert gains["kp"] < 0.0
    (spec,) = own_controllers([f"mine={file}"]).values()
    assert spec.direction == 1
    controller, _ = spec.start({"b": [0.0456, 0.00404]}, 1, 0)
    assert (controller.kp, controller.ki) == (gains["kp"], gains["ki"])
    file.write_text('{"controller": "pi"}')
    with pytest.raises(CommandError, match=r"--agent: mine=.* must be .*: 'gains'"):
        own_controllers([f"mine={file}"])


@pytest.mark.usefixtures("short")
class TestSearch:
    def test_finalists_are_judged_rounded_on_new_runs(self, tmp_path, capsys):
        trials = search(tmp_path / "search")
        assert len(trials) == 6
        assert trials["kp"].between(*PI_SPANS["kp"]).all()
        assert "The best" in capsys.readouterr().out
        best, fixed = tables_of(tmp_path / "search/report.md")
        assert len(best) == 2
        for kp, ki, *_, objective, in_search in best:
            assert objective == pytest.approx(final_objective(kp, ki), rel=1e-3)
            assert np.isclose(trials["objective"], in_search, rtol=1e-3).any()
        assert [row[:4] for row in fixed] == [
            ["PI (1992)", "the paper", 2.2, 0.3],
            ["PI (searched)", "the search of version 0.1", *SEARCHED_GAINS.values()],
        ]
        for _, _, kp, ki, objective in fixed:
            assert objective == pytest.approx(final_objective(kp, ki), rel=1e-3)

    def test_a_stopped_search_goes_on_where_it_was(self, tmp_path, monkeypatch):
        uninterrupted, score, calls = search(tmp_path / "whole"), tune.score, []

        def score_or_stop(*arguments):
            calls.append(arguments)
            if len(calls) == 5:
                raise KeyboardInterrupt
            return score(*arguments)

        monkeypatch.setattr(tune, "score", score_or_stop)
        out = tmp_path / "parts"
        assert tune.main(f"pi --trials 6 --runs 2 --out {out}".split()) == 130
        calls *= 2  # 10 calls: no further stop
        search(out, runs=1)  # A search with other runs has no influence.
        before = len(calls)
        assert search(out).equals(uninterrupted)
        assert len(calls) == before + 2 + 2 + 2  # 4 are kept; then 2 finalists, 2 fixed gains


def test_the_pages_of_the_searches_name_the_gains_of_other_commands():
    paper = DirectNNController()
    gains = {"nn": [getattr(paper, name) for name in NN_SPANS], "pi": SEARCHED_GAINS.values()}
    for name, values in gains.items():
        page = (ROOT / f"benchmarks/published/tune_{name}.md").read_text(encoding="utf-8")
        assert {f"{value:g}" for value in values} <= set(re.findall(r"\d+(?:\.\d+)?", page))


@pytest.mark.parametrize("name", tune.SPANS)
def test_controllers_of_other_commands_have_the_gains_of_a_search(name, monkeypatch):
    """The score of the gains is that of the controller itself."""
    monkeypatch.setattr(tune, "FINAL_RUNS", 2)
    constant = {"constant": tune.TuningCase(300, 0, {"setpoint": 4.8})}
    monkeypatch.setattr(tune, "CASES", constant)
    table = tune.fixed_gains(name, {})
    for other, objective in zip(tune.FIXED_GAINS[name], table["objective"], strict=True):
        case = tune.cases({})["constant"]
        trajectory = ROSTER[other].run(case.arguments, 300, 2, tune.FINAL_FIRST_RUN)
        unsettled = 1.0 - tune.settled(trajectory).mean()
        error = np.median(tune.mean_error(trajectory))
        assert float(objective) == pytest.approx(error + 5.0 * unsettled, rel=1e-3)
