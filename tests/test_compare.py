"""Scenarios, measures, tables and the comparison, on small budgets."""

import _pyio
import errno
import io
import itertools
import json
import math
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from unittest.mock import DEFAULT, Mock

import matplotlib.image
import numpy as np
import pandas as pd
import pytest
from joblib.externals.loky import get_reusable_executor

from agents import PIController
from benchmarks.bounds.least import least_possible
from benchmarks.compare import plots, report
from benchmarks.compare.__main__ import main
from benchmarks.compare.estimates import estimate, ranked, scale_of
from benchmarks.controllers import records
from benchmarks.controllers.roster import ROSTER, looks
from benchmarks.lib import storage, tables
from benchmarks.lib.report import Best, Section, on_screen, write_report
from benchmarks.lib.statistics import Estimate
from benchmarks.loop.metrics import METRICS, measure
from benchmarks.loop.rollout import make_plants, rollout
from benchmarks.loop.scenarios import SCENARIOS
from mptc_gym import IDS, PRESETS, Parameters, evaluate
from mptc_gym.evaluation import SEED
from tests.conftest import ROOT, python, trajectory
from tests.tasks import until

QUICK = "--agents pi --scenarios constant --runs 1 --jobs 1"


def measured(runs, **arguments):
    # One sample a minute, so that minutes are samples.
    values = measure(runs, Parameters(sampling_interval=60.0, **arguments))
    assert set(values) == set(METRICS)
    return {name: value[0] for name, value in values.items()}


class TestMeasures:
    def test_errors_by_hand(self):
        values = measured(trajectory([4, 4, 4, -2, -2], [0, 1, 6, 0, -2]))
        assert values["mae"] == pytest.approx((4 + 3 + 2 + 2 + 0) / 5)
        assert values["ise"] == pytest.approx(16 + 9 + 4 + 4 + 0)
        # t starts again with the change: 0*4 + 1*3 + 2*2, then 0*2 + 1*0
        assert values["itae"] == pytest.approx(7)
        # 2 beyond a change of 4; the second change, of -6, is not exceeded
        assert values["overshoot"] == pytest.approx(50)
        downwards = measured(trajectory([0, -4, -4], [9, 0, -5]))
        assert downwards["overshoot"] == pytest.approx(25)

    @pytest.mark.parametrize(
        ("setpoint", "output", "time"),
        [
            # Within 5 % of 10 from the third sample after the change on.
            ([10] * 5, [0, 9.6, 9.49, 9.51, 10.5], 3),
            # Of two changes the longer counts: 1 sample, then 2.
            ([10, 10, 10, 0, 0, 0], [0, 10, 10, 10, 10, 0], 2),
            ([10, 10, 10, 10, 0, 0], [0, 10, 10, 9, 0, 0], math.inf),
            ([10, 10, 10, 10, 0, 0], [0, 10, 10, 10, 1, 2], math.inf),
            ([10, 10, 10, 10, 0, 0], [0, 0, 0, 0, 0, 0], math.inf),
        ],
    )
    def test_settling(self, setpoint, output, time):
        assert measured(trajectory(setpoint, output))["settling_time"] == time

    def test_input_by_hand(self):
        commands = [6, 4.9, 5, -12, -10, -4]
        applied = [6, 0, 5, -10, -10, 0]
        values = measured(trajectory([1] * 6, [0] * 6, commands, applied))
        assert values["total_variation"] == 6 + 6 + 5 + 15 + 0 + 10
        assert values["dead_zone_share"] == pytest.approx(100 * 2 / 6)
        assert values["saturation_share"] == pytest.approx(100 * 2 / 6)


def test_a_controller_has_one_look_wherever_it_is_listed():
    everyone = looks([*ROSTER, "mine", "yours"])
    assert len(set(everyone.values())) == len(everyone)
    assert looks(["mine", "pi"]) == {"mine": everyone["mine"], "pi": everyone["pi"]}


