"""The robustness study: its plants, its tasks, and what it makes of them."""

import importlib
import itertools
import json
import sys
from unittest.mock import Mock

import numpy as np
import pandas as pd
import pytest

from benchmarks import sweep
from benchmarks.bounds import least
from benchmarks.controllers.roster import ROSTER
from benchmarks.loop.scenarios import around, random_design
from benchmarks.sweep import main
from tests.conftest import ROOT


def test_around_another_plant_a_design_spans_its_own_numbers():
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


def test_a_plant_that_does_not_settle_has_no_least_possible_error():
    cases = [{"setpoint": "square", "setpoint_period": period} for period in (600, 38)]
    settling, not_settling = [sweep.run_idle_valve(case, 1) for case in cases]
    assert settling["least_possible"] == pytest.approx(0.911, abs=0.001)
    assert np.isnan(not_settling["least_possible"])


def run_sweep(tmp_path, options, status=0):
    """Run a sweep and return its runs, which stay apart if it has not finished."""
    out = tmp_path / "out"
    words = f"--design random --plants 4 --runs 2 --jobs 1 {options} --out {out}"
    assert main(words.split()) == status
    folder = out.with_name("out.unfinished") if status else out
    return pd.read_csv(folder / "runs.csv")


class TestCommand:
    @pytest.fixture(autouse=True)
    def short(self, monkeypatch):
        monkeypatch.setattr(sweep, "SAMPLES", 700)

    @pytest.fixture
    def quick(self, monkeypatch):
        """Leave out what takes most of the time."""
        monkeypatch.setattr(sweep, "SAMPLES", 350)
        monkeypatch.setattr(sweep, "report", Mock())
        monkeypatch.setattr(least, "least_possible", lambda **_: Mock(value=1.0))

    def test_random_design(self, tmp_path, capsys):
        options = "--design-seed 2026 --agents nn nn-frozen pi-simc"
        runs = run_sweep(tmp_path, options)
        golden = pd.read_csv(ROOT / "tests/golden/sweep.csv")
        pd.testing.assert_frame_equal(runs, golden, rtol=1e-8, atol=1e-8)
        out = tmp_path / "out"
        summary = pd.read_csv(out / "summary.csv")
        assert list(summary["agent"]) == ["nn", "nn-frozen", "pi-simc"]
        for name in ("map.png", "report.md"):
            assert (out / name).stat().st_size > 1000
        assert "Does online learning help when the plant drifts?" in capsys.readouterr().out
        command = json.loads((out / "provenance.json").read_text())["command"]
        assert command.startswith("python -m benchmarks.sweep --design random --plants 4")
        assert not (out / "tasks").exists()

    @pytest.mark.usefixtures("quick")
    def test_what_the_options_change(self, tmp_path):
        first = run_sweep(tmp_path, "--agents smith")
        for added in ("--design-seed 1", "--set dead_zone=4"):
            other = run_sweep(tmp_path, f"--agents smith {added}")
            assert not other["mae"].equals(first["mae"]), added
        # If it knows each plant, a controller does better.
        informed = run_sweep(tmp_path, "--agents smith --told each")
        assert informed["mae"].mean() < first["mae"].mean() - 0.05

    @pytest.mark.usefixtures("quick")
    def test_a_function_acts_in_each_plant_as_its_code_is_now(self, tmp_path, monkeypatch):
        monkeypatch.syspath_prepend(tmp_path)
        # Bytecode is told from an older one of the same second by its size alone.
        monkeypatch.setattr(sys, "dont_write_bytecode", True)
        runs_by_gain = []
        for gain in (-0.1, -0.2):
            monkeypatch.delitem(sys.modules, "own_law", raising=False)
            code = f"def law():\n    return lambda seen: {gain} * seen[:, 3:4]\n"
            (tmp_path / "own_law.py").write_text(code)
            importlib.invalidate_caches()
            runs_by_gain.append(run_sweep(tmp_path, "--agents pi --agent mine=own_law:law"))
        assert not runs_by_gain[0]["mae"].equals(runs_by_gain[1]["mae"])

    @pytest.mark.usefixtures("quick")
    @pytest.mark.parametrize(
        ("error", "status", "rows"), [(ArithmeticError, 1, 12), (KeyboardInterrupt, 130, 8)]
    )
    def test_what_has_finished_is_written_and_not_run_again(
        self, error, status, rows, tmp_path, monkeypatch
    ):
        run, begun = sweep.run_agent, []

        def fails(controller, *given, **named):
            begun.append(controller)
            if controller is ROSTER["pi"] and 6 < len(begun) <= 12:  # from plant 2 on
                raise error
            return run(controller, *given, **named)

        monkeypatch.setattr(sweep, "run_agent", fails)
        stopped = run_sweep(tmp_path, "--agents pi pi-simc", status)
        counts = stopped["agent"].value_counts()
        assert counts.sum() == rows
        assert counts["pi"] == 4
        done = len(begun)
        begun.extend([None] * (12 - done))  # from now on it works
        runs = run_sweep(tmp_path, "--agents pi pi-simc")
        assert runs["agent"].value_counts().to_dict() == {"pi": 8, "pi-simc": 8}
        missing = {ArithmeticError: 2, KeyboardInterrupt: 5}[error]
        assert len(begun) - 12 == missing
        monkeypatch.setattr(sweep, "run_agent", run)
        assert run_sweep(tmp_path, "--agents pi pi-simc").equals(runs)


def test_differences_of_runs_made_up_so_that_the_answer_is_known():
    cells = itertools.product(["nn", "pi-simc"], range(30), range(3))
    runs = pd.DataFrame(cells, columns=["agent", "plant", "run"])
    runs["gain_drift"] = np.repeat([np.nan, 0.5, 2.0], 10)[runs["plant"]]
    runs["delay"] = np.repeat([40, 23, 13], 10)[runs["plant"]]
    worse = (runs["agent"] == "nn") & (runs["delay"] == 13)
    runs["mae"] = np.where(runs["agent"] == "nn", 1.0, 1.5) + 2.0 * worse
    table = sweep.differences(runs, [("nn", "pi-simc")])
    by_group = table.set_index("plants")["NN (1992) - PI (SIMC)"].to_dict()
    assert by_group.pop("all that drift").startswith("+0.500 (")
    below, above = "drift, delay below 14 samples", "drift, delay above 22 samples"
    assert by_group == {"no drift": "-0.500", below: "+1.500", above: "-0.500"}
    assert table["number of plants"].tolist() == ["10", "20", "10", "10"]
    # Plants where one of them has failed do not count, and one plant is no group.
    failed = (runs["agent"] == "nn") & (runs["plant"] > 1)
    table = sweep.differences(runs[~failed], [("nn", "pi-simc")])
    assert table["number of plants"].tolist() == ["2"]
    assert sweep.differences(runs[runs["plant"] == 0], [("nn", "pi-simc")]).empty
