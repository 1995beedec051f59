"""The search for gains, on small budgets."""

import json
import re

import numpy as np
import pandas as pd
import pytest

from agents import DirectNNController
from agents.pi import SEARCHED_GAINS
from benchmarks import tune
from benchmarks.controllers.known_plant import KnownPlant
from benchmarks.controllers.own import own_controllers
from benchmarks.controllers.roster import ROSTER
from benchmarks.controllers.spans import NN_SPANS, PI_SPANS
from benchmarks.lib.command import CommandError
from benchmarks.loop.scenarios import SCENARIOS
from mptc_gym import Parameters
from tests.conftest import ROOT


def test_cases_are_met_by_no_comparison():
    compared = [case.arguments for case in SCENARIOS.values()]
    assert not any(case.arguments in compared for case in tune.CASES.values())


def test_no_control_pays_for_not_settling():
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
    monkeypatch.setattr(tune, "RUNS", 2)
    for name, case in tune.CASES.items():
        monkeypatch.setitem(tune.CASES, name, case._replace(samples=60, first=0))


def search(out, plant=""):
    """Run a search, and return its trials."""
    assert tune.main(f"pi --trials 6 --out {out} {plant}".split()) == 0
    return pd.read_csv(out / "trials.csv")


PLANT = {
    "b": [0.0912, 0.00808], "setpoint_amplitude": 10.0, "dead_zone": 3.0, "u_max": 20.0,
    "noise_variance": 1.0, "disturbance_amplitude": 2.0, "setpoint_period": 300,
}  # fmt: skip


def test_cases_scale_with_the_plant():
    for name, case in tune.cases({}).items():
        assert Parameters(**case.arguments) == Parameters(**tune.CASES[name].arguments)
    cases = tune.cases(PLANT)
    learnt, quiet = (Parameters(**cases[name].arguments) for name in ("learnt", "constant"))
    assert (learnt.setpoint_amplitude, learnt.setpoint_period) == (10.4, 280)
    assert learnt.disturbance_amplitude == 2.0
    assert (quiet.setpoint, quiet.noise_variance, quiet.is_disturbed) == (9.6, 0.0, False)
    assert cases["learnt"].samples == 1120
    assert cases["dead zone"].arguments["dead_zone"] == pytest.approx(3.9)
    assert cases["noise"].arguments["noise_variance"] == pytest.approx(0.8)


def test_gains_searched_on_a_plant_are_run_by_compare(short, tmp_path, capsys):
    plant = tmp_path / "plant.json"
    plant.write_text(json.dumps({"b": [0.0456, 0.00404]}))
    chosen = f"--plant {plant} --set dead_zone=5.0"
    assert tune.main(f"pi --trials 3 {chosen} --out {tmp_path}/pi".split()) == 0
    assert capsys.readouterr().out.strip().endswith(f"my-pi={tmp_path}/pi/gains.json {chosen}")
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
        table = tune.finals("pi", {}, ["kp", "ki"], trials)
        assert [*table["gains"]] == [
            *["of the search"] * 2, "of PI (1992)", "of PI (searched)",
        ]  # fmt: skip
        assert table.loc[2:, ["kp", "ki"]].to_numpy().tolist() == [
            [2.2, 0.3], [*SEARCHED_GAINS.values()],
        ]  # fmt: skip
        for row in table.itertuples():
            gains = {"kp": row.kp, "ki": row.ki}
            new_runs = tune.score("pi", {}, 3, tune.FINAL_FIRST_RUN, gains)
            assert row.objective == new_runs["objective"]
        best = trials.nsmallest(2, "objective").sort_values("kp")
        finalists = table[:2].sort_values("kp")
        assert [*finalists["in the search"]] == pytest.approx([*best["objective"]])
        assert [*finalists["kp"]] == [float(f"{kp:.3g}") for kp in best["kp"]]
        assert table["objective"][:2].is_monotonic_increasing
        written = json.loads((tmp_path / "search/gains.json").read_text())["gains"]
        assert written == table.loc[0, ["kp", "ki"]].to_dict()

    def test_a_stopped_search_goes_on_where_it_was(self, tmp_path, monkeypatch):
        uninterrupted, score, calls = search(tmp_path / "whole"), tune.score, []

        def score_or_stop(*arguments):
            calls.append(arguments)
            if len(calls) == 5:
                raise KeyboardInterrupt
            return score(*arguments)

        monkeypatch.setattr(tune, "score", score_or_stop)
        out = tmp_path / "parts"
        assert tune.main(f"pi --trials 6 --out {out}".split()) == 130
        calls *= 2  # 10 calls: no further stop
        search(out, "--set delay=3")  # A search on another plant has no influence.
        before = len(calls)
        assert search(out).equals(uninterrupted)
        assert len(calls) == before + 2 + 2 + 2  # 4 are kept; then 2 finalists, 2 present gains


def test_the_pages_of_the_searches_name_the_gains_of_other_commands():
    paper = DirectNNController()
    gains = {"nn": [getattr(paper, name) for name in NN_SPANS], "pi": SEARCHED_GAINS.values()}
    for name, values in gains.items():
        page = (ROOT / f"benchmarks/published/tune_{name}.md").read_text(encoding="utf-8")
        assert {f"{value:g}" for value in values} <= set(re.findall(r"\d+(?:\.\d+)?", page))


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize("name", tune.PRESENT)
def test_the_present_gains_are_those_of_the_controllers_themselves(name):
    spans = ROSTER[name].spans(KnownPlant(Parameters()))
    middle = {gain: sum(span) / 2 for gain, span in spans.items()}
    trials = pd.DataFrame([tune.score(name, {}, 2, 0, middle)])
    table = tune.finals(name, {}, list(spans), trials).iloc[1:]
    case = tune.cases({})["dead zone"]
    for other, median in zip(tune.PRESENT[name], table["dead zone"], strict=True):
        seed = tune.FINAL_FIRST_RUN + tune.SPACING_OF_CASES
        trajectory = ROSTER[other].run(case.arguments, case.samples, 3, seed)
        assert median == pytest.approx(np.median(tune.mean_error(trajectory)), rel=1e-12)


@pytest.mark.parametrize(
    ("name", "gain", "span"), [("pi", "kp", (-0.05, -5.0)), ("nn", "weight_scale", (0.05, 2.0))]
)
def test_spans_scale_with_the_plant(name, gain, span):
    spans = ROSTER[name].spans
    assert spans(KnownPlant(Parameters())) == {"pi": PI_SPANS, "nn": NN_SPANS}[name]
    # Twice the gain, of the other sign: half the gains of a controller, likewise.
    twice = KnownPlant(Parameters(**PLANT))
    assert spans(twice)[gain] == pytest.approx(span)
