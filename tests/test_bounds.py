"""The bounds against independent computations, and the controllers that come near them."""

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import linalg, optimize, signal

from agents.hedge import RandomSetpoint
from benchmarks.bounds import __main__ as command
from benchmarks.bounds.causal import SetPointLaw
from benchmarks.bounds.linear_program import plan, surprised_plan
from benchmarks.bounds.prediction import noise_variance
from benchmarks.bounds.reference import reference_error
from benchmarks.bounds.unknown import error_bounds, load_changes
from benchmarks.controllers.mpc import PredictiveController
from benchmarks.loop.linear import LinearModel
from benchmarks.loop.measures import mean_error
from benchmarks.loop.runs import make_plants, simulate
from benchmarks.loop.scenarios import SCENARIOS
from mptc_gym import Parameters
from mptc_gym.plant.actuator import action_from_command
from tests.verify_bounds import CONTROLLERS, beats, errors

CALM = Parameters()
SHARES = np.linspace(0.0, 1.0, 21)  # of the known level of the load, in a forecast


def run_mpc(runs, samples, seed=0, **arguments):
    controller = PredictiveController(Parameters(**arguments), runs)
    return simulate(make_plants(runs, samples, **arguments), controller, samples, seed)


def minimum_variance(parameters):
    """Return R times the sum of squares of the first d + 1 coefficients of C/A (Astrom)."""
    f = signal.lfilter(parameters.c, parameters.a, np.eye(1, parameters.delay + 1)[0])
    return parameters.noise_variance * f @ f


def plant_of(samples, **arguments):
    parameters = Parameters(**arguments)
    return LinearModel(parameters, parameters.lowest, np.arange(samples))


def best_plan(setpoint, /, **arguments):
    """Return the bounds of the errors and the flow of the plan with preview."""
    model = plant_of(len(setpoint), **arguments)
    return plan(model, error_bounds(model), np.asarray(setpoint, np.float64))


def least_error_sum(level, samples, **arguments):
    """Return the least sum of |e| after a set-point change from rest at 0 to `level`, degC."""
    model = plant_of(samples + 110, **arguments)
    setpoint = np.full(samples, level)
    return surprised_plan(model, error_bounds(model), setpoint).errors.sum()


def test_a_dead_zone_makes_0_a_flow_within_limits_that_exclude_it():
    lowest = [plant_of(9, u_min=2.0, dead_zone=zone).limits[0] for zone in (0.0, 0.5)]
    assert lowest == [2.0, 0.0]


# Plants that differ in everything: u_max nearer than u_min, no delay, and three slow poles.
ODD = [
    {"delay": 30, "u_min": -12.0, "u_max": 6.0, "dead_zone": 4.0},
    {"delay": 0, "a": (1.0, -0.9), "b": (0.2,), "dead_zone": 0.0, "u_min": -1.0, "u_max": 3.0},
    {"a": tuple(np.poly([0.97, 0.9, 0.6])), "b": (0.01, 0.004), "delay": 5, "u_min": -6.0},
    # A zero of B far outside the unit circle, and a fast A.
    {"a": tuple(np.poly([0.3, -0.2])), "b": (0.1, -0.9, 0.3), "delay": 2, "u_min": -5.0,
     "u_max": 7.0, "dead_zone": 0.0},
]  # fmt: skip
FIRST_ORDER = {
    "a": (1.0, -0.5), "b": (1.0,), "c": (1.0,), "delay": 0, "dead_zone": 0.0,
    "u_min": -1.0, "u_max": 1.0,
}  # fmt: skip


def test_a_plant_of_first_order_by_hand():
    # y(k+1) = 0.5 y(k) + u(k), |u| <= 1, from 0 to 1.9: full input gives 1, 1.5, 1.75,
    # 1.875, 1.9375; so 1.9 is reached with the fifth. Errors 1.9, 0.9, 0.4, 0.15, 0.025.
    by_hand = [1.9, 0.9, 0.4, 0.15, 0.025]
    assert least_error_sum(1.9, 12, **FIRST_ORDER) == pytest.approx(sum(by_hand))
    # A time as long as the delay leaves no choice.
    assert least_error_sum(5.0, 19) == pytest.approx(95.0)


