"""Identification: known plants are found again, and a log that cannot tell is refused."""

import contextlib
import json
import re
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from agents import PIController
from benchmarks.identify import log as log_module
from benchmarks.identify.__main__ import Columns, Knowledge, main
from benchmarks.identify.armax import Orders, Rows
from benchmarks.identify.cleaning import without_noise_of_held_flow, without_standstill
from benchmarks.identify.fit import identify
from benchmarks.identify.guards import doubts
from benchmarks.identify.likelihood import Likelihood
from benchmarks.identify.log import Log, read_log
from benchmarks.identify.model import CannotTellError, HeldOut, Interval
from benchmarks.identify.plant import plant_arguments, plant_ranges
from benchmarks.identify.report import headline, recommendations, report
from benchmarks.identify.study import command as study
from benchmarks.identify.study.faults import faulty
from benchmarks.identify.tuning import recommended
from benchmarks.loop.linear import nominal
from benchmarks.loop.margins import Loop
from benchmarks.loop.rollout import make_plants, rollout
from mptc_gym import Parameters

PAPER = Parameters()
EXAMPLE = Path(log_module.__file__).with_name("example.csv")
TCLAB = EXAMPLE.with_name("tclab.csv")


def steps(generator, samples, low=-10.0, high=10.0):
    """Return a flow in steps that are held for 30 to 120 samples."""
    flow = []
    while len(flow) < samples:
        flow += [generator.uniform(low, high)] * int(generator.integers(30, 121))
    return np.array(flow[:samples])


def answer(flow, generator, *, b=PAPER.b, delay=18, dead_zone=5.0, noise=0.05):
    """Return the temperature of the paper's plant, by SciPy's filters."""
    applied = np.where(np.abs(flow) < dead_zone, 0.0, flow)
    xi = generator.normal(0.0, np.sqrt(noise), len(flow))
    driven = signal.lfilter([0.0] * (delay + 1) + list(b), PAPER.a, applied)
    return driven + signal.lfilter(PAPER.c, PAPER.a, xi)


def recorded(samples=1200, seed=700, **plant):
    generator = np.random.default_rng(seed)
    flow = steps(generator, samples)
    return Log(flow, answer(flow, generator, **plant), 8.0)


@pytest.fixture(scope="module")
def good():
    """Return a log of the paper's plant, and what is found in it."""
    log = recorded()
    return log, identify(log)


class TestFit:
    def test_paper_plant_is_found(self, good):
        truths = {  # and how far an estimate may be off
            "delay": (18, 0.0), "dead_zone": (5.0, 1.0), "gain": (-0.6825, 0.068),
            "time_constant": (161.0, 32.0), "noise_variance": (0.05, 0.005),
        }  # fmt: skip
        for name, (truth, off) in truths.items():
            value, low, high = good[1].estimates[name]
            assert low <= truth <= high, name
            assert value == pytest.approx(truth, abs=off), name

    def test_log_without_noise_needs_no_higher_orders(self):
        model = identify(recorded(noise=0.0))
        assert (model.orders.a, model.orders.b) == (2, 2)
        for name in ("gain", "time_constant"):
            found = model.estimates[name]
            assert found.high - found.low < 0.01 * abs(found.value)
        Parameters(**plant_ranges(model))

    def test_operating_point_is_found_and_deviations_are_from_it(self, good):
        log, plain = good
        shifted = Log(log.flow + 480.0, log.temperature + 385.0, 8.0)
        model = identify(shifted, Knowledge(operating_flow=480.0))
        np.testing.assert_allclose(model.plant.a, plain.plant.a, rtol=1e-4)
        assert model.operating_flow == 480.0
        assert model.operating_temperature == pytest.approx(385.0, abs=0.5)

    @pytest.mark.parametrize(
        ("flow", "found"),
        [([480.0, 470.0, 490.0], 480.0), ([60.0, 100.0, 0.0, 40.0], 60.0), ([5.0, -10.0], 0.0),
         ([100.0, 0.0, 100.0], 50.0), ([-1.0, 99.0], 49.0)],
    )  # fmt: skip
    def test_operating_point_has_room_on_both_sides(self, flow, found):
        # 0 or the first flow if it is in the middle half of the range, else the middle.
        log = recorded(400)
        held = np.tile(np.repeat(flow, 40), 8)[:400]
        likelihood = Likelihood(replace(log, flow=held), Knowledge())
        assert likelihood.operating_flow == found
        assert likelihood.u_min < 0.0 < likelihood.u_max

    def test_dead_zone_is_known_up_to_the_gap_between_commands(self):
        # Magnitudes 3 and 7 only: the dead zone may be anything from 3 to 7, with 95 % of the
        # probability from 3.1 to 6.9.
        generator = np.random.default_rng(701)
        flow = np.repeat(generator.choice([-7.0, -3.0, 3.0, 7.0], 40), 40)
        found = identify(Log(flow, answer(flow, generator), 8.0)).estimates["dead_zone"]
        assert found.value == pytest.approx(5.0)
        assert (found.low, found.high) == (pytest.approx(3.1), pytest.approx(6.9))

    def test_gaps_are_left_out(self, good):
        log, whole = good
        flow, temperature = log.flow.copy(), log.temperature.copy()
        temperature[[200, 201, 500, 777]] = np.nan
        flow[900:905] = np.nan
        model = identify(Log(flow, temperature, 8.0))
        assert np.isnan(model.errors[[200, 202, 500, 777, 925]]).all()
        assert model.estimates["delay"].value == 18
        assert model.plant.gain == pytest.approx(whole.plant.gain, rel=0.05)

    def test_delay_beyond_what_was_looked_for_is_said(self):
        model = identify(recorded(noise=0.02), Knowledge(longest_delay=17))
        assert any("longer --longest-delay" in each for each in model.warnings)


