"""The robustness study: its plants, its tasks, and what it makes of them."""

import itertools
import json

import numpy as np
import pandas as pd
import pytest

from benchmarks import sweep
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib import storage
from benchmarks.lib.storage import Kept
from benchmarks.loop.scenarios import SPANS, around, random_design
from benchmarks.sweep import SETPOINT, least_error, main
from tests.conftest import ROOT, trajectory


class TestDesigns:
    def test_a_random_design_fills_its_spans_and_half_of_it_drifts(self):
        plants = random_design(100, 0, 600)
        for name, (low, high) in SPANS.items():
            values = np.array([plant[name] for plant in plants])
            assert low <= values.min() <= values.max() <= high
            # A hypercube has one value in each hundredth.
            assert np.histogram(values, 10, (low, high))[0].min() >= 6
        assert [("gain_drift" in plant) for plant in plants] == [False] * 50 + [True] * 50
        for plant in plants[50:]:
            for name in ("gain", "time_constant"):
                end = plant[f"{name}_factor"] * plant[f"{name}_drift"]
                low, high = SPANS[f"{name}_factor"]
                assert low - 1e-6 <= end <= high + 1e-6
            assert plant["drift_samples"] == 600
        assert random_design(100, 1, 600) != plants == random_design(100, 0, 600)

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


class TestTasks:
    def test_swing_is_the_deviation_in_second_halves_by_hand(self):
        # Two of them, of 1, 3 and of 10, 10, 10, 16: variances 1 and 6.75.
        setpoint = np.repeat([5.0, -5.0], [4, 8])
        error = [9, 9, 1, 3, 9, 9, 9, 9, 10, 10, 10, 16]
        found = sweep.swing(trajectory(setpoint, setpoint - error))
        assert found == pytest.approx([np.sqrt(7.75 / 2)])

    def test_the_least_error_is_that_of_the_plant(self):
        nominal = least_error(SETPOINT, 1200)
        assert nominal == pytest.approx(0.911, abs=0.001)
        assert least_error({"delay": 30, **SETPOINT}, 1200) > nominal
        # As the gain falls, 5 degC come to be out of reach.
        assert least_error({"gain_drift": 0.5, **SETPOINT}, 1200) > 1.4 * nominal
        assert least_error({"setpoint_period": 38}, 600) is None  # it does not settle


def run_sweep(out, options, status=0):
    given = f"--runs 2 --samples 700 --jobs 1 {options} --out {out}"
    assert main(given.split()) == status
    return pd.read_csv(out / "runs.csv")


class TestCommand:
    def test_random_design(self, tmp_path, capsys, monkeypatch):
        monkeypatch.setattr(storage, "commit", lambda: "abc")
        given = "--design random --design-seed 2026 --plants 4 --agents nn nn-frozen pi-simc"
        runs = run_sweep(tmp_path, given)
        golden = pd.read_csv(ROOT / "tests/golden/sweep.csv")
        pd.testing.assert_frame_equal(runs, golden, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(runs["ratio"], runs["mae"] / runs["limit"])
        summary = pd.read_csv(tmp_path / "summary.csv")
        assert list(summary["agent"]) == ["nn", "nn-frozen", "pi-simc"]
        for name in ("plants.png", "report.html", "report.md"):
            assert (tmp_path / name).stat().st_size > 1000
        assert "Does online learning help when the plant drifts?" in capsys.readouterr().out
        assert json.loads((tmp_path / "provenance.json").read_text())["seconds"] > 0
        # Again: nothing is run, and nothing changes.
        assert len(list(tmp_path.glob("tasks/**/*.pkl"))) == 4 * (3 + 2)
        monkeypatch.setattr(Kept, "save", None)
        monkeypatch.setattr(sweep, "report", lambda *_: [])
        assert run_sweep(tmp_path, given).equals(runs)

    def test_what_the_options_change(self, tmp_path, monkeypatch):
        monkeypatch.setattr(sweep, "report", lambda *_: [])  # which takes its time to draw
        given = "--design random --plants 4 --agents smith"
        first = run_sweep(tmp_path, given)
        for more in ("--design-seed 1", "--set dead_zone=4"):
            assert not run_sweep(tmp_path, f"{given} {more}")["mae"].equals(first["mae"]), more
        # If it knows each plant, a controller does better.
        told = run_sweep(tmp_path, f"{given} --told each")
        assert told["mae"].mean() < first["mae"].mean() - 0.05

    @pytest.mark.parametrize(
        ("error", "status", "rows"), [(ArithmeticError, 1, 12), (KeyboardInterrupt, 130, 8)]
    )
    def test_what_has_finished_is_written(self, error, status, rows, tmp_path, monkeypatch):
        run, calls = sweep.run_agent, []

        def fails(factory, *given):
            calls.append(factory)
            if factory is ROSTER["pi"].members()[0] and len(calls) > 6:  # from plant 2 on
                raise error
            return run(factory, *given)

        monkeypatch.setattr(sweep, "run_agent", fails)
        given = "--design random --plants 4 --agents pi pi-simc"
        counts = run_sweep(tmp_path, given, status)["agent"].value_counts()
        assert counts.sum() == rows
        assert counts["pi"] == 4


def test_differences_of_runs_made_up_so_that_the_answer_is_known():
    errors, drifts = {"nn": 1.0, "pi-simc": 1.5}, [np.nan, 0.5, 2.0]
    cells = itertools.product(errors, range(20), range(3))
    runs = pd.DataFrame(cells, columns=["agent", "plant", "run"])
    drift = np.repeat(drifts, [10, 5, 5])[runs["plant"]]
    worse = (runs["agent"] == "nn") & (drift == 2.0)
    late = runs["agent"].map(errors) + 2.0 * worse
    table = sweep.differences(
        runs.assign(gain_drift=drift, late=late, delay=18), [("nn", "pi-simc")], "late"
    )
    found = table.set_index("plants")["NN (1992) - PI (SIMC)"]
    assert found["no drift"] == "-0.500; 100 %"
    assert found["gain falls to less than 0.8 times"] == "-0.500; 100 %"
    assert found["gain rises to more than 1.25 times"] == "+1.500; 0 %"
    assert found["all that drift"].startswith("+0.500")
    assert found["gain stays within 0.8 to 1.25 times"] == ""
    assert table["number"].tolist()[:3] == ["10", "10", "5"]