class TestTables:
    def test_percentiles_where_some_do_not_settle(self):
        found = tables.percentiles(np.array([1.0, 2.0, 3.0, np.inf]))
        assert found == {"median": 3.0, "p10": 2.0, "p90": np.inf}

    @pytest.mark.parametrize("width", [40, 80, 200])
    def test_on_screen_nothing_is_cut(self, width, monkeypatch):
        monkeypatch.setenv("COLUMNS", str(width))
        cells = {f"square-dead-zone-{i}": ["1.00 (0.99 to 1.01)", "11.5"] for i in range(7)}
        table = pd.DataFrame({"agent": ["neural self-tuning", "NN (1992)"], **cells})
        shown = on_screen(table)
        assert width / 2 < max(map(len, shown.splitlines())) <= width
        assert shown.count("11.5") == shown.count("1.00 (0.99 to 1.01)") == 7

    def test_of_numbers_and_estimates_in_csv(self, tmp_path):
        columns = {
            "a": ["x", "y"],
            "s": [1.5, np.inf],
            "e": [Estimate(2.0, 1.0, 3.0, 4), np.nan],
        }
        report.write_numbers(tmp_path / "table.csv", pd.DataFrame(columns))
        written = (tmp_path / "table.csv").read_text()
        assert written == "a,s,e,e_low,e_high\nx,1.5,2.0,1.0,3.0\ny,not settled,,,\n"


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


class TestEstimates:
    def test_by_hand(self):
        scale = scale_of(SCENARIOS["constant"], 3)
        limit = scale.least.value
        runs = some_runs(nn=[[1.0, 2.0, 3.0]], ppo=[[0.5, 2.0, 2.0], [1.5, 2.0, 1.0]])
        nn, ppo_ = estimate(runs, scale, "nn").to_dict("records")
        assert (nn["mean"].value, nn["limit"]) == (2.0, limit)
        assert nn["ratio"].value == 2.0 / limit
        assert ppo_["mean"].value == pytest.approx(1.5)
        assert ppo_["difference"].value == pytest.approx(-0.5)
        assert ppo_["improvement"].value == pytest.approx((1 + 0.5 + 1 + 0 + 0.5 + 1) / 6)
        assert math.isnan(nn["difference"])
        assert nn["mean"].low < nn["mean"].value < nn["mean"].high

    def test_one_run_of_many_has_no_interval(self):
        scale = scale_of(SCENARIOS["constant-noise"], 1)
        found = estimate(some_runs(a=[[0.5]], b=[[2.0]]), scale, "a")
        assert [format(mean, ".1f") for mean in found["mean"]] == [
            "0.5 (one run)",
            "2.0 (one run)",
        ]

    def test_a_score_by_hand_and_the_best_comes_first(self):
        scales = {name: scale_of(SCENARIOS[name], 1) for name in ("constant", "square")}
        rows = []
        for name, scale in scales.items():
            least, idle = scale.least.value, scale.least.idle
            half = (least + idle) / 2
            runs = some_runs(a=[[idle, half]], b=[[least, half]])
            rows.append(runs.assign(scenario=name, total_variation=12.0))
        runs = pd.concat(rows)
        scores = ranked(runs, scales)
        overall, by_scenario = scores["b"]
        assert overall.value == pytest.approx(0.75)
        assert by_scenario == pytest.approx({"constant": 0.75, "square": 0.75})
        best, other = report.score_table(runs, scores, [*scales]).to_dict("records")
        assert (best["controller"], best["travel (t/h)"], best["square"]) == ("b", "12", "0.75")
        assert (other["controller"], other["constant"]) == ("a", "0.25")


class TestReport:
    def test_pages(self, tmp_path):
        (tmp_path / "picture.png").write_bytes(b"\x89PNG")
        table = pd.DataFrame({"name": [Best("a < b|c")], "value": ["1.0 (0.9 to 1.1)"]})
        sections = [
            Section("First", ["Some text."], table, {"picture.png": "A picture"}),
            Section("Second"),
        ]
        write_report(tmp_path, "Title", sections, "made today")
        page = (tmp_path / "report.md").read_text()
        assert page.startswith("# Title\n\n## First\n\nSome text.\n\n| name")
        assert page.endswith("\n\nmade today\n")
        assert "![A picture](picture.png)" in page
        html = (tmp_path / "report.html").read_text()
        assert "<strong>a &lt; b|c</strong>" in html
        assert r"| **a &lt; b\|c** | 1.0 (0.9 to 1.1) |" in page
        assert 'name="viewport"' in html
        assert "made today" in html
        assert 'src="data:image/png;base64,iVBORw=="' in html
        assert "1.0 <small>(0.9 to 1.1)</small></td>" in html
        assert "http" not in html  # nothing is fetched


