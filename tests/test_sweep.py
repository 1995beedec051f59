"""The robustness study: its plants, its tasks, and what it makes of them."""

import inspect
import itertools
import json
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pandas as pd
import pytest

from agents import self_tuning
from benchmarks.controllers.engineered import simc_pi
from benchmarks.controllers.records import Factory
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib import storage
from benchmarks.loop import designs
from benchmarks.loop.designs import SPANS, WIDE, around, grid, random_design
from benchmarks.sweep import command, maps, report
from benchmarks.sweep.__main__ import main
from benchmarks.sweep.command import agent_task, limit_task
from mptc_gym import Parameters
from tests.conftest import trajectory

NOMINAL = {"delay": 18}


def run_task(agent, plant, *numbers):
    (factory,) = ROSTER[agent].members()
    return agent_task(factory, {}, plant, *numbers)  # samples, runs


class TestDesigns:
    def test_the_grid_has_200_plants_that_can_reach_the_set_point(self):
        plants = grid()
        assert len({tuple(plant.values()) for plant in plants}) == len(plants) == 200
        for plant in plants:
            reach = 10 * plant["gain_factor"] * 0.04964 / 0.07273
            assert reach > 5.0
            Parameters(**plant)

    @pytest.mark.parametrize("spans", [SPANS, WIDE], ids=["random", "wide"])
    def test_a_random_design_fills_its_spans_and_half_of_it_drifts(self, spans):
        plants = random_design(100, 0, 600, spans)
        for name, (low, high) in spans.items():
            values = np.array([plant[name] for plant in plants])
            assert values.min() >= low
            assert values.max() <= high
            # A hypercube has one value in each hundredth.
            assert np.histogram(values, 10, (low, high))[0].min() >= 6
        assert [("gain_drift" in plant) for plant in plants] == [False] * 50 + [True] * 50
        for plant in plants[50:]:
            for name in ("gain", "time_constant"):
                end = plant[f"{name}_factor"] * plant[f"{name}_drift"]
                low, high = spans[f"{name}_factor"]
                assert low - 1e-6 <= end <= high + 1e-6
            assert plant["drift_samples"] == 600
        assert all(Parameters(**plant).delay == plant["delay"] for plant in plants)

    def test_around_another_plant_a_design_spans_its_own_numbers(self):
        design = random_design(50, 0, 600)
        assert around({}, design) == design
        other = {"delay": 36, "dead_zone": 0.5, "u_min": -1.0, "u_max": 1.0, "gain_factor": 2.0}
        for plant, paper in zip(around(other, design), design, strict=True):
            assert plant["delay"] == 2 * paper["delay"]
            assert plant["dead_zone"] == pytest.approx(0.1 * paper["dead_zone"])
            assert plant["gain_factor"] == 2.0 * paper["gain_factor"]
            # The flow reaches a fifth as far: a tenth of the flow at twice the gain.
            variance = plant["noise_variance"]
            assert variance == pytest.approx(0.04 * paper["noise_variance"])
            assert plant.get("gain_drift") == paper.get("gain_drift")

    def test_a_wide_design_lies_beyond_the_spans_which_are_those_of_the_self_tuning_bank(self):
        plants = random_design(200, 0, 600, WIDE)
        beyond = [
            any(not low <= plant[name] <= high for name, (low, high) in SPANS.items())
            for plant in plants
        ]
        assert 0.9 < np.mean(beyond) < 1.0
        given = inspect.signature(self_tuning.SelfTuningController).parameters
        delays = tuple(
            given[f"{most}_delay_samples"].default - 1 for most in ("shortest", "longest")
        )
        constants, zones = self_tuning.TIME_CONSTANTS, 5.0 + 10.0 * np.array(self_tuning.ZONES)
        assert delays == SPANS["delay"]
        assert (min(constants), max(constants)) == SPANS["time_constant_factor"]
        assert (zones.min(), zones.max()) == SPANS["dead_zone"]


