"""The search for gains, on small budgets."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from agents import DirectNNController
from agents.pi import SEARCHED_GAINS
from benchmarks import tune
from benchmarks.controllers.known_plant import PAPER, KnownPlant
from benchmarks.controllers.own import own_controllers
from benchmarks.controllers.roster import ROSTER
from benchmarks.controllers.spans import SPANS
from benchmarks.lib.command import CommandError
from benchmarks.loop.scenarios import SCENARIOS
from mptc_gym import Parameters
from tests.conftest import ROOT

PLANT = {
    "b": [0.0912, 0.00808], "setpoint_amplitude": 10.0, "dead_zone": 3.0, "u_max": 20.0,
    "noise_variance": 1.0, "disturbance_amplitude": 2.0, "setpoint_period": 300,
}  # fmt: skip


def test_cases_are_met_by_no_comparison():
    compared = [case.parameters for case in SCENARIOS.values()]
    assert not any(Parameters(**case.arguments) in compared for case in tune.cases({}).values())


def test_cases_scale_with_the_plant():
    cases = tune.cases(PLANT)
    learnt, quiet = (Parameters(**cases[name].arguments) for name in ("learnt", "constant"))
    assert (learnt.setpoint_amplitude, learnt.setpoint_period) == (10.4, 280)
    assert learnt.disturbance_amplitude == 2.0
    assert (quiet.setpoint, quiet.noise_variance, quiet.is_disturbed) == (9.6, 0.0, False)
    assert cases["learnt"][:2] == (1120, 560)
    assert cases["dead zone"].arguments["dead_zone"] == pytest.approx(3.9)
    assert cases["noise"].arguments["noise_variance"] == pytest.approx(0.8)


def test_the_noise_of_a_calm_plant_is_a_tenth_of_the_set_point_at_the_output():
    assert tune.cases({})["noise"].arguments["noise_variance"] == 0.4  # of the published search
    calm = {"a": [1.0, -0.9], "b": [20.0], "c": [1.0], "setpoint_amplitude": 2.0}
    variance = tune.cases(calm)["noise"].arguments["noise_variance"]
    assert variance / (1.0 - 0.9**2) == pytest.approx(0.2**2)


def test_the_interval_of_kp_follows_from_the_delay():
    lag_dominant = KnownPlant({"a": [1.0, -0.98], "b": [0.02], "delay": 0})
    least, most = SPANS["pi"](lag_dominant)["kp"]
    # SIMC: T / (2 K theta), of the other sign as u = -Kp e.
    assert abs(least) < 25.0 < abs(most)


def test_a_gain_at_an_edge_is_said():
    spans = {"kp": (-0.1, -10.0), "ki": (0.1, 1.0)}
    assert tune.at_edges({"kp": -1.0, "ki": 0.5}, spans) == []
    (sentence,) = tune.at_edges({"kp": -9.9, "ki": 0.5}, spans)
    assert sentence.startswith("The best kp lies at the edge")


def test_no_control_pays_for_not_settling():
    idle = replace(ROSTER["pi"], arguments={"kp": 0.0, "ki": 0.0})
    scores = tune.score(idle, {}, 2, 0)
    assert scores["constant"] == pytest.approx(4.8)  # all of the set point, all the time
    assert scores["learnt"] == pytest.approx(5.2)
    assert scores["not converged"] == 1.0
    medians = [scores[name] for name in tune.cases({})]
    assert scores["objective"] == pytest.approx(np.mean(medians) + 5.0)


@pytest.mark.parametrize(
    ("name", "gain", "of_paper", "of_plant"),
    [("pi", "kp", (0.1, 10.0), (-0.05, -5.0)), ("nn", "weight_scale", *[(0.05, 2.0)] * 2)],
)
def test_spans_scale_with_the_plant(name, gain, of_paper, of_plant):
    # Twice the gain, of the other sign: half the gains of a controller, likewise.
    for plant, span in ((PAPER, of_paper), (KnownPlant(PLANT), of_plant)):
        assert SPANS[name](plant)[gain] == pytest.approx(span)


def test_the_pages_of_the_searches_name_the_gains_of_other_commands():
    paper = DirectNNController()
    gains = {"nn": [getattr(paper, name) for name in SPANS["nn"](PAPER)]}
    gains["pi"] = [*SEARCHED_GAINS.values()]
    for name, values in gains.items():
        page = (ROOT / f"benchmarks/published/tune_{name}.md").read_text(encoding="utf-8")
        assert {f"{value:g}" for value in values} <= set(re.findall(r"\d+(?:\.\d+)?", page))


@pytest.fixture
def short(monkeypatch):
    """Make runs and finals short, and let the sampler learn soon."""
    for name, value in {"FINALISTS": 2, "STARTUP": 4, "FINAL_RUNS": 3, "RUNS": 2}.items():
        monkeypatch.setattr(tune, name, value)
    cases = tune.cases
    monkeypatch.setattr(
        tune,
        "cases",
        lambda plant: {
            name: case._replace(samples=60, first=0) for name, case in cases(plant).items()
        },
    )


def gains_in(folder):
    return json.loads((folder / "gains.json").read_text())["gains"]


@pytest.mark.usefixtures("short")
class TestSearch:
    def test_gains_searched_on_a_plant_are_run_by_compare(self, tmp_path, capsys):
        plant = tmp_path / "plant.json"
        plant.write_text(json.dumps({"b": [0.0456, 0.00404]}))
        chosen = f"--plant {plant} --set dead_zone=5.0"
        assert tune.main(f"pi --trials 3 {chosen} --out {tmp_path}/pi".split()) == 0
        file = tmp_path / "pi/gains.json"
        printed = capsys.readouterr().out.strip()
        assert printed.endswith(f"my-pi={file} {chosen}")
        assert "of PI (SIMC)" in printed
        assert "of PI (1992)" not in printed  # which would run in positive feedback
        (spec,) = own_controllers([f"mine={file}"]).values()
        assert spec.direction == 1
        controller, _ = spec.start({"b": [0.0456, 0.00404]}, 1, 0)
        assert {"kp": controller.kp, "ki": controller.ki} == gains_in(tmp_path / "pi")
        assert controller.kp < 0.0
        file.write_text('{"controller": "pi"}')
        with pytest.raises(CommandError, match=r"--agent: mine=.* must be .*: 'gains'"):
            own_controllers([f"mine={file}"])

    @pytest.mark.parametrize("name", SPANS)
    def test_finalists_are_judged_rounded_on_new_runs_beside_present_gains(
        self, name, tmp_path
    ):
        spans = SPANS[name](PAPER)
        trials = tune.search(name, {}, spans, 5, tmp_path)
        best = sorted(trials, key=lambda trial: trial.value)[:2]
        first, second, *others = tune.finals(name, {}, spans, trials)
        assert first["objective"] <= second["objective"]
        for row in (first, second):
            gains = {gain: row[gain] for gain in spans}
            (trial,) = [trial for trial in best if trial.value == row["in the search"]]
            assert gains == {gain: float(f"{trial.params[gain]:.3g}") for gain in spans}
            controller = replace(ROSTER[name], arguments=gains)
            new_runs = tune.score(controller, {}, 3, tune.FINAL_FIRST_RUN)
            assert row["objective"] == new_runs["objective"]
        controllers = tune.WITH_THE_SAME_GAINS[name]
        case = tune.cases({})["dead zone"]
        for row, present in zip(others, controllers, strict=True):
            seed = tune.FINAL_FIRST_RUN + tune.SPACING_OF_CASES
            trajectory = ROSTER[present].run(case.arguments, case.samples, 3, seed)
            median = np.median(tune.mean_error(trajectory))
            assert row["dead zone"] == pytest.approx(median, rel=1e-12)

    def test_a_stopped_search_goes_on_where_it_was(self, tmp_path, monkeypatch, capsys):
        whole, parts = tmp_path / "whole", tmp_path / "parts"
        assert tune.main(f"pi --trials 6 --out {whole}".split()) == 0
        score, calls = tune.score, []

        def score_or_stop(*arguments):
            calls.append(arguments)
            if len(calls) == 5:
                raise KeyboardInterrupt
            return score(*arguments)

        monkeypatch.setattr(tune, "score", score_or_stop)
        words = f"pi --trials 6 --out {parts}".split()
        assert tune.main(words) == 130
        assert f"with --out {parts}, the same command goes on" in capsys.readouterr().err
        # A search on another plant needs another folder.
        assert tune.main([*words, "--set", "delay=3"]) == 2
        assert f"--out: {parts} has another search" in capsys.readouterr().err
        before = len(calls)
        assert tune.main(words) == 0
        assert len(calls) == before + 2 + 2 + 3  # 4 are kept; then 2 finalists, 3 present gains
        assert gains_in(parts) == gains_in(whole)
        stored = [tune.search("pi", {}, SPANS["pi"](PAPER), 6, out) for out in (whole, parts)]
        gains, same_gains = ([trial.params for trial in trials] for trials in stored)
        assert gains == same_gains

    def test_the_order_of_the_arguments_of_a_plant_does_not_matter(self, tmp_path):
        spans = SPANS["pi"](PAPER)
        tune.search("pi", {"delay": 3, "dead_zone": 4.0}, spans, 1, tmp_path)
        assert len(tune.search("pi", {"dead_zone": 4.0, "delay": 3}, spans, 1, tmp_path)) == 1
        with pytest.raises(CommandError, match="has another search"):
            tune.search("pi", {"dead_zone": 4.0, "delay": 2}, spans, 1, tmp_path)
