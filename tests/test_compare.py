"""The comparison: measures by hand, numbers, report and pictures, and how it ends."""

import json
import math
import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import matplotlib.image
import numpy as np
import pandas as pd
import pytest

from benchmarks.bounds import reference_error
from benchmarks.compare import plots
from benchmarks.compare.__main__ import main
from benchmarks.compare.cases import reference_of, run_case
from benchmarks.compare.estimates import estimate, ranked
from benchmarks.controllers.roster import ROSTER
from benchmarks.loop.measures import mean_error, measure
from benchmarks.loop.scenarios import SCENARIOS
from mptc_gym import IDS, PRESETS, Parameters, evaluate
from mptc_gym.evaluation import SEED
from tests.conftest import ROOT, trajectory

# A plant whose temperature rises with the flow, with a time constant of 20 s.
RISING = {"a": [1.0, -0.67032], "b": [0.13187], "c": [1.0], "delay": 4, "dead_zone": 1.5}
RISING |= {"u_min": -20.0, "u_max": 30.0}
GOLDEN = Path(__file__).parent / "golden"  # numbers of earlier versions


# Set point and temperature of a run, command and applied flow, and its measures by hand. One
# sample takes a minute, so that minutes are samples.
BY_HAND = [
    (
        ([4, 4, 4, -2, -2], [0, 1, 6, 0, -2]),
        # The time in itae starts again with the change: 0*4 + 1*3 + 2*2, then 0*2 + 1*0. The
        # overshoot is 2 beyond a change of 4; the second change, of -6, is not exceeded.
        {"mae": 11 / 5, "itae": 7, "overshoot": 50},
    ),
    (([0, -4, -4], [9, 0, -5]), {"overshoot": 25}),
    # Within 5 % of 10 from the third sample after the change on.
    (([10] * 5, [0, 9.6, 9.49, 9.51, 10.5]), {"settling_time": 3}),
    # Of two changes the longer counts: 1 sample, then 2.
    (([10, 10, 10, 0, 0, 0], [0, 10, 10, 10, 10, 0]), {"settling_time": 2}),
    (([10, 10, 10, 10, 0, 0], [0, 10, 10, 9, 0, 0]), {"settling_time": math.inf}),
    (([10, 10, 10, 10, 0, 0], [0, 10, 10, 10, 1, 2]), {"settling_time": math.inf}),
    (
        ([1] * 6, [0] * 6, [6, 4.9, 5, -12, -10, -4], [6, 0, 5, -10, -10, 0]),
        {"total_variation": 42, "saturation_share": 100 / 3},
    ),
]


@pytest.mark.parametrize(("signals", "expected"), BY_HAND)
def test_measures_by_hand(signals, expected):
    measures = measure(trajectory(*signals), Parameters(sampling_interval=60.0))
    assert {name: measures[name][0] for name in expected} == pytest.approx(expected)


def some_runs(**errors):
    """Make up runs: errors of agents by policy and seed."""
    return pd.DataFrame(
        [
            {"agent": agent, "policy": p, "seed": i, "mae": error}
            for agent, policies in errors.items()
            for p, row in enumerate(policies)
            for i, error in enumerate(row)
        ]
    )


def test_the_idle_valve_of_a_score_runs_in_the_episodes_of_the_controllers():
    runs = 120
    scenario = replace(SCENARIOS["constant-noise"], samples=60)
    idle = run_case(scenario, ROSTER["idle"], runs, SEED).runs[0]["mae"]
    reference = reference_of(scenario, runs, SEED)
    assert reference.score(idle.mean()) == pytest.approx(0.0)