class TestCells:
    def test_no_control_leaves_the_error_at_the_set_point(self):
        task = run_task("nothing", NOMINAL, 1200, 2)
        assert task["mae"] == task["late"] == [5.0, 5.0]
        assert task["swing"] == [0.0, 0.0]

    def test_swing_is_the_deviation_in_second_halves_by_hand(self):
        # Two of them, of 1, 3 and of 10, 10, 10, 16: variances 1 and 6.75.
        setpoint = np.repeat([5.0, -5.0], [4, 8])
        error = [9, 9, 1, 3, 9, 9, 9, 9, 10, 10, 10, 16]
        found = command.swing(trajectory(setpoint, setpoint - error))
        assert found == pytest.approx([np.sqrt(7.75 / 2)])

    def test_the_limit_is_that_of_the_plant(self):
        nominal = limit_task(NOMINAL, 1200)
        assert nominal == pytest.approx(0.911, abs=0.001)
        assert limit_task({"delay": 30}, 1200) > nominal
        # As the gain falls, 5 degC come to be out of reach.
        assert limit_task({"gain_drift": 0.5}, 1200) > 1.4 * nominal

    def test_a_frozen_network_starts_from_what_was_learnt(self):
        learning = ROSTER["nn"].members()[0].in_service({}, 3, 0)
        frozen = ROSTER["nn-frozen"].members()[0]({}, 3, 0)
        np.testing.assert_array_equal(learning.weights.W, frozen.weights.W)
        # Commissioned, it knows the plant: better than one that begins to learn.
        experienced = run_task("nn-frozen", NOMINAL, 1200, 3)["mae"]
        assert np.median(experienced) < 1.6

    def test_a_loop_with_too_much_delay_oscillates(self):
        slow = run_task("pi", {"delay": 40}, 1200, 1)
        assert slow["swing"][0] > report.OSCILLATES
        calm = run_task("pi-simc", NOMINAL, 1200, 1)
        assert calm["swing"][0] < 0.2


def run_sweep(out, options):
    given = f"--runs 2 --samples 700 --jobs 1 {options}"
    return main([*given.split(), "--out", str(out)])


class TestSweep:
    def test_random_design(self, tmp_path, capsys, monkeypatch):
        monkeypatch.setattr(storage, "commit", lambda: "abc")
        given = "--design random --plants 4 --agents nn nn-frozen pi-simc"
        assert run_sweep(tmp_path, given) == 0
        runs = pd.read_csv(tmp_path / "runs.csv")
        assert len(runs) == 3 * 4 * 2
        np.testing.assert_allclose(runs["ratio"], runs["mae"] / runs["limit"])
        # The limit is one of the mean over all noise; single runs may have luck.
        assert (runs["ratio"] > 0.8).all()
        assert runs["ratio"].mean() > 1.1
        for name in ("plants.png", "drift_learning.png", "report.html", "report.md"):
            assert (tmp_path / name).stat().st_size > 1000
        assert "Does online learning help when the plant drifts?" in capsys.readouterr().out
        assert json.loads((tmp_path / "provenance.json").read_text())["seconds"] > 0

        # Again: nothing is run, and nothing changes.
        saved = {file: file.stat().st_mtime_ns for file in (tmp_path / "tasks").rglob("*.pkl")}
        assert len(saved) == 4 * (3 + 2)
        monkeypatch.setattr(command, "report", lambda *_: [])
        assert run_sweep(tmp_path, given) == 0
        assert {file: file.stat().st_mtime_ns for file in saved} == saved
        pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "runs.csv"), runs)

    def test_tasks_of_other_options_are_not_taken(self, tmp_path, monkeypatch):
        monkeypatch.setattr(storage, "commit", lambda: "abc")
        monkeypatch.setattr(command, "report", lambda *_: [])  # which takes its time to draw
        given = "--design random --plants 2 --samples 60"
        changes = [  # and how many tasks are new, for each of two plants: of the limit, of
            # nothing, of the controller
            ("", 3), ("--runs 3", 2), ("--samples 50", 3), ("--design-seed 1", 3),
            ("--design wide", 3), ("--told each", 2), ("--set dead_zone=7", 3),
            ("--agents pi", 1), ("", 0),
        ]  # fmt: skip
        for options, anew in changes:
            kept = len(list(tmp_path.glob("tasks/*/*")))
            run_sweep(tmp_path, f"{given} --agents pi-simc {options}")
            assert len(list(tmp_path.glob("tasks/*/*"))) == kept + 2 * anew
        # Neither are those of another training.
        trained = Factory(simc_pi, provenance={"file": "b"})
        monkeypatch.setitem(ROSTER, "pi-simc", replace(ROSTER["pi-simc"], made_by=trained))
        run_sweep(tmp_path, f"{given} --agents pi-simc")
        assert len(list(tmp_path.glob("tasks/*/*"))) == kept + 2

    def test_told_each_plant_a_controller_does_better(self, tmp_path, monkeypatch):
        monkeypatch.setattr(command, "report", lambda *_: [])
        errors = {}
        for told in ("nominal", "each"):
            given = f"--design random --plants 4 --agents smith --told {told}"
            assert run_sweep(tmp_path, given) == 0
            errors[told] = pd.read_csv(tmp_path / "runs.csv")["mae"]
        assert errors["each"].mean() < errors["nominal"].mean() - 0.05

    def test_grid(self, tmp_path, monkeypatch):
        monkeypatch.setitem(designs.GRID, "delay", range(10, 22, 10))
        monkeypatch.setitem(designs.GRID, "gain_factor", np.array([1.0, 1.2]))
        report = Mock(return_value=[])
        monkeypatch.setattr(command, "report", report)
        assert run_sweep(tmp_path, "--agents pi-simc") == 0
        runs = pd.read_csv(tmp_path / "runs.csv")
        assert set(zip(runs["delay"], runs["gain_factor"], strict=True)) == {
            (10, 1.0), (20, 1.0), (10, 1.2), (20, 1.2),
        }  # fmt: skip
        assert report.call_args.args[2] == Parameters()  # the plant that the grid is around

    def test_a_grid_marks_the_plant_that_it_is_around(self, monkeypatch, tmp_path):
        legend = Mock()
        monkeypatch.setattr(maps, "draw_legend", legend)
        runs = pd.DataFrame({"agent": "pi", "plant": [0, 1], "delay": [18, 9]}).assign(
            gain_factor=[1.0, 2.0], ratio=2.0, oscillates=False, useless=False
        )
        for centre, name, place in (
            (Parameters(), "the paper's plant", (18, 1.0)),
            (Parameters(delay=9, gain_factor=2.0), "the nominal plant", (9, 2.0)),
        ):
            maps.plot_maps(runs, tmp_path / "map.png", centre)
            marks = legend.call_args.args[2]
            assert marks[name].get_xydata().tolist() == [list(place)]
            # Where the set point is 5 °C, as is the dead zone: 1 / 0.6825 degC per t/h.
            (edge,) = (marks[text] for text in marks if "5 °C is within" in text)
            assert edge.get_ydata()[0] == pytest.approx(1.4652, abs=1e-3)


