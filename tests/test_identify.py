"""Identification: known plants are found again, and what a log cannot tell is refused."""

import json
import re
from dataclasses import replace
from functools import cache
from itertools import accumulate

import gymnasium
import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from agents import PIController
from benchmarks.identify import study
from benchmarks.identify.__main__ import Options, main
from benchmarks.identify.advice import controllers, plants, responses, sensitivities
from benchmarks.identify.fit import Plant
from benchmarks.identify.log import Log, read_log
from benchmarks.identify.model import identify, resting_flow
from benchmarks.identify.report import report
from mptc_gym import Parameters
from tests.conftest import ROOT

PAPER = Parameters()
EXAMPLE = ROOT / "benchmarks/identify/example.csv"
TCLAB = ROOT / "benchmarks/identify/tclab.csv"


def answer(flow, generator, *, b=PAPER.b, delay=18, dead_zone=5.0, noise=0.05):
    """Return the temperature of the paper's plant, by SciPy's filters."""
    applied = np.where(np.abs(flow) < dead_zone, 0.0, flow)
    xi = generator.normal(0.0, np.sqrt(noise), len(flow))
    driven = signal.lfilter([0.0] * (delay + 1) + list(b), PAPER.a, applied)
    return driven + signal.lfilter(PAPER.c, PAPER.a, xi)