def found_in(flow, response, generator, **options):
    """Return what is found in a log with noise of a fiftieth of the response's deviation."""
    noise = signal.lfilter([1.0], [1.0, -0.8], generator.normal(size=len(flow)))
    temperature = response + noise / np.std(noise) * 0.02 * np.std(response)
    return identify(Log(flow, temperature, 8.0), Knowledge(applied=True, **options))


class TestRealLogs:
    """What recorders and real plants do."""

    def test_heater_beside_another_one(self):
        # No one here made this plant. A plain impulse response of both heaters explains 97 %.
        log = read_log(TCLAB, Columns(flow="heater1", temperature="temperature1",
                                      disturbance=("heater2",)))  # fmt: skip
        known = log.flow, log.disturbances["heater2"], log.temperature
        heater, other, warm = (each[::3] for each in known)
        model = identify(Log(heater, warm, 3.0, disturbances={"heater2": other}))
        assert 0.95 < model.held_out.model < 1.0
        assert model.held_out.impulse_response > 0.9
        assert not model.warnings
        assert 0.0 < model.known["heater2"].gain < 0.3 * model.plant.gain
        others = {"heater2": other, "twice": 2.0 * warm}
        alone = identify(Log(heater, warm, 3.0, others=others))
        assert alone.held_out.model < model.held_out.model - 0.02
        advice = [note for note in alone.notes if "--disturbance" in note]
        assert "--disturbance heater2" in advice[0]
        assert "twice" not in advice[0]  # an answer, as it moves all the time

    @pytest.mark.parametrize(
        ("places", "changed", "said", "rel"),
        [
            ([20, 400, 401, 900], [40, -30, -30, 25], "4 spikes of the temperature", 0.02),
            (np.s_[801:], None, "In 399 rows the temperature stands still", 0.2),
        ],
    )
    def test_faults_of_a_recorder_are_mended_and_said(self, places, changed, said, rel, good):
        log, whole = good
        faulty = log.temperature.copy()
        faulty[places] = faulty[800] if changed is None else faulty[places] + changed
        model = identify(Log(log.flow, faulty, 8.0))
        assert any(said in note for note in model.notes)
        assert model.plant.gain == pytest.approx(whole.plant.gain, rel=rel)
        left = model.log.temperature - model.simulated
        assert np.nanvar(left) < 0.1 * np.nanvar(model.log.temperature)

    def test_coarse_sensor_is_not_stuck(self, good):
        coarse = replace(good[0], temperature=np.round(good[0].temperature))
        assert without_standstill(coarse) is coarse

    def test_fast_response_is_no_spike(self):
        generator = np.random.default_rng(710)
        flow = np.repeat(generator.uniform(-5, 5, 150), 8)
        model = found_in(flow, signal.lfilter([0.0, 1.0, -0.8], [1.0], flow), generator)
        assert not any("spike" in note for note in model.notes)
        assert model.held_out.model > 0.99

    def test_noise_of_a_flow_meter_is_taken_from_a_held_flow(self, good):
        log, whole = good
        noisy = log.flow + np.random.default_rng(711).normal(0.0, 0.1, 1200)
        model = identify(Log(noisy, log.temperature, 8.0))
        assert any("taken as the flow meter's" in note for note in model.notes)
        zone = model.estimates["dead_zone"]
        assert zone.low <= 5.0 <= zone.high
        assert model.plant.gain == pytest.approx(whole.plant.gain, rel=0.02)

    def test_small_steps_are_told_from_the_noise_of_a_flow_meter(self):
        generator = np.random.default_rng(716)
        flow = np.repeat([0.0, 3.0, 3.3, -2.0, -2.4, 1.0, 5.0, 4.8], 60)
        noisy = flow + generator.normal(0.0, 0.1, len(flow))
        cleaned = without_noise_of_held_flow(Log(noisy, flow, 8.0))
        assert np.abs(cleaned.flow - flow).max() < 0.1
        assert cleaned.flow_error == pytest.approx(0.1 / np.sqrt(60), rel=0.2)
        # What only wanders is not held, and stays as it is.
        wander = np.cumsum(noisy - flow)
        assert without_noise_of_held_flow(Log(wander, flow, 8.0)).flow is wander

    def test_walk_that_no_criterion_asks_for_is_allowed_for(self):
        # The noise is as slow as the walk. Without a walk, the gain's interval ends at -0.92.
        plant = {"delay": 18, "dead_zone": 6.7971, "noise_variance": 0.253856,
                 "gain_factor": 1.3164, "time_constant_factor": 1.5111}  # fmt: skip
        model = identify(study.synthetic_log(plant, 1200, 101_000_002, "drift"))
        assert model.noise["disturbance_walk_variance"] == 0.0
        gain = model.estimates["gain"]
        assert gain.low < 1.3164 * -0.6825 < gain.high < -0.3

    def test_base_line_that_wanders_is_the_plant_s_disturbance(self):
        log = recorded(noise=0.01)
        walk = np.cumsum(np.random.default_rng(712).normal(0.0, 0.1, 1200))
        model = identify(Log(log.flow, log.temperature + walk, 8.0))
        found = plant_arguments(model)["disturbance_walk_variance"]
        assert found == pytest.approx(0.01, rel=0.5)
        assert any("The base line wanders by 0." in note for note in model.notes)
        gain = model.estimates["gain"]
        assert gain.low <= -0.6825 <= gain.high

    def test_white_noise_is_the_transmitter_s(self, tmp_path):
        log = recorded(noise=1e-4)
        white = np.random.default_rng(713).normal(0.0, 0.3, 1200)
        model = identify(Log(log.flow, log.temperature + white, 8.0))
        found = plant_arguments(model)["measurement_noise_variance"]
        assert found == pytest.approx(0.09, rel=0.3)
        # The table's noise variance is not that of `plant.json` then.
        assert "`plant.json` splits it" in report(model, [], tmp_path)[0].text[-1]

    def test_response_that_is_over_in_ten_samples_with_a_slow_tail(self):
        generator = np.random.default_rng(714)
        flow = np.repeat(generator.uniform(0.2, 0.9, 250), 8)
        impulse = [0.0, 0.3, -0.3, -1.2, -2.0, -1.5, -0.8, -0.4, -0.2, -0.1]
        tail = signal.lfilter([0.0, 0.03], [1.0, -0.98], flow)
        model = found_in(flow, signal.lfilter(impulse, [1.0], flow) - tail, generator)
        assert model.held_out.model > 0.97
        assert model.plant.gain == pytest.approx(sum(impulse) - 1.5, rel=0.1)

    @settings(max_examples=4, deadline=None, derandomize=True)
    @given(
        seed=st.integers(0, 10**6),
        poles=st.lists(st.floats(-0.9, 0.9999), max_size=2),
        b=st.lists(st.floats(-2.0, 2.0), min_size=1, max_size=3),
        rows=st.integers(100, 300),
        hold=st.sampled_from([1, 7, 60]),
        missing=st.sampled_from([0.0, 0.02, 0.6]),
        step=st.sampled_from([0.0, 1.0]),
    )
    def test_no_log_ends_in_a_traceback(self, seed, poles, b, rows, hold, missing, step):
        generator = np.random.default_rng(seed)
        flow = np.repeat(generator.uniform(-5, 5, rows // hold + 1), hold)[:rows]
        answered = signal.lfilter([0.0, *b], np.poly(poles), flow)
        temperature = answered + 0.1 * generator.normal(size=rows)
        if step:
            temperature = np.round(temperature / step) * step
        temperature[generator.random(rows) < missing] = np.nan
        try:
            model = identify(Log(flow, temperature, 1.0), Knowledge(longest_delay=10))
            Parameters(**plant_ranges(model))
            recommended(model)
        except ValueError:
            pass  # refused, for one of the reasons that are tested above


class TestTuning:
    @pytest.mark.parametrize(
        ("a", "b"),
        [([1.0, -0.3], [0.7]), ([1.0, -1.6, 0.95], [0.2]), ([1.0, -0.95], [-0.1, 0.15])],
    )
    def test_recommended_loops_are_robust_on_the_true_plant(self, a, b):
        generator = np.random.default_rng(715)
        flow = steps(generator, 1000)
        model = found_in(flow, signal.lfilter([0.0] * 4 + b, a, flow), generator)
        true = Parameters(a=a, b=b, delay=3, dead_zone=0.0)
        found = recommended(model)
        assert found[0].name == "pi-simc"
        for each in found:
            assert each.worst <= 2.0
            assert Loop(each.controller, nominal(true)).margins.sensitivity <= 2.0
            assert each.error.value <= found[0].error.value  # Smith where it is better

    def test_what_the_log_leaves_open_slows_the_loop(self, good):
        tuned, known = recommended(identify(recorded(300, noise=0.3))), recommended(good[1])
        assert known[0].slowed == 1.0
        assert not tuned or tuned[0].worst > known[0].worst + 0.05

    @pytest.mark.parametrize("direction", [-1.0, 1.0])
    def test_gains_are_those_that_engineers_type_in(self, direction):
        # The flow rises when the temperature is below its set point if that warms the plant.
        b = [direction * each for each in PAPER.b]
        model = identify(recorded(b=b, dead_zone=0.0, noise=0.01))
        found = recommended(model)
        listed = recommendations(model, found)
        pi, smith = listed["recommended"]
        assert listed["warnings"] == []
        assert np.sign(pi["kp"]) == -direction  # the gain of the paper's B is negative
        assert pi["action"] == ("reverse" if direction < 0.0 else "direct")
        assert pi["ti"] == pytest.approx(161.0, rel=0.1)  # SIMC's: the time constant
        assert smith["model"]["delay"] == pytest.approx(19 * 8.0)
        assert smith["dead_zone"] == model.estimates["dead_zone"].value
        controller = found[0].controller
        controller.reset()
        controller.act([0.0, 0.0, 0.0, 1.0])  # y is 1 degC below its set point
        assert controller.command == pytest.approx(pi["kp"] * (1.0 + 8.0 / pi["ti"]))


# Changes to a good model, and what is said of it.
DOUBTS = {
    "leaves more than half open": lambda m: {"held_out": HeldOut(0.45, 0.4)},
    "twice as much open as an impulse response": lambda m: {"held_out": HeldOut(0.6, 0.9)},
    "the direction": lambda m: {
        "estimates": {**m.estimates, "gain": Interval(-0.7, -1.0, 0.1)}
    },
    "gain lies outside its own interval": lambda m: {
        "estimates": {**m.estimates, "gain": Interval(-0.7, -0.6, -0.5)}
    },
    "step response is outside its own band": lambda m: {
        "plant": replace(m.plant, b=[1.5 * b for b in m.plant.b])
    },
    "far from white": lambda m: {"errors": np.convolve(m.errors, np.ones(20))},
}  # fmt: skip


class TestGuards:
    def test_good_model_is_not_doubted(self, good):
        assert good[1].warnings == doubts(good[1], 60) == []

    @pytest.mark.parametrize("said", DOUBTS)
    def test_nothing_is_recommended_on_a_doubtful_model(self, good, said):
        doubtful = replace(good[1], **DOUBTS[said](good[1]))
        assert any(said in sentence for sentence in doubts(doubtful, 60))
        doubtful = replace(doubtful, warnings=doubts(doubtful, 60))
        assert recommended(doubtful) == []
        assert headline(doubtful)[0].startswith("**Nothing is recommended.**")

    @pytest.mark.parametrize(
        ("kind", "number", "said"),
        [("backlash", 3, "backlash of"), ("backlash, loop", 1, "backlash of"),
         ("stiction", 4, "stiction of"), ("two gains", 0, "times that below"),
         ("dead zone off centre", 3, "dead zone around")],
    )  # fmt: skip
    def test_fault_of_a_valve_is_said_and_taken_into_account(self, kind, number, said):
        log, size, plant = faulty(kind, number, 5)
        model = identify(log)
        assert said in model.warnings[0]
        assert headline(model)[0] == f"**Nothing is recommended.** {' '.join(model.warnings)}"
        assert recommendations(model, recommended(model)) == {
            "recommended": [], "warnings": model.warnings,
        }  # fmt: skip
        assert model.plant.gain == pytest.approx(sum(plant.b), rel=0.15)
        if "backlash" in kind:
            width = float(re.search(r"backlash of (\S+)", model.warnings[0]).group(1))
            assert width == pytest.approx(size, rel=0.2)

    # The last dead zone is among more commands than are tried at first.
    @pytest.mark.parametrize(
        ("kind", "number", "seed"),
        [("second order", 1, 5), ("two inputs", 1, 5), ("loop", 1, 5), ("dead zone", 0, 9006)],
    )
    def test_sound_valves_are_not_faulty(self, kind, number, seed):
        log, _, plant = faulty(kind, number, seed)
        model = identify(log)
        assert model.warnings == []
        gain = model.estimates["gain"]
        assert gain.low <= sum(plant.b) <= gain.high

    def test_bump_is_judged_where_it_moves(self):
        generator = np.random.default_rng(720)
        flow = np.zeros(900)
        flow[100:300] = 5.0
        model = found_in(
            flow, signal.lfilter([0.0] * 11 + [-0.05], [1.0, -0.95], flow), generator
        )
        assert model.held_out.model > 0.9
        assert model.warnings == []

    def test_fast_response_with_a_slow_tail_is_found_where_the_base_line_wanders(self):
        generator = np.random.default_rng(0)
        flow = np.repeat(generator.uniform(0.2, 0.9, 250), 8)
        fast = signal.lfilter([0.0, -4.0, -4.0], [1.0], flow)
        tail = signal.lfilter([0.0, -0.22], [1.0, -0.98], flow)
        walk = np.cumsum(generator.normal(0.0, 0.03, 2000))
        noise = signal.lfilter([1.0], [1.0, -0.9], generator.normal(0.0, 0.15, 2000))
        model = identify(Log(flow, fast + tail + walk + noise, 1.0))
        assert model.plant.gain == pytest.approx(-19.0, rel=0.1)
        assert model.held_out.model > 0.9


def test_least_squares_over_a_gap_finds_what_made_the_errors():
    xi, regressor = np.random.default_rng(707).normal(size=(2, 8000))
    # Two stretches, each from rest.
    noise = signal.lfilter([1.0, -0.6], [1.0], xi.reshape(2, 4000), axis=1)
    known = np.arange(8001) != 4000
    table = np.column_stack([3.0 * regressor + noise.ravel(), regressor])
    linear, c, errors = Rows(known, known).solve(table, Orders(0, 1, 1))
    assert linear[0] == pytest.approx(3.0, abs=0.05)
    assert c[0] == pytest.approx(-0.6, abs=0.05)
    np.testing.assert_allclose(errors, xi, atol=0.3)


def closed_loop(_log):
    run = rollout(
        make_plants(1, 1200, noise_variance=0.1, setpoint=0.0), PIController(1.0, 0.05), 1200, 7
    )
    return run.command[:, 0], run.output[:, 0]


# What is said, and how a log of the paper's plant becomes one that cannot tell.
CANNOT_TELL = {
    "the flow is constant": lambda log: (np.full(1200, 3.0), log.temperature),
    "the temperature is constant": lambda log: (log.flow, np.full(1200, 385.0)),
    "too short: 10 rows": lambda log: (log.flow[:10], log.temperature[:10]),
    "150 rows leave .* --longest-delay": lambda log: (log.flow[:150], log.temperature[:150]),
    "direction is unusual: .* swapped": lambda log: (log.temperature, log.flow),
    "the loop is closed": closed_loop,
    # It stays inside the dead zone.
    "does not answer the flow": lambda log: (
        0.4 * log.flow, answer(0.4 * log.flow, np.random.default_rng(703))
    ),
    "does not show where": lambda log: (
        log.flow, np.cumsum(0.05 * log.flow) + np.random.default_rng(704).normal(size=1200)
    ),
}  # fmt: skip


@pytest.mark.parametrize("said", CANNOT_TELL)
def test_log_that_cannot_tell_is_refused(said):
    flow, temperature = CANNOT_TELL[said](recorded(noise=0.3))
    with pytest.raises(CannotTellError, match=said):
        identify(Log(flow, temperature, 8.0))


class TestPlant:
    def test_plant_is_the_environment_s(self, good):
        # The environment does what the simulation of the log shows, once it has forgotten that
        # it was at rest before k = 0.
        log, model = good
        arguments = json.loads(json.dumps(plant_arguments(model)))
        assert arguments["delay"] == 18
        calm = {**arguments, "noise_variance": 0.0}
        env = gymnasium.make("MiddlePoint-v0", max_episode_steps=1200, **calm)
        env.reset()
        low, high = arguments["u_min"], arguments["u_max"]
        outputs = [0.0]
        for u in log.flow[:-1]:
            action = 2.0 * (u - low) / (high - low) - 1.0
            outputs.append(env.step(np.array([action], np.float32))[-1]["output"])
        simulated = model.simulated - model.operating_temperature
        np.testing.assert_allclose(simulated[600:], outputs[600:], atol=1e-3)

    def test_ranges_hold_the_plant_and_can_be_drawn_from(self, good):
        _, model = good
        plant, ranges = plant_arguments(model), plant_ranges(model)
        env = gymnasium.make("MiddlePoint-v0", **json.loads(json.dumps(ranges)))
        env.reset(seed=0)
        factors = {"gain_factor": 1.0, "time_constant_factor": 1.0}
        names = [name for name, value in ranges.items()
                 if isinstance(value, list) and name not in "abc"]  # fmt: skip
        assert {"dead_zone", "noise_variance", *factors} <= set(names)
        for name in names:
            low, high = ranges[name]
            assert low <= {**plant, **factors}[name] <= high
        # The ends of the time constant, as the environment counts it: 1 / (1 - pole) samples.
        middle, *ends = 1.0 / -np.expm1(-8.0 / np.array(model.estimates["time_constant"]))
        np.testing.assert_allclose(ranges["time_constant_factor"], ends / middle, rtol=1e-6)

    def test_plant_that_the_environment_does_not_have_is_refused_with_advice(self, good):
        _, model = good
        huge = replace(model, noise={**model.noise, "noise_variance": 1e12})
        with pytest.raises(CannotTellError, match=r"noise_variance .* --temperature-unit"):
            plant_ranges(huge)

    def test_set_point_is_within_reach(self):
        model = identify(recorded(b=[b / 10.0 for b in PAPER.b], noise=1e-3))
        arguments = plant_arguments(model)
        reach = 0.068 * min(-model.u_min, model.u_max)
        assert 0.6 * reach < arguments["setpoint_amplitude"] < reach


def table(samples=400):
    log = recorded(samples)
    times = 8.0 * np.arange(samples)
    return pd.DataFrame({"time": times, "flow": log.flow, "temperature": log.temperature})


def csv(log=None, **options):
    return (table() if log is None else log).to_csv(index=False, **options)


def dated(form):
    # Over the end of a month; a month that was taken for the day would go backwards.
    dates = pd.date_range("2026-01-31T23:50:00", periods=400, freq="8s")
    return csv(table().assign(time=dates.strftime(form)))


def in_minutes():
    log = table().assign(time=table()["time"] / 60.0)
    return csv(log.rename(columns={"time": "Time (min)", "flow": "Flow [kg/s]"}))


def with_line(line):
    """Return a log whose line 4 is this one."""
    good = [f"{8 * k},1.0,1.0" for k in range(50)]
    return "\n".join(["time,flow,temperature", *good[:2], line, *good[3:]])


# Text and options of the same log.
WAYS = {
    "commas": (csv(), {}),
    "semicolons": (csv(sep=";"), {}),
    "tabs": (csv(sep="\t"), {}),
    "semicolons, decimal commas": (csv(sep=";", decimal=","), {}),
    "tabs, decimal commas": (csv(sep="\t", decimal=","), {}),
    "quoted decimal commas": (
        csv(table().map(lambda value: f"{value!r}".replace(".", ",")), quoting=2), {},
    ),
    "commas at the ends": (csv(lineterminator=",\n").replace(",\n", "\n", 1), {}),
    "ISO dates": (dated("%Y-%m-%dT%H:%M:%S"), {}),
    "dates with points": (dated("%d.%m.%Y %H:%M:%S"), {}),
    "minutes": (in_minutes(), {"time": "Time (min)", "flow": "Flow [kg/s]"}),
    "headings named without their units": (in_minutes(), {"time": "Time", "flow": "Flow"}),
    "days": (csv(table().assign(time=46053.5 + table()["time"] / 86400)), {"time_unit": "D"}),
    "no times": (csv(table().drop(columns="time")), {"sampling_interval": 8.0}),
}  # fmt: skip
# Text and options of what is no log, by what is said.
FAULTS = {
    "is empty": ("", {}),
    "is not a table: No columns": ("\n", {}),
    "too short: it has no rows": ("time,flow,temperature\n", {}),
    "too short: it has 1 row": ("time,flow,temperature\n0,1,1\n", {}),
    "longer than the heading": (csv(lineterminator=",0\n").replace(",0", "", 1), {}),
    "Expected 3 fields in line 4, saw 5. With decimal": (with_line("16,1,0,1,5"), {}),
    "line 4: flow must be a number, got 'broken'": (with_line("16,broken,1.0"), {}),
    "line 4: temperature must be a number, got 'inf'": (with_line("16,1.0,inf"), {}),
    "line 4: temperature must be a number, got '4e.300'": (with_line("16,1.0,4e300"), {}),
    "line 4: temperature must be a number, got '1.2.3'": (with_line("16,1.0,1.2.3"), {}),
    "line 4: temperature must be a number, got 'broken'": (
        with_line("16,1.0,broken").replace(",", ";").replace(".", ","), {},
    ),
    "line 4: time must be a number or a date .*, got 'soon'": (with_line("soon,1.0,1.0"), {}),
    "line 4: time must be a number or a date .*, got 'nan'": (with_line(",1.0,1.0"), {}),
    "line 4: the time must increase, .* from 8 s by -4 s": (with_line("4,1.0,1.0"), {}),
    "line 4: the time must increase, .* from 8 s by 0 s": (with_line("8,1.0,1.0"), {}),
    "line 4: .* unequal, 11.5 s here where most are 8": (with_line("19.5,1.0,1.0"), {}),
    "s apart: .* say --time-unit D": (
        csv(table().assign(time=46053.5 + table()["time"] / 86400)), {},
    ),
    "unit of the times must be .* got 'furlongs'": (csv(), {"time_unit": "furlongs"}),
    "no column 'flow'; it has 'time', 'flown', 'temp": (csv().replace("flow", "flown"), {}),
    "no column 'time'.* or give --sampling-interval": (csv().replace("time", "t"), {}),
    "one thing only": (csv(), {"temperature": "flow"}),
    "sampling_interval must be above 0": (csv(), {"sampling_interval": 0.0}),
    "rows have no flow: too many": (csv(table().assign(flow=np.r_[[np.nan] * 250, :150])), {}),
}  # fmt: skip


@pytest.fixture
def written(tmp_path):
    """Return a function that writes a log as a file, and its path."""

    def write(text):
        (tmp_path / "log.csv").write_text(text, encoding="utf-8")
        return tmp_path / "log.csv"

    return write


class TestLog:
    @pytest.mark.parametrize("way", WAYS)
    def test_ways_to_write_the_same_log(self, written, way):
        text, columns = WAYS[way]
        log, expected = read_log(written(text), Columns(**columns)), recorded(400)
        np.testing.assert_allclose(log.flow, expected.flow, rtol=1e-9)
        np.testing.assert_allclose(log.temperature, expected.temperature, 1e-9, 1e-9)
        assert log.sampling_interval == 8.0
        assert "400 rows" in log.notes[0]
        assert not any("missing" in note for note in log.notes)

    def test_units_are_those_of_the_log(self, written, tmp_path, good):
        path = written(csv().replace("flow", "flow [%]"))
        log = read_log(path, Columns(flow="flow [%]", temperature_unit="K"))
        assert (log.flow_unit, log.temperature_unit) == ("%", "K")
        model = replace(good[1], log=replace(good[1].log, flow_unit="%", temperature_unit="K"))
        text = str([section.text for section in report(model, recommended(model), tmp_path)])
        assert "t/h" not in text
        assert "°C" not in text
        assert "% per K" in text

    @pytest.mark.parametrize("gap", [0.0, 777.7])
    def test_clocks_may_jitter_by_a_quarter_of_a_sample(self, written, gap):
        jitter = np.random.default_rng(718).uniform(-2.0, 2.0, 400)
        late = table().assign(time=table()["time"] + jitter + gap * (np.arange(400) > 200))
        log = read_log(written(csv(late)))
        rows = round(gap / 8.0)
        assert log.sampling_interval == pytest.approx(8.0, rel=0.01)
        assert len(log.flow) == 400 + rows
        np.testing.assert_array_equal(log.temperature[:200], table()["temperature"][:200])

    def test_missing_rows_and_numbers_are_gaps(self, written):
        gappy = table().drop(index=[100, 101, 102])
        gappy.loc[50, "temperature"] = np.nan
        log = read_log(written(csv(gappy)))
        assert len(log.flow) == 400
        assert np.isnan(log.temperature[[50, 100, 101, 102]]).all()
        assert any("3 rows are missing" in note for note in log.notes)
        assert any("4 temperatures" in note for note in log.notes)
        # The flow was held on both sides, and so in between.
        expected = recorded(400).flow
        held = expected[99] == expected[103]
        assert np.isfinite(log.flow[[100, 101, 102]]).all() == held

    def test_of_a_long_log_the_last_rows_are_used(self, written):
        log = read_log(written(csv()), rows=57)
        np.testing.assert_allclose(log.flow, recorded(400).flow[-57:], rtol=1e-9)
        assert any("400 rows, the last 57" in note for note in log.notes)

    def test_corrupted_file_is_read_or_refused(self, written):
        generator, path = np.random.default_rng(0), written("")
        for _ in range(30):
            data = bytearray(csv().encode())
            for at in generator.integers(len(data), size=int(generator.integers(1, 30))):
                junk = generator.bytes(int(generator.integers(1, 20)))
                data[at : at + int(generator.integers(0, 40))] = junk
            path.write_bytes(data)
            with contextlib.suppress(ValueError):  # refused
                assert len(read_log(path).flow) > 0

    @pytest.mark.parametrize("complaint", FAULTS)
    def test_what_cannot_be_read_is_named(self, written, complaint):
        text, columns = FAULTS[complaint]
        with pytest.raises(ValueError, match=complaint):
            read_log(written(text), Columns(**columns))


class TestCommand:
    def test_everything_is_written(self, written, tmp_path, capsys):
        out = tmp_path / "out"
        path = written(csv(table(1200)))
        assert main([str(path), "--out", str(out), "--longest-delay", "30"]) == 0
        plant = json.loads((out / "plant.json").read_text())
        gymnasium.make("MiddlePoint-v0", **plant).reset(seed=0)
        gymnasium.make("MiddlePoint-v0", **json.loads((out / "ranges.json").read_text()))
        text = (out / "report.md").read_text()
        for word in ("gain margin", "least possible", "autocorrelations", "the loops cycle"):
            assert word in text
        assert (out / "report.html").read_text().count("data:image/png") == 3
        assert re.search(r"\| gain +\| \S+ +\| \[\S+, \S+\]", text)
        listed = json.loads((out / "controllers.json").read_text())
        pi = listed["recommended"][0]
        assert f"Kp = {pi['kp']:.4g} t/h per °C and Ti = {pi['ti']:.3g} s, direct" in text
        assert "time constant" in capsys.readouterr().out


class TestStudy:
    def test_log_of_a_known_plant(self):
        plant = {"delay": 12, "dead_zone": 3.0, "noise_variance": 0.02}
        found = study.task(plant, 1200, seed=705)
        truth, value, low, high = (found[f"delay_{part}"] for part in study.PARTS)
        assert truth == 12
        assert abs(value - 12) <= 1
        assert low <= value <= high
        assert found["gain_true"] == pytest.approx(-0.6825, rel=1e-4)
        assert found["time_constant_true"] == pytest.approx(160.9, rel=1e-3)
        assert found["seconds"] < 10.0

    def test_tables_count_by_hand(self):
        names = ("delay", "dead_zone", "gain", "time_constant")
        columns = [f"{name}_{part}" for name in names for part in study.PARTS]
        columns += study.EXPLAINED
        right = "10 11 10 12  3 3.5 2 4  -1 -1.05 -1.2 -0.9  100 110 90 130  0.9 0.7"
        wrong = "10 12 11 13  1 8 7 9  -1 -1.2 -1.3 -1.1  100 130 110 150  0.8 0.5"
        right, wrong = (np.array(each.split(), float) for each in (right, wrong))
        found = pd.DataFrame([right, wrong, [np.nan] * len(columns)], columns=columns)
        found = found.assign(kind="steps", refused=["", "", "no"], warnings=["", "why", np.nan])
        shares = [each.split(" [")[0] for each in study.table(found)["steps"]]
        # Of the dead zones, one is too small to count. One log is refused.
        assert shares == [*["33 %"] * 3, *["50 %"] * 4, "100 %", "85 %", "60 %", "1", "1"]
        tried = [
            {"kind": "backlash", "fault": bad, "harmful": bad, "refused": why, "peaks": peaks}
            for bad, why, peaks in [
                (True, "why", []),
                (True, "", [1.5, 2.5]),
                (False, "", [1.9]),
            ]
        ]
        counted = ["3", "2", "1", "1", "0", "3", "1", "2.50"]
        assert study.table_of_loops(tried).to_numpy().tolist() == [
            ["backlash", *counted], ["all of these", *counted],
        ]  # fmt: skip

    @pytest.mark.parametrize("kind", ["first order", "second order"])
    def test_sound_plant_is_its_linear_part_with_noise(self, kind):
        log, size, plant = faulty(kind, 0, 719)
        left = log.temperature - 200.0 - plant.response(log.flow - 50.0)
        assert size == 0.0
        assert np.std(left) < 0.5 * np.std(log.temperature)

    @pytest.mark.parametrize("kind", study.KINDS)
    def test_plants_and_logs_are_made_as_they_say(self, kind):
        plants = study.synthetic_plants(20, 706, 600, kind)
        assert not any("gain_drift" in plant for plant in plants)
        assert all(("a" in plant) == (kind == "second order") for plant in plants)
        noise = [plant["noise_variance"] for plant in plants]
        assert 0.02 <= min(noise) < 0.1
        assert 0.4 < max(noise) <= 0.5
        log = study.synthetic_log(plants[2], 600, 709, kind)
        still = np.mean(np.diff(log.flow) == 0.0)
        assert still > 0.9 if kind in ("steps", "drift", "second order") else still < 0.5
