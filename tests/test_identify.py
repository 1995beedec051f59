"""Identification: the plant of a log is found, and what a log cannot show is said."""

import json
import re
from dataclasses import replace
from functools import cache

import gymnasium
import numpy as np
import pytest
from scipy import signal

from benchmarks.identify import Options, doubts, main, plant_arguments, read_log
from benchmarks.lib.storage import UsageError
from benchmarks.loop.identification import Dynamics, Log, identify
from mptc_gym import Parameters
from tests.conftest import ROOT

PAPER, GAIN = Parameters(), -0.6825  # the paper's plant, and its gain in degC per t/h
EXAMPLE = ROOT / "benchmarks/logs/example.csv"


def log_of(flow, dead_zone=5.0, sign=1.0):
    """Return a log of the paper's plant, whose temperature SciPy's filters make."""
    applied = np.where(np.abs(flow) < dead_zone, 0.0, flow)
    noise = np.random.default_rng(701).normal(0.0, 0.2, len(flow))
    b = [0.0] * (PAPER.delay + 1) + [sign * coefficient for coefficient in PAPER.b]
    temperature = signal.lfilter(b, PAPER.a, applied) + signal.lfilter(PAPER.c, PAPER.a, noise)
    return Log(flow, temperature, 8.0, np.zeros((len(flow), 0)))


def recorded(**plant):
    """Return a log that begins with a step; flows are held for 30 to 120 samples."""
    generator = np.random.default_rng(700)
    lengths = generator.integers(30, 121, 40)
    return log_of(np.repeat(generator.uniform(-10.0, 10.0, 40), lengths)[:1200], **plant)


@cache
def paper_plant():
    """Return the plant of a log with a gap that is far from 0; its dead zone is around 480."""
    temperature = recorded().temperature + 385.0
    temperature[200:203] = np.nan
    return identify(replace(recorded(), flow=recorded().flow + 480.0, temperature=temperature))


class TestPlant:
    @pytest.mark.parametrize(("delay", "fast"), [(3.0, 0.0), (20.5, 0.0), (16.0, 11.0)])
    def test_sampled_plant_is_the_continuous_one(self, delay, fast):
        plant, flow = Dynamics(delay, 30.0, fast), np.repeat([0.0, 1.0, -2.0], 12)
        moves = enumerate(np.diff(flow, prepend=0.0))
        truth = sum(move * plant.step_response(7.0 * (np.r_[:36] - k)) for k, move in moves)
        np.testing.assert_allclose(plant.respond(flow, 7.0), truth, atol=1e-9)

    def test_paper_plant_is_found_in_a_log_that_begins_with_a_step(self):
        truths = {"delay": 18, "dead_zone": 5.0, "gain": GAIN, "time_constant": 161.0}
        for name, truth in truths.items():
            value, low, high = paper_plant().estimates[name]
            assert low <= truth <= high, name
            assert value == pytest.approx(truth, rel=0.2), name
        assert paper_plant().operating_flow == pytest.approx(480.0, abs=1.0)
        assert doubts(paper_plant(), Options(EXAMPLE)) == []

    def test_environment_with_the_arguments_is_the_plant(self):
        plant = paper_plant()
        arguments = json.loads(json.dumps(plant_arguments(plant, Options(EXAMPLE))))
        env = gymnasium.make("MiddlePoint-v0", **{**arguments, "noise_variance": 0.0})
        env.reset()
        low, high, outputs = arguments["u_min"], arguments["u_max"], [0.0]
        for command in plant.fit.log.flow[:-1] - plant.operating_flow:
            action = np.array([2.0 * (command - low) / (high - low) - 1.0], np.float32)
            outputs.append(env.step(action)[-1]["output"])
        differences = plant.fit.simulated - plant.operating_temperature - outputs
        assert np.quantile(np.abs(differences[600:]), 0.98) < 2e-3

    @pytest.mark.parametrize("sign", [1.0, -1.0])
    def test_doublet_is_enough_for_gain_and_delay(self, sign):
        flow = np.repeat([0.0, 8.0, -8.0, 0.0], [40, 100, 100, 160])
        log = log_of(flow, dead_zone=0.0, sign=sign)
        estimates = identify(replace(log, flow=flow + 300.0)).estimates
        assert estimates["gain"].value == pytest.approx(sign * GAIN, rel=0.1)
        assert estimates["delay"].value == pytest.approx(18.0, abs=1.5)
        assert estimates["dead_zone"].high > 7.0  # three flows do not show it

    def test_step_of_a_load_is_taken_into_account(self):
        log = recorded(dead_zone=0.0)
        load = 6.0 * (1.0 - np.exp(-np.maximum(np.arange(1200) - 650, 0) / 20.0))
        plant = identify(replace(log, temperature=log.temperature + load), 0.0)
        assert plant.fit.loads[0] == pytest.approx(650 * 8.0, abs=80.0)
        assert plant.fit.gain == pytest.approx(GAIN, rel=0.05)