def test_samples_line_up():
    runs = rollout(make_plants(1, 50, setpoint=5.0), PIController(2.2, 0.3), 50, seed=0)
    error = runs.setpoint - runs.output
    law = -2.2 * error - 0.3 * np.cumsum(error, axis=0)
    np.testing.assert_allclose(runs.command, law, rtol=1e-6)  # u(k) is in the row of e(k) ...
    assert np.all(runs.output[:19] == 0.0)
    assert runs.output[19] == pytest.approx(0.456)  # ... and u(0) shows in row 19


class TestStorage:
    @pytest.mark.parametrize(
        ("error", "raised"),
        [
            (KeyboardInterrupt(), KeyboardInterrupt),
            (OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), storage.UnfinishedError),
        ],
    )
    def test_a_failed_write_leaves_the_old_file(self, error, raised, tmp_path):
        path = tmp_path / "file.txt"
        storage.write_text(path, "old")

        def write_half():
            with storage.replacing(path) as partial:
                partial.write_text("half of the n")
                raise error

        with pytest.raises(raised, match=r"file\.txt .* No space left|^$"):
            write_half()
        assert path.read_text() == "old"
        assert list(tmp_path.iterdir()) == [path]

    def test_a_folder_that_is_a_file(self, tmp_path):
        path = tmp_path / "file" / "table.csv"
        path.parent.write_text("in the way")
        with pytest.raises(storage.UnfinishedError, match=r"table\.csv could not be written"):
            storage.write_text(path, "new")

    def test_lines_end_alike_on_every_system(self, tmp_path, monkeypatch):
        # Python's own model of its files, as it ends lines on Windows.
        monkeypatch.setattr(io, "open", _pyio.open)
        monkeypatch.setattr(os, "linesep", "\r\n")
        (tmp_path / "control").write_text("a\n", encoding="utf-8")
        assert (tmp_path / "control").read_bytes() == b"a\r\n"
        storage.write_text(tmp_path / "page.md", "a\nb\n")
        assert (tmp_path / "page.md").read_bytes() == b"a\nb\n"
        tables.write_csv(tmp_path / "table.csv", pd.DataFrame({"a": [1, 2]}))
        assert (tmp_path / "table.csv").read_bytes() == b"a\n1\n2\n"


@pytest.fixture
def compared(tmp_path):
    """Return a function that compares, and returns the folder of the results."""

    def compared(options, *more, status=0, into="out"):
        out = tmp_path / into
        # In this process, unless an option says otherwise.
        given = ["--out", out, "--jobs", 1, *options.split(), *more]
        assert main([str(each) for each in given]) == status
        return out

    return compared


@pytest.fixture
def undrawn(monkeypatch):
    """Leave out the pictures, which take most of the time."""
    monkeypatch.setattr(report, "_draw", lambda *_: "left out")