class TestProgramme:
    @pytest.mark.parametrize("plant", ODD)
    def test_reweighted_least_squares_come_to_the_same(self, plant):
        # Another method on another model: least squares with limits, whose weights make them
        # the sum of sqrt(e^2 + s^2) with s falling, and the response of scipy's filter. Every
        # step is a small problem that is solved exactly, so that the result does not depend on
        # how a processor rounds. It comes from above, the linear program from below.
        n = 90
        setpoint = np.repeat([1.5, -1.0, 2.0], n // 3)
        parameters = Parameters(**plant)
        impulse = signal.lfilter(
            [*[0.0] * (parameters.delay + 1), *parameters.b], parameters.a, np.eye(1, n)[0]
        )
        G = linalg.toeplitz(impulse, np.zeros(n))
        effective = n - parameters.delay - 1  # later flows affect no output
        G = G[:, :effective]
        limits = parameters.u_min, parameters.u_max
        flow = np.zeros(effective)
        for s in np.repeat([1.0, 0.1, 0.03, 0.01, 0.003, 0.001], 6):
            error = setpoint - G @ flow
            weights = (error**2 + s**2) ** -0.25
            flow = optimize.lsq_linear(
                weights[:, np.newaxis] * G, weights * setpoint, limits, "bvls", max_iter=2000
            ).x
        error_sum = np.abs(setpoint - G @ flow)[1:].sum()
        least = best_plan(setpoint, **plant)[0][1:].sum()
        assert least * (1 - 1e-6) <= error_sum < 1.001 * least

    def test_a_controller_that_knows_the_future_attains_the_bound(self):
        # Without a dead zone, so that every flow can be applied; the plant drifts.
        setpoint = np.repeat([3.0, -4.0, 6.0], 100)
        arguments = {
            "dead_zone": 0.0, "u_min": -12.0, "u_max": 6.0, "delay": 7, "gain_drift": 0.6,
            "time_constant_drift": 1.5, "drift_samples": 300, "time_constant_factor": 0.8,
        }  # fmt: skip
        case = {"setpoint": setpoint.tolist(), **arguments}
        reference = reference_error(samples=300, kind="preview", **case)
        error, flow = best_plan([*setpoint, 6.0], **arguments)
        assert flow.min() == pytest.approx(-12.0)
        actions = iter(action_from_command(flow, -12.0, 6.0))
        knowing = SimpleNamespace(reset=dict, act=lambda _: np.full((1, 1), next(actions)))
        runs = simulate(make_plants(1, 301, **case), knowing, 300, seed=0)
        of_run = np.abs(setpoint - runs.output[:, 0])
        np.testing.assert_allclose(of_run, error[:-1], atol=1e-4)
        run_errors = mean_error(runs)
        assert run_errors[0] == pytest.approx(reference.value, rel=1e-4)
        assert not beats(run_errors * (1 + 1e-4), reference)
        assert beats(
            run_errors, replace(reference, value=1.03 * reference.value, episodes=(0, 0))
        )


class TestUnknown:
    def test_the_variance_begins_with_the_episode(self):
        variance = noise_variance(plant_of(60, noise_variance=0.5))
        assert variance[0] == 0.0  # y(0) = 0
        assert variance[1] == pytest.approx(0.5)  # xi(1)
        assert variance[2] == pytest.approx(0.5 * (1 + (0.45181 - 0.35740) ** 2))
        assert variance[19:] == pytest.approx(minimum_variance(Parameters(noise_variance=0.5)))

    def test_with_a_noisy_transmitter_it_is_that_of_the_steady_kalman_predictor(self):
        # y(k+1) = 0.9 y(k) + xi(k+1), read with noise: p solves the Riccati equation.
        plant = {"a": (1.0, -0.9), "b": (1.0,), "c": (1.0,), "delay": 4}
        noise = {"noise_variance": 0.4, "measurement_noise_variance": 0.7}
        ahead = linalg.solve_discrete_are(np.array([[0.9]]), np.eye(1), 0.4 * np.eye(1),
                                          0.7 * np.eye(1))[0, 0]  # fmt: skip
        # Of y(2), from the first reading: that of y(1).
        ahead = np.array([ahead, 0.81 * 0.4 * 0.7 / (0.4 + 0.7) + 0.4])
        for _ in range(4):
            ahead = 0.81 * ahead + 0.4
        variance = noise_variance(plant_of(200, **plant, **noise))
        assert variance[[-1, 6]] == pytest.approx(ahead, rel=1e-6)
        assert variance[-1] > noise_variance(plant_of(200, **plant, noise_variance=0.4))[-1]

    @pytest.mark.parametrize(("k", "R"), [(603, 0.0), (609, 0.3)])  # two changes, and one
    def test_the_load_against_many_draws(self, k, R, rng):
        load = {
            "disturbance_amplitude": 3.0, "disturbance_interval": 25.0,
            "disturbance_walk_variance": 0.02,
        }  # fmt: skip
        bound = error_bounds(plant_of(620, noise_variance=R, **load))
        draws, jump = 40_000, 0.4
        known = rng.uniform(-3.0, 3.0, draws)  # the level at k - d - 1
        level, walk, xi = known, np.zeros(draws), np.zeros((3, draws))
        jumps = {i: rng.random(draws) < jump for i in range(k - 18, k + 1) if i % 10 == 0}
        last_jump = np.max([np.where(jumped, i, 0) for i, jumped in jumps.items()], axis=0)
        # What happens to y(k), beyond what it does if the load stays; and what is left of that
        # if the times of the jumps are known, too, and all levels but the last.
        unforeseen, level_alone = np.zeros((2, 3, draws))
        for i in range(k - 18, k + 1):
            if i in jumps:
                level = np.where(jumps[i], rng.uniform(-3.0, 3.0, draws), level)
                walk = walk + rng.uniform(-1, 1, draws) * np.sqrt(3 * 10 * 0.02)
            xi = np.vstack([np.sqrt(R) * rng.standard_normal(draws), xi[:2]])
            noise = np.dot(CALM.c, xi) + sum(CALM.a) * walk
            after = (last_jump > 0) & (i >= last_jump)
            for y, of_load in (
                (unforeseen, level - known),
                (level_alone, np.where(after, level, 0.0)),
            ):
                y[1:] = y[:-1].copy()
                y[0] = noise + sum(CALM.a) * of_load
                y[0] -= CALM.a[1] * y[1] + CALM.a[2] * y[2]
        for m in (0.0, 0.4, 1.5):  # whatever the level: no better than the bound
            least = bound.mean_error(np.full(620, m))[k]
            errors_if_m = np.abs(m - unforeseen[0])
            assert least < errors_if_m.mean() + 3 * errors_if_m.std() / np.sqrt(draws)
        # With an error of 0 in the mean, the best forecast is a share of the known level.
        least = bound.mean_error(np.zeros(620))[k]
        forecasts = [np.abs(share * known + unforeseen[0]).mean() for share in SHARES]
        assert 0.97 < least / min(forecasts) < 1.005
        # A controller that knew when the load jumps could come below the bound.
        assert np.abs(level_alone[0]).mean() < 0.97 * least

    def test_the_load_by_hand_where_it_jumps_at_every_change(self):
        # The two new levels U and V within d + 1 samples add a U + b V, whose mean absolute
        # value for b <= a is a / 2 + b^2 / (6 a). The level before them can be made up for.
        model = plant_of(620, disturbance_amplitude=3.0, disturbance_interval=10.0)
        latest, earlier = load_changes(model).effects[600:].T
        a, b = np.sort([3.0 * latest, 3.0 * np.maximum(earlier - latest, 0.0)], axis=0)[::-1]
        intercepts = error_bounds(model).intercepts[600:, 0]
        assert np.all(intercepts <= a / 2 + b**2 / (6 * a) + 1e-12)
        assert np.all(intercepts >= 0.98 * (a / 2 + b**2 / (6 * a)))


class TestCausal:
    def test_the_penalty_is_0_in_the_mean_over_the_future(self, rng):
        # A level is held for 3 to 7 samples. The futures of the past have the next two holds in
        # all lengths and the next level on a grid, and each comes with its mirror image.
        samples, plant = 16, {"a": (1.0, -0.6), "b": (-0.24,), "c": (1.0,), "delay": 0}
        case = {"setpoint": "random", "setpoint_period": 15, "noise_variance": 0.1, **plant}
        model = plant_of(samples, **case)
        law = SetPointLaw(model, error_bounds(model))
        past = [-4.0] * 3 + [2.0] * 3
        present = len(past) - 1
        age = present - past.index(past[-1])
        penalties = []
        for first, second in itertools.product(range(max(3, age + 1), 8), range(3, 8)):
            for level in np.arange(0.5, 8.0) / 8.0 * 5.0:
                later = np.repeat(rng.uniform(-5, 5, samples), rng.integers(3, 8, samples))
                future = np.array([*[level] * second, *later])
                for sign in (-1, 1):
                    still = past[-1:] * (first - age - 1)
                    setpoint = np.array([*past, *still, *sign * future])[:samples]
                    penalties.append(law.penalty(setpoint)[present])
        assert abs(np.mean(penalties)) < 0.005 * np.std(penalties)
        assert np.std(penalties) > 0.05

    def test_no_controller_beats_it_and_it_is_tighter_than_that_with_preview(self):
        arguments = {"setpoint": "random", "dead_zone": 0.0}
        kinds = {
            kind: reference_error(samples=400, kind=kind, episodes=4, **arguments)
            for kind in ("preview", "causal")
        }
        run_errors = errors(CONTROLLERS["mpc"], 4, 400, **arguments)
        assert not beats(run_errors, kinds["causal"])
        assert kinds["preview"].value < 0.5 * kinds["causal"].value
        assert run_errors.mean() < 1.3 * kinds["causal"].value


class TestReferenceError:
    def test_score(self):
        reference = reference_error(samples=600, setpoint=5.0)
        idle = reference.idle.value
        scores = reference.score([idle, reference.value, (idle + reference.value) / 2])
        assert scores == pytest.approx([0.0, 1.0, 0.5])
        hopeless = reference_error(samples=10, setpoint=5.0)
        with pytest.raises(ValueError, match="a score needs an idle-valve error above"):
            hopeless.score(1.0)

    def test_bad_arguments(self):
        for message, arguments in {
            "kind must be one of": {"kind": "best"},
            "not random, got 'causal' for the set point 'square'": {"kind": "causal"},
            "delay must be": {"delay": -1},
            "must be held until": {"kind": "surprise", "setpoint_period": 100},
        }.items():
            with pytest.raises(ValueError, match=message):
                reference_error(**{"samples": 600, **arguments})


def test_it_gains_where_levels_are_short(monkeypatch):
    short = {"setpoint": "random", "setpoint_period": 120}
    hedged = mean_error(run_mpc(5, 300, **short)).mean()
    monkeypatch.setattr(RandomSetpoint, "probability_held", lambda *_: np.ones(1))
    assert hedged < 0.95 * mean_error(run_mpc(5, 300, **short)).mean()


class TestPredictiveController:
    @pytest.mark.parametrize(
        "load",
        [
            SCENARIOS["load"].arguments,  # jumps
            # A walk that the flow can make up for within its limits.
            {"setpoint": 0.0, "dead_zone": 0.0, "disturbance_walk_variance": 0.005},
        ],
    )
    def test_it_expects_the_load_to_stay(self, load):
        reference = reference_error(samples=600, **load).value
        mpc_error = errors(CONTROLLERS["mpc"], 20, 600, **load).mean()
        assert reference < mpc_error < 1.1 * reference

    @pytest.mark.parametrize("plant", [{}, {"gain_factor": 1.3, "time_constant_factor": 0.8}])
    def test_it_reaches_the_limit_without_noise(self, plant):
        case = {"samples": 600, "setpoint": 5.0, **plant}
        limit = reference_error(kind="surprise", **case).value
        (error,) = mean_error(run_mpc(1, **case))
        assert limit * (1 - 1e-4) <= error <= 1.02 * limit

    @pytest.mark.parametrize("of_transmitter", [0.0, 4.0])
    def test_it_is_of_minimum_variance_where_nothing_limits_it(self, of_transmitter):
        plant = {
            "a": (1.0, -0.9), "b": (-0.5,), "c": (1.0, 0.8, 0.15), "delay": 3,
            "noise_variance": 0.5, "measurement_noise_variance": of_transmitter,
        }  # fmt: skip
        free = {"dead_zone": 0.0, "u_min": -1e3, "u_max": 1e3, "setpoint": 0.0}
        runs = run_mpc(100, 600, **plant, **free)
        least = noise_variance(plant_of(600, **plant))[-1]
        assert runs.output[100:].var() == pytest.approx(least, rel=0.03)

    def test_zeros_in_b_are_a_delay(self):
        b, case = Parameters().b, {"samples": 400, "setpoint": 5.0}
        delayed = mean_error(run_mpc(1, **case))
        zeros_in_front = mean_error(run_mpc(1, b=(0.0, 0.0, *b), delay=16, **case))
        np.testing.assert_allclose(zeros_in_front, delayed, rtol=0.01)
        assert mean_error(run_mpc(1, b=(0.0,), **case)) == 5.0  # No flow has an effect.

    @pytest.mark.parametrize(
        ("plant", "setpoint"),
        [
            ({"dead_zone": 7.0}, 2.0),  # no float32 action commands 7 t/h; 2 degC needs 2.9
            ({"dead_zone": 7.0, "u_min": -6.0}, 2.0),  # -7 brings about -6, and -6 nothing
        ],
    )
    def test_it_knows_which_flows_the_plant_applies(self, plant, setpoint):
        runs = run_mpc(1, 300, setpoint=setpoint, **plant)
        assert len(np.unique(runs.applied[150:].round(3))) == 2  # it switches ...
        assert runs.output[150:].mean() == pytest.approx(setpoint, abs=0.05)  # ... and holds


def test_the_command_prints_a_row_for_each_case(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")  # so that no table is broken
    for name, case in (("SCENARIOS", "constant"), ("PRESET_SCENARIOS", "dead-zone-7")):
        monkeypatch.setattr(command, name, {case: vars(command)[name][case]})
    assert command.main(["--mpc", "1", "--jobs", "1"]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if line[:1] > " "]
    assert ["constant", "5.0000", "0.2307", "0.2307", "0.2307"] in rows