class TestEstimates:
    def test_by_hand(self):
        reference = reference_of(SCENARIOS["constant"], 3, SEED)
        rows = some_runs(nn=[[1.0, 2.0, 3.0]], ppo=[[0.5, 2.0, 2.0], [1.5, 2.0, 1.0]])
        rows = rows.assign(scenario="constant")
        found = estimate(rows, {"constant": reference})
        nn, ppo_ = found.to_dict("records")
        assert (nn["mean"].value, nn["reference"]) == (2.0, reference.value)
        assert nn["ratio"].value == pytest.approx(2.0 / reference.value)
        assert ppo_["mean"].value == pytest.approx(1.5)
        assert nn["mean"].low < nn["mean"].value < nn["mean"].high

    def test_a_score_by_hand_and_the_best_comes_first(self):
        cases = "constant", "square"
        references = {name: reference_of(SCENARIOS[name], 1, SEED) for name in cases}
        rows = []
        for name, reference in references.items():
            idle = reference.idle.value
            half = (reference.value + idle) / 2
            errors = some_runs(pi=[[idle, half]], nn=[[reference.value, half]])
            rows.append(errors.assign(scenario=name))
        scores = ranked(estimate(pd.concat(rows), references))
        assert [*scores] == ["nn", "pi"]
        assert scores["nn"].value == pytest.approx(0.75)
        assert scores["pi"].value == pytest.approx(0.25)


def test_each_training_is_measured_as_if_it_ran_alone():
    case = SCENARIOS["constant-noise"]
    members = ROSTER["ppo"].members()
    result = run_case(case, ROSTER["ppo"], 2, SEED)
    for member, columns in zip(members, result.runs, strict=True):
        alone = member.run(case.arguments, case.samples, 2, SEED)
        np.testing.assert_array_equal(columns["mae"], mean_error(alone))


@pytest.fixture
def compared(tmp_path):
    """Return a function that compares, and returns the folder of what has finished."""

    def compared(options, *more, status=0):
        out = tmp_path / "out"
        # In this process, unless an option says otherwise.
        given = ["--out", out, "--jobs", 1, *options.split(), *more]
        assert main([str(each) for each in given]) == status
        return out

    return compared


@pytest.fixture
def undrawn(monkeypatch):
    """Leave out the pictures, which take most of the time."""
    for name in ("plot_scores", "plot_responses"):
        monkeypatch.setattr(plots, name, lambda *_: None)


def assert_golden(found, name):
    """Compare a table with that of an earlier version."""
    read = partial(pd.read_csv, na_values=["not settled"])
    pd.testing.assert_frame_equal(read(found), read(GOLDEN / name), rtol=1e-8, atol=1e-10)