def table(line="16,5,1", mark="."):
    """Return the text of a log whose line 4 is this one, and whose other flows are 3."""
    rows = [f"{8 * k},3,{k % 7}{mark}25" for k in range(120)]
    return "\n".join(["time,flow,temperature", *rows[:2], line, *rows[3:]])


def dated(row):
    """Return the start of a row with a date: the end of a month, and then later."""
    return f"{np.datetime64('2026-01-31T23:59:59') + int(row[1])},"


WAYS = {
    "decimal commas": table(mark="|").replace(",", ";").replace("|", ","),
    "dates": re.sub(r"^(\d+),", dated, table(), flags=re.MULTILINE),
}
REFUSED = {
    "line 4: flow looks like thousands: '1,480'": table('16,"1,480",1'),
    "line 4: flow looks like thousands: '1.480'": table("16,1.480,1").replace(",", ";"),
    "line 4: a time step of 11.6 s: most steps are 8": table("19.6,5,1"),
}
# How the temperature of a log becomes one that asks for a warning, by what is said.
DOUBTS = {
    "in the last third": lambda y: y * np.linspace(2.0, -2.0, 1200),
    "a compressing historian": lambda y: np.interp(np.r_[:1200], np.r_[:1200:20], y[::20]),
    "100 rows in succession": lambda y: np.r_[y[:99], np.full(100, 3.0), y[199:]],
}


class TestLog:
    @pytest.mark.parametrize("way", WAYS)
    def test_ways_to_write_the_same_log(self, way, tmp_path):
        (tmp_path / "log.csv").write_text(WAYS[way])
        log = read_log(Options(tmp_path / "log.csv"))
        assert log.flow[:4].tolist() == [3.0, 3.0, 5.0, 3.0]
        assert log.temperature[:4].tolist() == [0.25, 1.25, 1.0, 3.25]

    @pytest.mark.parametrize("complaint", REFUSED)
    def test_what_cannot_be_used_is_named(self, complaint, tmp_path):
        (tmp_path / "log.csv").write_text(REFUSED[complaint])
        with pytest.raises(UsageError, match=complaint):
            read_log(Options(tmp_path / "log.csv"))

    @pytest.mark.parametrize("sentence", DOUBTS)
    def test_what_makes_a_log_doubtful_is_said(self, sentence):
        log = recorded()
        plant = identify(replace(log, temperature=DOUBTS[sentence](log.temperature)), 0.0)
        assert sentence in " ".join(doubts(plant, Options(EXAMPLE)))

    def test_everything_is_written(self, tmp_path):
        assert main([str(EXAMPLE), "--out", str(tmp_path)]) == 0
        for name in ("plant", "ranges"):
            arguments = json.loads((tmp_path / f"{name}.json").read_text())
            gymnasium.make("MiddlePoint-v0", **arguments).reset(seed=0)
        row = re.compile(r"\| gain +\| (\S+) +\| \[(\S+), (\S+)\]")
        value, low, high = map(float, row.search((tmp_path / "report.md").read_text()).groups())
        assert (
            low <= min(value, -0.819) <= max(value, -0.819) <= high
        )  # of the plant that the log was recorded from