class TestFindings:
    """What the tables say, from runs made up so that the answer is known."""

    @staticmethod
    def runs():
        errors, drifts = {"nn": 1.0, "nn-frozen": 2.0, "pi-simc": 1.5}, [np.nan, 0.5, 2.0]
        cells = itertools.product(errors, range(20), range(3))
        runs = pd.DataFrame(cells, columns=["agent", "plant", "run"])
        error = runs["agent"].map(errors)
        drift = np.repeat(drifts, [10, 5, 5])[runs["plant"]]
        worse = (runs["agent"] == "nn") & (drift == 2.0)
        return runs.assign(
            gain_drift=drift, late=error + 2.0 * worse, mae=error, ratio=error,
            oscillates=runs["plant"] == 0, total_variation=10.0, useless=False, delay=18,
        )  # fmt: skip

    def test_differences(self):
        table = report.differences(self.runs(), [("nn", "pi-simc")], "late").set_index("plants")
        pair = "NN (1992) - PI (SIMC)"
        assert table.loc["no drift", pair] == "-0.500; 100 %"
        assert table.loc["gain falls to less than 0.8 times", pair].startswith("-0.500")
        assert table.loc["gain rises to more than 1.25 times", pair].startswith("+1.500")
        assert table.loc["gain rises to more than 1.25 times", pair].endswith("; 0 %")
        assert table.loc["all that drift", pair].startswith("+0.500")
        assert table.loc["all that drift", "number"] == "10"
        assert table.loc["gain stays within 0.8 to 1.25 times", pair] == ""

    def test_overview(self):
        table = report.overview(self.runs()).set_index("controller")
        assert table.loc["NN (1992), frozen", "multiple, median"] == "2.000"
        assert table.loc["NN (1992)", "oscillates (%)"] == "5.0"