class TestCompare:
    def test_files_and_their_contents(self, compared, capsys):
        out = compared("--agents nn pi --scenarios constant constant-noise --runs 3")
        runs = pd.read_csv(out / "runs.csv")
        assert list(runs.columns) == ["scenario", "agent", "policy", "seed", *METRICS]
        cells = [(s, a) for a in ("nn", "pi") for s in ("constant", "constant-noise")]
        expected = [(s, a, 0, SEED + i) for s, a in cells for i in range(3)]
        assert list(runs.iloc[:, :4].itertuples(index=False, name=None)) == expected
        # The paper's PI is the same in every run without noise, and never settles.
        pi = runs[(runs.agent == "pi") & (runs.scenario == "constant")]
        assert pi["mae"].nunique() == 1
        assert pi["mae"].iloc[0] == pytest.approx(1.6, abs=0.05)
        assert set(pi["settling_time"]) == {"not settled"}

        summary = pd.read_csv(out / "summary.csv")
        row = summary.query("agent == 'nn' and scenario == 'constant' and metric == 'mae'")
        nn = runs[(runs.agent == "nn") & (runs.scenario == "constant")]["mae"]
        assert float(row["median"].iloc[0]) == pytest.approx(nn.median())
        assert float(row["p90"].iloc[0]) == pytest.approx(nn.quantile(0.9))

        limit = least_possible(samples=600, kind="reference", setpoint=5.0).value
        page, screen = (out / "report.md").read_text(), capsys.readouterr().out
        for shown in (page, (out / "report.html").read_text(), screen):
            assert f"{limit:.3f}" in shown
            assert f"{pi['mae'].iloc[0] / limit:.2f}" in shown
        assert f"{nn.median():.3f}" in page
        assert "not settled" in page
        assert page.index("| **NN (1992)**") < page.index("| PI (1992)")  # the best comes first

        provenance = json.loads((out / "provenance.json").read_text())
        assert provenance["complete"] is True
        assert provenance["seeds"] == [SEED, SEED + 1, SEED + 2]
        assert provenance["options"]["agents"] == ["nn", "pi"]
        assert {"gymnasium", "numpy", "torch"} <= set(provenance["versions"])

        responses = pd.read_csv(out / "constant.csv")
        assert len(responses) == 2 * 600
        assert (responses["output_p10"] <= responses["output_p90"]).all()
        for name in ("constant.png", "constant-noise.png", "bounds.png", "scores.png"):
            picture = matplotlib.image.imread(out / name)
            assert len(np.unique(picture.reshape(-1, picture.shape[2]), axis=0)) > 20

    def test_the_count_of_cores_changes_no_number(self, compared, tmp_path, monkeypatch):
        (tmp_path / "locked.py").write_text(
            "import threading\n"
            "from agents import PIController\n"
            "class Factory:\n"
            "    lock = None\n"
            "    def __init__(self): self.lock = threading.Lock()  # which cannot be pickled\n"
            "    def __call__(self): return PIController(kp=1.0, ki=0.02)\n"
            "    __module__ = 'locked'\n"
            "make = Factory()\n"
        )
        monkeypatch.syspath_prepend(tmp_path)
        get_reusable_executor().shutdown()  # whose processes know another path
        given = "--agents nn pi --agent bounds=locked:make --scenarios constant-noise constant"
        for jobs in ("1", "2"):
            compared(f"{given} --runs 2 --jobs {jobs}", into=jobs)
        for name in ("runs.csv", "summary.csv", "estimates.csv", "constant-noise.csv"):
            one, two = ((tmp_path / jobs / name).read_bytes() for jobs in ("1", "2"))
            assert one == two
            assert b"bounds" in one

    def test_a_picture_that_cannot_be_drawn_is_a_sentence(self, compared, monkeypatch):
        error = ValueError("Axis limits cannot be NaN or Inf")
        monkeypatch.setattr(plots, "plot_travel", Mock(side_effect=error))
        page = (compared(QUICK) / "report.md").read_text()
        assert "travel.png could not be drawn (ValueError: Axis limits cannot be" in page
        assert "(travel.png)" not in page

    @pytest.mark.parametrize("agents", ["pi pi-simc", "nothing"])
    def test_one_run_in_noise_is_drawn(self, agents, compared):
        out = compared(f"--agents {agents} --scenarios constant-noise --runs 1")
        page = (out / "report.md").read_text()
        assert "could not be drawn" not in page
        assert "(one run)" in page

    @pytest.mark.usefixtures("undrawn")
    def test_a_row_of_the_presets_is_what_evaluate_says(self, compared):
        parts = {"hard": ["nn", "nn-smith", "pi-simc"], "noisy": ["mpc"]}
        folders = [
            compared(f"--presets --runs 2 --scenarios {preset} --agents", *agents, into=preset)
            for preset, agents in parts.items()
        ]
        runs, estimates = (
            pd.concat([pd.read_csv(folder / name) for folder in folders])
            .set_index(["agent", "scenario"])
            .sort_index()
            for name in ("runs.csv", "estimates.csv")
        )
        assert (estimates["ratio"] > 1.0).all()
        for agent, preset in runs.index.unique():
            factory = ROSTER[agent].members()[0]
            controller = factory(PRESETS[preset], 2, SEED)
            found = evaluate(controller, IDS[preset], episodes=2, **factory.observation)
            row = runs.loc[agent, preset]
            assert list(row["seed"]) == list(found.seeds)
            np.testing.assert_allclose(row["mae"], found.errors, rtol=0, atol=1e-12)
            np.testing.assert_allclose(row["total_variation"], found.travels, atol=1e-9)
            against = estimates.loc[agent, preset]
            assert against["limit"] == pytest.approx(found.least_possible, abs=1e-12)
            assert against["ratio"] == pytest.approx(found.multiple, abs=1e-12)

    def test_policies_are_loaded_and_none_is_trained(self, compared):
        out = compared("--agents ppo --scenarios constant --runs 1 --jobs 1")
        files = [f"ppo-{seed}.npz" for seed in range(10_000, 10_005)]
        provenance = json.loads((out / "provenance.json").read_text())
        assert [each["file"] for each in provenance["policies"]["ppo"]] == files
        assert list(pd.read_csv(out / "runs.csv")["policy"]) == [*range(5)]

    @pytest.mark.usefixtures("undrawn")
    def test_the_example_of_the_page(self, compared, tmp_path, monkeypatch):
        readme = (ROOT / "benchmarks/compare/README.md").read_text(encoding="utf-8")
        (example,) = re.findall(r"```python\n(from agents import PIC.*?)```", readme, re.DOTALL)
        (option,) = re.findall(r"--agent (\w+=my_\S+)`", readme)
        (tmp_path / "my_controllers.py").write_text(example)
        monkeypatch.syspath_prepend(tmp_path)
        out = compared(f"--agents --agent {option} --scenarios constant --runs 1")
        runs = pd.read_csv(out / "runs.csv")
        assert runs["mae"].iloc[0] == pytest.approx(0.283, abs=0.001)  # that of the gains

    @pytest.fixture
    def stopped(self, compared, monkeypatch, capsys):
        """Return a function whose runs end in an error, and which returns what is said."""

        def stopped(error, after, status=130):
            ends = itertools.chain([DEFAULT] * after, itertools.repeat(error))
            monkeypatch.setattr(records, "rollout", Mock(wraps=rollout, side_effect=ends))
            compared("--agents pi nn --scenarios constant square --runs 1", status=status)
            return capsys.readouterr().out

        return stopped

    @staticmethod
    def assert_the_first_are_kept(out, count):
        kept = ["constant", "square", "square"][:count]
        assert list(pd.read_csv(out / "runs.csv")["scenario"]) == kept
        assert json.loads((out / "provenance.json").read_text())["complete"] is False

    @pytest.mark.parametrize(
        ("error", "after", "status", "said"),
        [
            (KeyboardInterrupt, 3, 130, ["Interrupted"]),
            (ZeroDivisionError, 2, 1, ["nn, constant: ZeroDiv", "nn, square: ZeroDiv"]),
        ],
    )
    def test_a_run_that_is_stopped_and_one_that_fails_keep_what_they_have(
        self, error, after, status, said, stopped, tmp_path
    ):
        shown = stopped(error, after, status)
        assert all(words in shown for words in said)
        self.assert_the_first_are_kept(tmp_path / "out", after)
        assert (tmp_path / "out/report.md").exists()
        assert (tmp_path / "out/square.png").exists()

    @pytest.mark.skipif(sys.platform == "win32", reason="no SIGTERM to another process")
    @pytest.mark.parametrize("jobs", ["1", "2"])
    def test_a_termination_leaves_what_has_finished(self, jobs, tmp_path):
        (tmp_path / "endless.py").write_text(
            "import pathlib, time\nfrom agents import PIController\n\n\n"
            "class Endless(PIController):\n"
            "    def act(self, seen):\n"
            "        if len(seen) == 3:\n"
            "            pathlib.Path(__file__).with_name('begun').touch()\n"
            "            time.sleep(300)\n"
            "        return super().act(seen)\n"
        )
        given = (
            "benchmarks.compare --agents pi --agent own=endless:Endless --scenarios constant "
            "--runs 3 --jobs"
        )
        with subprocess.Popen(
            [sys.executable, "-m", *given.split(), jobs, "--out", tmp_path],
            cwd=ROOT, env=os.environ | {"PYTHONPATH": str(tmp_path)}, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        ) as run:  # fmt: skip
            until((tmp_path / "begun").exists, 60.0)
            time.sleep(0.5)  # while the process before it is heard
            run.send_signal(signal.SIGTERM)
            said, _ = run.communicate(timeout=60)
        assert run.returncode == 128 + signal.SIGTERM
        assert "Interrupted: what has finished is written" in said
        assert pd.read_csv(tmp_path / "runs.csv")["agent"].tolist() == ["pi"] * 3
        assert "PI" in (tmp_path / "report.md").read_text()

    @pytest.mark.usefixtures("undrawn")
    def test_a_second_interruption_while_the_report_is_written(
        self, stopped, tmp_path, monkeypatch
    ):
        monkeypatch.setattr(report, "write_report", Mock(side_effect=KeyboardInterrupt))
        assert "Interrupted" in stopped(KeyboardInterrupt, after=2)
        self.assert_the_first_are_kept(tmp_path / "out", 2)

    def test_a_folder_that_cannot_be_written_to(self, tmp_path, monkeypatch, refused):
        (tmp_path / "file").write_text("in the way")
        monkeypatch.setattr(records, "rollout", None)  # nothing is run before
        for out in (tmp_path / "file", tmp_path / "file" / "below"):
            assert f"--out: {out} cannot be written to" in refused(main, ["--out", out])

        read_only = OSError(errno.EROFS, os.strerror(errno.EROFS))
        monkeypatch.setattr(tempfile, "TemporaryFile", Mock(side_effect=read_only))
        assert "Read-only file system" in refused(main, ["--out", tmp_path / "out"])

    @pytest.mark.parametrize("name", ["runs.csv", "bounds.png"])
    def test_a_disk_that_gets_full(self, name, compared, monkeypatch, capsys):
        real = Path.replace

        def replace(self, target):
            if Path(target).name == name:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return real(self, target)

        monkeypatch.setattr(Path, "replace", replace)
        out = compared(QUICK, status=1)
        shown = capsys.readouterr().out
        assert f"{name} could not be written: No space left on device" in shown
        assert not list(out.glob(".*"))

    def test_interrupted_before_anything_has_finished(self, stopped, tmp_path):
        runs = tmp_path / "out" / "runs.csv"
        runs.parent.mkdir()
        runs.write_text("of an earlier run")
        stopped(KeyboardInterrupt, after=0)
        assert runs.read_text() == "of an earlier run"

    def test_as_a_command(self, tmp_path):
        command = ["-m", "benchmarks.compare", *QUICK.split(), "--out", str(tmp_path / "out")]
        # Neither a backend that there is not nor a terminal without ° stops it.
        odd = os.environ | {"MPLBACKEND": "nonsense", "PYTHONIOENCODING": "ascii"}
        done = python(*command, env=odd, check=True)
        assert "0.709" in done.stdout
        assert "(?C)" in done.stdout
        assert (tmp_path / "out/report.md").exists()