class TestCompare:
    def test_files_and_their_contents(self, compared, capsys):
        out = compared("--agents nn pi mpc --scenarios constant constant-noise --runs 3")
        for name in ("runs", "summary", "estimates"):
            assert_golden(out / f"{name}.csv", f"compare_{name}.csv")
        reference = reference_error(samples=600, kind="surprise", setpoint=5.0).value
        error = pd.read_csv(out / "runs.csv").query("agent == 'pi'")["mae"].iloc[0]
        page, screen = (out / "report.md").read_text(), capsys.readouterr().out
        assert f"{reference:.3f}" in page
        for text in (page, screen):
            assert f"{error / reference:.2f}" in text
        # The best comes first.
        assert page.index("| MPC") < page.index("| NN (1992)") < page.index("| PI (1992)")
        for name in ("constant", "constant-noise", "scores"):
            picture = matplotlib.image.imread(out / f"{name}.png")
            assert len(np.unique(picture[::4, ::4] @ [1.0, 2.0, 4.0, 0.0])) > 10  # colours

    @pytest.mark.usefixtures("undrawn")
    def test_a_row_of_the_presets_is_what_evaluate_says_from_any_seed_on(self, compared):
        given = "--presets --runs 2 --scenarios randomised --agents nn self-tuning"
        seed = 5_000_000
        out = compared(f"{given} --seed {seed}")
        assert json.loads((out / "provenance.json").read_text())["seeds"] == [seed, seed + 1]
        rows = pd.read_csv(out / "runs.csv").set_index("agent")
        estimates = pd.read_csv(out / "estimates.csv").set_index("agent")
        for agent in estimates.index:
            controller, _ = ROSTER[agent].start(PRESETS["randomised"], 2, seed)
            found = evaluate(controller, IDS["randomised"], episodes=2, seed=seed)
            row, against = rows.loc[agent], estimates.loc[agent]
            assert list(row["seed"]) == list(found.seeds)
            np.testing.assert_allclose(row["mae"], found.errors, rtol=0, atol=1e-12)
            np.testing.assert_allclose(row["total_variation"], found.travels, atol=1e-9)
            assert against["reference"] == pytest.approx(found.reference, abs=1e-12)
            assert against["ratio"] == pytest.approx(found.ratio, abs=1e-12)

    @pytest.mark.usefixtures("undrawn")
    def test_the_example_of_the_page_and_a_bad_one_beside_it(
        self, compared, tmp_path, monkeypatch, capsys
    ):
        readme = (ROOT / "benchmarks/compare/README.md").read_text(encoding="utf-8")
        (example,) = re.findall(r"```python\n(from agents import PIC.*?)```", readme, re.DOTALL)
        (option,) = re.findall(r"--agent (\w+=my_\S+)`", readme)
        bad_example = "def bad():\n    return lambda observations: 1 / 0\n"
        (tmp_path / "my_controllers.py").write_text(f"{example}\n{bad_example}")
        monkeypatch.syspath_prepend(tmp_path)
        bad = "--agent bad=my_controllers:bad"
        given = f"--agents --agent {option} {bad} --scenarios constant --runs 1"
        out = compared(given, status=1)
        errors = pd.read_csv(out / "runs.csv")["mae"].tolist()
        assert errors == pytest.approx([0.283], abs=0.001)  # that of the gains
        said = capsys.readouterr().err
        assert "1 of 3 tasks are missing" in said
        assert "bad, constant: ZeroDivisionError" in said
        assert "**Unfinished: 1 of 3 tasks are missing.**" in (out / "report.md").read_text()

    def test_what_evaluate_refuses_is_refused_before_the_tasks(
        self, tmp_path, monkeypatch, refused
    ):
        code = "from agents import PIController\ndef fixed():\n    return PIController()\n"
        (tmp_path / "with_limits.py").write_text(code)
        monkeypatch.syspath_prepend(tmp_path)
        words = "--agents pi --agent mine=with_limits:fixed --set u_min=0 --set u_max=20"
        said = refused(main, [*words.split(), "--out", str(tmp_path / "out")])
        assert "--agent mine, square: policy must have the flow limits of env" in said
        assert not (tmp_path / "out").exists()

    @pytest.mark.usefixtures("undrawn")
    def test_after_an_interruption_there_is_a_report_on_what_has_finished(
        self, compared, monkeypatch, capsys
    ):
        finished = [("pi", "constant"), ("pi", "load"), ("smith", "constant")]
        results = [run_case(SCENARIOS[case], ROSTER[name], 1, 0) for name, case in finished]
        monkeypatch.setattr(
            "benchmarks.compare.cases.run_case", Mock(side_effect=[*results, KeyboardInterrupt])
        )
        out = compared("--agents pi smith --scenarios constant load --runs 1", status=130)
        said = "interrupted: 1 of 6 tasks are missing"
        page = (out / "report.md").read_text()
        assert f"**Unfinished: {said}.**" in page
        printed = capsys.readouterr()
        assert f"data and pictures are in {out}/" in printed.out
        assert said in printed.err
        # The higher score is no better if it is over fewer cases.
        assert page.index("| PI (1992)") < page.index("| Smith")
        for text in (page, printed.out):
            assert "\nScores over fewer cases, as results are missing: Smith." in text

    def test_all_controllers_beside_one_of_any_name_which_is_always_drawn(self, compared):
        name = "$\\nope$ ../../x"
        option = "--scenarios constant --runs 1"
        out = compared(option, "--agent", f"{name}=agents:PIController")
        page = " ".join((out / "report.md").read_text().split())
        assert f"| {name} |" in page
        assert "PPO, and your own controllers. The file CASE.csv" in page
        assert (out / "scores.png").exists()
        # Ms of the paper's gains, which the own controller has, too, and of three tuned rules.
        assert page.count("| unstable |") == 2
        assert page.count("| 1.60 |") == 3

    @pytest.mark.usefixtures("undrawn")
    def test_controllers_made_for_the_other_sign_are_left_out(
        self, compared, tmp_path, capsys, refused
    ):
        plant = tmp_path / "plant.json"
        plant.write_text(json.dumps(RISING))
        words = f"--plant {plant} --scenarios square --runs 1"
        out = compared(f"{words} --agents pi pi-simc dahlin ppo nn idle")
        sentence = "Left out, because made for a gain of the other sign: PI (1992), PPO."
        assert sentence in (out / "report.md").read_text()
        assert sentence in capsys.readouterr().out
        scores = pd.read_csv(out / "estimates.csv").set_index("agent")["ratio"]
        assert [*scores.index] == ["pi-simc", "dahlin", "nn", "idle"]
        assert scores["dahlin"] < scores["pi-simc"] < 2.0
        assert "name at least one controller" in refused(
            main, [*words.split(), "--agents", "pi"]
        )

    @pytest.mark.parametrize(
        ("cases", "headings"),
        [
            ("", "square zone 7 noise const zone 7 noise load score (t/h)"),
            ("--presets", "paper zone 7 noisy disturb. fouling random. hard score (t/h)"),
        ],
    )
    @pytest.mark.usefixtures("undrawn")
    def test_the_screen_has_one_narrow_table(
        self, cases, headings, compared, capsys, monkeypatch
    ):
        constant = reference_of(SCENARIOS["constant"], 1, SEED)
        monkeypatch.setattr("benchmarks.compare.cases.reference_of", lambda *_: constant)
        long = f"{30 * 'x'}=agents:PIController"
        compared(f"{cases} --agents pi-searched idle --runs 1 --agent {long}")
        *lines, _ = capsys.readouterr().out.splitlines()  # the last names the folder
        assert max(map(len, lines)) <= 80
        assert lines[1].split() == ["controller", *headings.split()]
        assert len(lines) == 2 + 3 + 1

    @pytest.mark.usefixtures("undrawn")
    def test_a_plant_is_described_and_its_steps_are_in_the_report(self, compared, capsys):
        out = compared("--set delay=10 --agents dahlin nn idle --scenarios constant --runs 2")
        first, *_ = capsys.readouterr().out.splitlines()
        assert first == (
            "Plant: gain -0.682 °C per t/h, time constant 161 s, delay 88 s, dead zone 5 t/h, "
            "limits -10 to 10 t/h, sampling interval 8 s"
        )
        page = " ".join((out / "report.md").read_text().split())
        assert "| constant | Dahlin | 0 | 4.5 | 21.2 | 13 |" in page
        assert re.search(r"\| constant \| NN \(1992\) \| \d+ \(\d+ to \d+\)", page)
        assert re.search(r"\| constant \| idle valve \| 0 \| never ", page)
        assert "no controller settles" not in page

    @pytest.mark.usefixtures("undrawn")
    def test_a_comparison_says_where_no_controller_settles(self, compared, capsys):
        # The limits allow 3.4 degC; the set point is 5.
        words = "--set u_max=5 --set u_min=-5 --set dead_zone=0"
        out = compared(f"{words} --agents pi-simc smith --scenarios constant --runs 1")
        for text in (capsys.readouterr().out, (out / "report.md").read_text()):
            assert "In the case constant, no controller settles." in text
            assert "In the case constant, all controllers are at a limit" in text