def recorded(samples=1200, **plant):
    """Return a log of a flow in steps that are held for 30 to 120 samples."""
    generator = np.random.default_rng(700)
    held = generator.integers(30, 121, samples // 30 + 1)
    flow = np.repeat(generator.uniform(-10.0, 10.0, len(held)), held)[:samples]
    return Log(flow, answer(flow, generator, **plant), 8.0)


@cache
def good():
    """Return what is found in a log with gaps of the paper's plant, not around 0."""
    log = recorded()
    log = Log(log.flow + 480.0, log.temperature + 385.0, 8.0,
              given=Options(EXAMPLE, operating_flow=480.0))  # fmt: skip
    log.temperature[[200, 201, 500, 777]] = np.nan
    return identify(log)


class TestFit:
    @settings(max_examples=15, deadline=None, derandomize=True)
    @given(
        delay=st.floats(0.0, 40.0),
        lags=st.sampled_from([[30.0], [30.0, 11.0], [9.0 + 5.0j, 9.0 - 5.0j]]),
        h=st.floats(0.5, 7.0),
    )
    def test_sampled_plant_is_the_continuous_one(self, delay, lags, h):
        # The flow is held between samples; a fine grid of the same plant stands for the truth.
        lags = np.array(lags, complex)
        plant = Plant(delay, lags, 1.0 + 0.2j * np.sign(lags.imag))
        flow, times = np.repeat([0.0, 1.0, -2.0, 0.5], 12), h * np.arange(48)
        coarse, moves = plant.simulated(flow, h), np.diff(flow, prepend=0.0)
        after = np.maximum(times[:, np.newaxis] - times - delay, 0.0)[..., np.newaxis]
        risen = (plant.gains * (1.0 - np.exp(-after / lags))).sum(axis=2).real
        truth = (risen * moves).sum(axis=1)
        np.testing.assert_allclose(coarse, truth, atol=1e-9)
        at_rest = plant.response(h, np.array([1e-9]))[0]
        assert at_rest.real == pytest.approx(plant.gain, rel=1e-3)

    def test_half_rule_by_hand(self):
        # 1 / ((10 s + 1) (4 s + 1)): half of the 4 s goes to the lag, and half to the delay.
        plant = Plant(3.0, np.array([10.0, 4.0]) + 0j, np.array([10.0, -4.0]) / 6.0 + 0j)
        assert plant.first_order() == pytest.approx((12.0, 5.0))

    def test_operating_flow_by_hand(self):
        # 0 or the first flow if it is in the middle half of the range, else the middle.
        for flows, found in (
            ([480, 470, 490], 480), ([60, 100, 0, 40], 60), ([5, -10], 0), ([100, 0, 100], 50),
        ):  # fmt: skip
            assert resting_flow(np.array(flows)) == found

    def test_dead_zone_is_known_up_to_the_gap_between_commands(self):
        generator = np.random.default_rng(701)
        flow = np.repeat(generator.choice([-7.0, -3.0, 0.0, 3.0, 7.0], 20), 40)
        model = identify(Log(flow, answer(flow, generator), 8.0))
        zone = model.estimates["dead_zone"]
        assert (zone.low, zone.high) == (pytest.approx(3.0), pytest.approx(7.0))
        # Nor is it known whether the flow beyond it rises from 0.
        assert "Valves of two kinds" in model.warnings[0]

    def test_log_that_is_sampled_too_often_is_fitted_by_means_of_rows(self):
        # The flow is held for 120 rows and more; a delay and a lag are 234 rows.
        log, often = recorded(600), 4
        flow = np.repeat(log.flow, often)
        whole = signal.lfilter([0.0] * 73 + [-0.6825 / 161.0], [1.0, 1.0 / 161.0 - 1.0],
                               np.where(np.abs(flow) < 5.0, 0.0, flow))  # fmt: skip
        noise = np.random.default_rng(702).normal(0.0, 0.1, len(flow))
        model = identify(Log(flow, whole + noise, 1.0))
        assert model.found.best.rows > 3
        assert model.warnings == []
        gain = model.estimates["gain"]
        assert gain.low <= -0.6825 <= gain.high

    def test_load_is_taken_into_account(self):
        log = recorded(noise=0.01)
        late = np.maximum(np.arange(1200) - 650, 0)
        moved = log.temperature + 4.0 * (1.0 - np.exp(-late / 20.0))
        model = identify(replace(log, temperature=moved))
        assert any(note.startswith("Loads seem") and " 86 " in note for note in model.notes)
        assert model.plant.gain == pytest.approx(-0.6825, rel=0.05)

    def test_heater_beside_another_one(self):
        # A real log. A plain impulse response of both heaters explains 97 %.
        names = {"flow": "heater1", "temperature": "temperature1", "disturbance": ("heater2",)}
        log = read_log(Options(TCLAB, **names))
        thinned = {"heater2": log.disturbances["heater2"][::10]}
        thin = Log(log.flow[::10], log.temperature[::10], 10.0, thinned)
        model = identify(thin)
        assert 0.96 < model.explained[0] < 1.0
        # Two levels, and the middle between them at first, do not test a valve.
        (warning,) = model.warnings
        assert "does not test the valve" in warning
        applied = Options(TCLAB, applied=True)  # a heater has no valve
        assert identify(replace(thin, given=applied)).warnings == []
        assert any("cannot hold heater2" in note for note in model.notes)


def behind(log, rule):
    """Return the temperature behind a valve that moves from p to `rule(p, u)`."""
    flow = np.array([*accumulate([0.0, *log.flow], rule)])[1:]
    return answer(flow, np.random.default_rng(3), dead_zone=0.0, noise=0.01)


class TestValves:
    def test_slow_valve_is_taken_into_account(self):
        log = recorded(700)
        slow = behind(log, lambda p, u: p + min(max(u - p, -0.3), 0.3))
        model = identify(replace(log, temperature=slow))
        assert any("rate limit" in note for note in model.notes)
        assert model.plant.gain == pytest.approx(-0.6825, rel=0.05)

    @pytest.mark.parametrize(
        ("seed", "fault", "recommended"),
        [
            (91_010, "none", 1),
            (91_011, "none", 1),
            (92_000, "stiction with a slip", 0),
            (92_000, "rate limit", 1),
            (92_000, "gain by level", 0),
            (92_000, "two levels, saturation", 0),
            # Without it, the plant seems slow: the true Ms of a loop for that one is 3.
            (90_062, "backlash", 0),
        ],
    )
    def test_plants_are_found_and_controlled_or_refused(self, seed, fault, recommended):
        found = study.tried(seed, fault)
        assert (found["recommended"], found["unsafe"]) == (recommended, 0)
        if fault == "none":
            assert all(found[name] for name in ("delay", "gain", "dead_zone"))
            assert found["Ms, delay a fifth off"] < 2.5


class TestFound:
    """What is found in a log of the paper's plant, and recommended for it."""

    def test_paper_plant_is_found(self):
        truths = {"delay": 18, "dead_zone": 5.0, "gain": -0.6825, "time_constant": 161.0}
        for name, truth in truths.items():
            value, low, high = good().estimates[name]
            assert low <= truth <= high, name
            assert value == pytest.approx(truth, rel=0.2), name
        assert good().warnings == []
        assert good().operating_flow == 480.0
        assert good().operating_temperature == pytest.approx(385.0, abs=0.5)
        assert np.isfinite(good().simulated).all()

    def test_ms_is_that_of_the_loop(self):
        # A plant of first order, and the stability limit of pure integration with a delay.
        plant, pi = Plant(40.0, np.array([100.0 + 0j]), np.array([2.0 + 0j])), (-0.5, -0.005)
        loops = responses([plant], 1.0)
        calm, wild = (sensitivities(PIController(*x), *loops) for x in (pi, (-3.0, -0.03)))
        at = np.geomspace(1e-4, np.pi, 4000)
        s = np.exp(1j * at) - 1.0
        law = 0.5 + 0.005 * (s + 1.0) / s
        late = 1.0 + law * replace(plant, delay=48.0).response(1.0, at)  # a fifth longer
        assert calm[0] == pytest.approx(1.0 / np.abs(late).min(), rel=1e-3)
        assert wild[0] == np.inf

    @pytest.mark.parametrize(("direction", "zone"), [(1.0, 5.0), (-1.0, 0.0)])
    def test_typed_controllers_hold_a_real_loop(self, direction, zone):
        """The arguments are those of `agents`; kp has the sign that engineers expect."""
        b = [direction * each for each in PAPER.b]
        model = good() if zone else identify(recorded(800, b=b, dead_zone=zone, noise=0.01))
        listed = json.loads(json.dumps(controllers(model)))
        (pi,) = listed["recommended"]
        assert (listed["warnings"], pi["controller"]) == ([], "pi-simc")
        assert np.sign(pi["kp"]) == -direction  # the gain of the paper's B is negative
        assert pi["action"] == ("reverse" if direction < 0.0 else "direct")
        assert max(pi["sensitivity"]) <= 1.8
        env = gymnasium.make("MiddlePoint-v0", b=b, dead_zone=zone, setpoint=4.0)
        controller = PIController(**pi["arguments"])
        observation, _ = env.reset(seed=0)
        for _ in range(400):
            controller.act(observation)
            action = np.array([controller.command / 10.0], np.float32)
            observation, *_, info = env.step(action)
        assert abs(info["error"]) < 0.05
        assert pi["arguments"]["kp"] == -pi["kp"]
        assert pi["arguments"]["ki"] == pytest.approx(-pi["kp"] * 8.0 / pi["ti"])
        assert pi["ti"] == pytest.approx(161.0, rel=0.1)  # SIMC's: the time constant
        assert pi["model"]["delay"] == pytest.approx(19 * 8.0, rel=0.1)
        assert pi["units"] == {
            "kp": "t/h per °C",
            "ti": "s",
            "flow": "t/h",
            "temperature": "°C",
        }
        assert pi["limits"]["low"] == pytest.approx(model.operating_flow + model.u_min)
        assert set(pi["operating_point"]) == {"flow", "temperature"}

    def test_what_the_log_leaves_open_slows_the_loop(self):
        more = good().possible.copy()
        more[::10] = [replace(each, gains=1.5 * each.gains) for each in more[::10]]
        (known,), (open_,) = (
            controllers(each)["recommended"]
            for each in (good(), replace(good(), possible=more))
        )
        assert known["slowed"] < 1.4
        assert open_["slowed"] > 1.3 * known["slowed"]
        assert open_["sensitivity"][1] <= 1.8

    def test_plant_is_the_environment_s(self):
        # The environment does what the simulation of the log shows, once it has forgotten that
        # it was at rest before k = 0.
        model = good()
        arguments = json.loads(json.dumps(plants(model)[0]))
        calm = {**arguments, "noise_variance": 0.0}
        env = gymnasium.make("MiddlePoint-v0", max_episode_steps=1200, **calm)
        env.reset()
        low, high, outputs = arguments["u_min"], arguments["u_max"], [0.0]
        for u in model.log.flow[:-1] - model.operating_flow:
            action = np.array([2.0 * (u - low) / (high - low) - 1.0], np.float32)
            outputs.append(env.step(action)[-1]["output"])
        simulated = model.simulated - model.operating_temperature
        np.testing.assert_allclose(simulated[600:], outputs[600:], atol=2e-3)
        left = np.nanvar(model.log.temperature - model.simulated)
        noise = signal.lfilter(arguments["c"], arguments["a"], np.eye(1, 3000)[0])
        assert arguments["noise_variance"] * (noise**2).sum() == pytest.approx(left, rel=0.4)

    def test_ranges_hold_the_plant_and_can_be_drawn_from(self):
        plant, ranges = plants(good())
        env = gymnasium.make("MiddlePoint-v0", **json.loads(json.dumps(ranges)))
        env.reset(seed=0)
        factors = {"gain_factor": 1.0, "time_constant_factor": 1.0}
        names = [name for name, value in ranges.items()
                 if isinstance(value, list) and name not in "abc"]  # fmt: skip
        assert {"delay", "dead_zone", "noise_variance", *factors} <= set(names)
        for name in names:
            low, high = ranges[name]
            assert low <= {**plant, **factors}[name] <= high

    def test_plant_that_the_environment_does_not_have_is_refused_with_advice(self):
        log = replace(good().log, temperature=1e8 * good().log.temperature)
        model = replace(good(), log=log, simulated=1e8 * good().simulated)
        with pytest.raises(ValueError, match=r"noise_variance .* --temperature-unit"):
            plants(model)

    def test_units_are_those_of_the_log(self):
        given = Options(EXAMPLE, flow_unit="%", temperature_unit="K")
        model = replace(good(), log=replace(good().log, given=given))
        text = str([section.text for section in report(model, controllers(model))])
        assert "t/h" not in text
        assert "°C" not in text
        assert "% per K" in text


def closed_loop(log):
    plant = study.Plant(
        fault="none", size=0.1, zone=0.0, h=8.0, gain=-7.0, delay=150.0, lags=[161.0], lead=0.0
    )
    noise = np.random.default_rng(706).normal(0.0, 0.5, 1200)
    return study.simulate(plant, np.zeros(1200), noise, -0.1, 161.0)


# What is said, and how a log of the paper's plant becomes one that cannot tell.
REFUSED = {
    "the flow is constant": lambda log: (np.full(1200, 3.0), log.temperature),
    "the temperature is constant": lambda log: (log.flow, np.full(1200, 385.0)),
    "nothing else moves it: in a closed loop": closed_loop,
    "does not show where": lambda log: (
        log.flow, np.cumsum(0.05 * log.flow) + np.random.default_rng(704).normal(size=1200)
    ),
}  # fmt: skip
DOUBTED = {
    "The delay may be longer": lambda log: (log.flow, np.roll(log.temperature, 175)),
    r"stiction of [\d.]+ .*The test that tells": lambda log: (
        log.flow, behind(log, lambda p, u: u if abs(u - p) > 5.0 else p)
    ),
    "The plant seems to change: gain by time": lambda log: (
        log.flow, log.temperature * np.linspace(0.4, 1.6, 700)
    ),
}  # fmt: skip


class TestGuards:
    @pytest.mark.parametrize("said", REFUSED)
    def test_log_that_shows_no_plant_is_refused(self, said):
        flow, temperature = REFUSED[said](recorded(noise=0.3))
        with pytest.raises(ValueError, match=said):
            identify(Log(flow, temperature, 8.0))

    @pytest.mark.parametrize("said", DOUBTED)
    def test_nothing_is_recommended_on_a_doubtful_model(self, said):
        flow, temperature = DOUBTED[said](recorded(700))
        model = identify(Log(flow, temperature, 8.0))
        assert re.search(said, " ".join(model.warnings))
        advised = controllers(model)
        assert advised == {"recommended": [], "warnings": model.warnings}
        assert report(model, advised)[0].text[0].startswith("**Nothing is recommended.**")


def table(**columns):
    log = recorded(400)
    times = 8.0 * np.arange(400)
    whole = pd.DataFrame({"time": times, "flow": log.flow, "temperature": log.temperature})
    return whole.assign(**columns)


def csv(log=None, **options):
    return (table() if log is None else log).to_csv(index=False, **options)


def dated(form):
    # Over the end of a month; a month that was taken for the day would go backwards.
    dates = pd.date_range("2026-01-31T23:50:00", periods=400, freq="8s")
    return csv(table(time=dates.strftime(form)))


def with_line(line):
    """Return a log whose line 4 is this one."""
    good = [f"{8 * k},1.0,1.0" for k in range(120)]
    return "\n".join(["time,flow,temperature", *good[:2], line, *good[3:]])


# Text and options of the same log.
WAYS = {
    "commas": (csv(), {}),
    "semicolons": (csv(sep=";"), {}),
    "semicolons, decimal commas": (csv(sep=";", decimal=","), {}),
    "tabs, decimal commas": (csv(sep="\t", decimal=","), {}),
    "quoted decimal commas": (csv(table().map(str), quoting=2).replace(".", ","), {}),
    "commas at the ends": (csv(lineterminator=",\n").replace(",\n", "\n", 1), {}),
    "ISO dates": (dated("%Y-%m-%dT%H:%M:%S"), {}),
    "dates with points": (dated("%d.%m.%Y %H:%M:%S"), {}),
    "minutes": (csv(table(time=np.arange(400) / 7.5)), {"time_unit": "min"}),
    "other headings": (csv().replace("flow", "Flow [kg/s]"), {"flow": "Flow [kg/s]"}),
    "days": (csv(table(time=46053.5 + np.arange(400) / 10800)), {"time_unit": "D"}),
}  # fmt: skip
# Text and options of what is no log, by what is said.
FAULTS = {
    "too short: 0 rows": ("time,flow,temperature\n", {}),
    "is not a table: .* With decimal commas": (with_line("16,1,0,1,5"), {}),
    "line 4: flow must be a number, got 'broken'": (with_line("16,broken,1.0"), {}),
    "line 4: temperature must be a number, got '4e300'": (with_line("16,1.0,4e300"), {}),
    "line 4: time must be a number or a date, got 'soon'": (with_line("soon,1.0,1.0"), {}),
    "line 4: time must be a number or a date, got 'nan'": (with_line(",1.0,1.0"), {}),
    "line 4: time must be a date": (dated("%Y-%m-%dT%H:%M:%S").replace("50:16", "50:6x"), {}),
    "line 4: a time step of -4 s: times must increase": (with_line("4,1.0,1.0"), {}),
    "line 4: a time step of 11.5 s: most steps are 8": (with_line("19.5,1.0,1.0"), {}),
    "line 202: a time step of 808 s: rows are missing": (
        csv(table(time=8.0 * np.arange(400) + np.repeat([0.0, 800.0], 200))), {},
    ),
    "if the times are days, say --time-unit D": (csv(table(time=np.arange(400) / 1e4)), {}),
    "no column 'flow'; it has 'time', 'flown', 'temp": (csv().replace("flow", "flown"), {}),
    "one thing only": (csv(), {"temperature": "flow"}),
    "250 of 400 values .* missing": (csv(table(flow=[np.nan] * 250 + [1.0] * 150)), {}),
}  # fmt: skip


@pytest.fixture
def read(tmp_path):
    """Return a function that reads the text of a log."""

    def of_text(text, **columns):
        (tmp_path / "log.csv").write_text(text)
        return read_log(Options(tmp_path / "log.csv", **columns))

    return of_text


class TestLog:
    @pytest.mark.parametrize("way", WAYS)
    def test_ways_to_write_the_same_log(self, read, way):
        text, columns = WAYS[way]
        log, expected = read(text, **columns), recorded(400)
        np.testing.assert_allclose(log.flow, expected.flow, rtol=1e-9)
        np.testing.assert_allclose(log.temperature, expected.temperature, 1e-9, 1e-9)
        assert log.sampling_interval == pytest.approx(8.0)
        assert not any("missing" in note for note in log.notes)

    def test_clocks_may_jitter_by_a_quarter_of_a_sample(self, read):
        jitter = np.random.default_rng(718).uniform(-2.0, 2.0, 400)
        log = read(csv(table(time=8.0 * np.arange(400) + jitter)))
        assert log.sampling_interval == pytest.approx(8.0, rel=0.01)
        np.testing.assert_array_equal(log.temperature, read(csv()).temperature)

    def test_missing_rows_and_numbers_are_gaps(self, read):
        gappy = table().drop(index=[100, 101, 102])
        gappy.loc[50, "temperature"] = np.nan
        log = read(csv(gappy))
        assert len(log.flow) == 400
        assert np.flatnonzero(np.isnan(log.temperature)).tolist() == [50, 100, 101, 102]
        assert any("4 values of 'temperature'" in note for note in log.notes)
        np.testing.assert_array_equal(log.flow[100:103], log.flow[99])

    @pytest.mark.parametrize("complaint", FAULTS)
    def test_what_cannot_be_read_is_named(self, read, complaint):
        text, columns = FAULTS[complaint]
        with pytest.raises(ValueError, match=complaint):
            read(text, **columns)


def test_everything_is_written(tmp_path, capsys):
    assert main([str(EXAMPLE), "--out", str(tmp_path)]) == 0
    plant = json.loads((tmp_path / "plant.json").read_text())
    gymnasium.make("MiddlePoint-v0", **plant).reset(seed=0)
    gymnasium.make("MiddlePoint-v0", **json.loads((tmp_path / "ranges.json").read_text()))
    text = (tmp_path / "report.md").read_text()
    assert (tmp_path / "report.html").read_text().count("data:image/png") == 1
    value, low, high = map(float, re.search(
        r"\| gain +\| (\S+) +\| \[(\S+), (\S+)\]", text).groups())  # fmt: skip
    assert low <= value <= high
    assert low <= -0.819 <= high
    pi = json.loads((tmp_path / "controllers.json").read_text())["recommended"][0]
    assert f"Kp = {pi['kp']:.4g} t/h per °C and Ti = {pi['ti']:.3g} s, direct" in text
    assert "time constant" in capsys.readouterr().out