@pytest.mark.usefixtures("undrawn")
class TestOtherPlants:
    @pytest.mark.parametrize(("preset", "drawn"), [("disturbed", False), ("hard", True)])
    def test_what_needs_the_actuators_numbers_is_not_measured_where_they_are_drawn(
        self, preset, drawn, compared
    ):
        out = compared(f"--preset {preset} --agents nothing pi --runs 2")
        report = (out / "report.md").read_text()
        assert "| PI" in report
        assert ("not measured" in report) is drawn

    def test_controllers_are_told_about_the_plant_that_is_run(self, compared, tmp_path):
        plant = {"b": [0.04560, 0.00404], "delay": 9, "a": [1, -0.9]}
        (tmp_path / "plant.json").write_text(json.dumps(plant))
        given = "--agents pi-simc smith --scenarios square --runs 1 --plant"
        out = compared(given, tmp_path / "plant.json")
        errors = pd.read_csv(out / "runs.csv").set_index("agent")["mae"]
        # Its gain has the other sign: who is told about the paper's plant drives it to a limit.
        assert (errors < 3.0).all()
        provenance = json.loads((out / "provenance.json").read_text())
        assert provenance["scenarios"]["square"]["arguments"] == plant

    def test_a_part_goes_to_a_folder_of_its_own(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        assert main([*QUICK.split(), "--set", "delay=30"]) == 0
        (folder,) = (tmp_path / "results").iterdir()
        assert folder.name == "compare-pi-constant-delay-30-1-runs"
