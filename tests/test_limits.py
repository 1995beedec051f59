"""The limits against independent computations, and the controller that nearly reaches them."""

import itertools
from dataclasses import asdict

import numpy as np
import pytest
from scipy import integrate, stats

from agents import PIController
from benchmarks import limits
from benchmarks.controllers.mpc import PredictiveController
from benchmarks.limits import least_error, minimum_variance, scenario_limit
from benchmarks.metrics import mean_error
from benchmarks.rollout import make_plants, rollout
from benchmarks.scenarios import SCENARIOS, Scenario, plain
from mptc_gym import MiddlePointEnv, Parameters
from tests.conftest import run

CALM = Parameters()


def run_mpc(runs, samples, seed=0, **arguments):
    controller = PredictiveController(Parameters(**arguments), runs)
    return rollout(make_plants(runs, samples, **arguments), controller, samples, seed)


def sums(trajectory):
    error = trajectory.setpoint - trajectory.output
    return np.abs(error).sum(axis=0), np.square(error).sum(axis=0)


class TestSetPointChanges:
    def test_a_plant_of_first_order_by_hand(self):
        # y(k+1) = 0.5 y(k) + u(k), |u| <= 1, from 0 to 1.9: full input gives 1, 1.5, 1.75,
        # 1.875, 1.9375; so 1.9 is reached with the fifth. Errors 1.9, 0.9, 0.4, 0.15, 0.025.
        plant = Parameters(
            a=(1.0, -0.5), b=(1.0,), c=(1.0,), delay=0, dead_zone=0.0, u_min=-1.0, u_max=1.0
        )
        errors = [1.9, 0.9, 0.4, 0.15, 0.025]
        least = least_error(plant, 0.0, 1.9, 12, from_rest=True)
        assert least[0] == pytest.approx(sum(errors))
        assert least[1] == pytest.approx(sum(e * e for e in errors))

    @pytest.mark.parametrize(("before", "after"), [(0.0, 5.0), (5.0, -5.0), (-4.0, 6.0)])
    def test_no_input_of_many_does_better(self, before, after, rng):
        # Bang-bang inputs with one switch of level, the shape that optimal ones have, and
        # random ones, on the plant itself.
        samples = 120
        least = least_error(CALM, before, after, samples, from_rest=True)
        gain = sum(CALM.b) / sum(CALM.a)
        steady, end = before / gain, after / gain
        full = CALM.u_max if end > steady else CALM.u_min
        tried = []
        for switch, level in itertools.product(range(10, 60), (1.0, 0.9, 0.5, 0.0)):
            u = np.full(samples, end)
            u[:switch] = full
            u[switch] = level * full + (1 - level) * end
            tried.append(u)
        tried += list(rng.uniform(-10, 10, (50, samples)))
        y = self.responses(np.array(tried) - steady, before)
        absolute, square = np.abs(after - y).sum(axis=1), np.square(after - y).sum(axis=1)
        assert absolute.min() >= least[0] * (1 - 1e-9)
        assert square.min() >= least[1] * (1 - 1e-9)
        assert absolute.min() == pytest.approx(least[0], rel=0.01)
        assert square.min() == pytest.approx(least[1], rel=0.01)

    @staticmethod
    def responses(u, before):
        y = np.zeros((len(u), u.shape[1]))
        for k in range(u.shape[1]):
            for i, a in enumerate(CALM.a[1:], 1):
                y[:, k] -= a * y[:, k - i] if k >= i else 0
            for i, b in enumerate(CALM.b, 1):
                lag = CALM.delay + i
                y[:, k] += b * u[:, k - lag] if k >= lag else 0
        return y + before

    def test_a_short_time_leaves_no_choice(self):
        assert least_error(CALM, 0.0, 5.0, 19, from_rest=True) == pytest.approx((95.0, 475.0))

    def test_from_beyond_the_reach_of_the_flow(self):
        with pytest.raises(ValueError, match=r"before .* got 8\.0"):
            least_error(CALM, 8.0, 5.0, 50, from_rest=False)

    def test_scenario_adds_its_changes_up(self):
        scenario = SCENARIOS["square"]
        first = least_error(scenario.parameters, 0.0, 5.0, 300, from_rest=True)
        others = least_error(scenario.parameters, 5.0, -5.0, 300, from_rest=False)
        limit = limits.scenario_limit(scenario)
        assert limit.mae == pytest.approx((first[0] + 3 * others[0]) / 1200)
        assert limit.mse == pytest.approx((first[1] + 3 * others[1]) / 1200)

    def test_only_the_first_change_is_from_rest(self):
        scenario = SCENARIOS["square-noise"]
        sums = [
            least_error(scenario.parameters, 0.0, 5.0, 300, from_rest=True),
            *[least_error(scenario.parameters, 5.0, -5.0, 300, from_rest=False)] * 3,
        ]
        limit = limits.scenario_limit(scenario)
        assert limit.mse == pytest.approx(sum(square for _, square in sums) / 1200, rel=1e-9)

    def test_other_scenarios_are_not_taken_for_known_ones(self):
        other = Scenario("square", "", 600, {"setpoint": 4.0})
        assert (
            limits.scenario_limit(other).mae < limits.scenario_limit(SCENARIOS["constant"]).mae
        )


class TestNoise:
    def test_minimum_variance_of_a_first_order_process(self):
        # C/A = 1 / (1 - p z^-1): variance R (1 + p^2 + ... + p^2d).
        plant = Parameters(a=(1.0, -0.8), b=(-1.0,), c=(1.0,), delay=3, noise_variance=2.0)
        expected = 2.0 * (1 - 0.8**8) / (1 - 0.8**2)
        assert minimum_variance(plant) == pytest.approx(expected)

    def test_it_grows_with_the_delay_up_to_no_control(self):
        noisy = {"noise_variance": 0.5}
        variances = [minimum_variance(Parameters(delay=d, **noisy)) for d in (0, 9, 18, 400)]
        assert variances[0] == 0.5
        assert variances == sorted(variances)
        plants = make_plants(300, 1500, setpoint=0.0, **noisy)
        idle = rollout(plants, PIController(0.0, 0.0), 1500, seed=0)
        assert variances[-1] == pytest.approx(idle.output[500:].var(), rel=0.03)

    def test_mean_of_the_folded_normal(self):
        for mean, deviation in [(0.0, 1.0), (1.3, 0.7), (-2.0, 1.5)]:
            value, slope = limits._folded_normal(np.array([mean]), np.array([deviation]))
            density = stats.norm(mean, deviation).pdf
            expected = integrate.quad(lambda x, f=density: abs(x) * f(x), -20, 20, points=[0])[
                0
            ]
            assert value[0] == pytest.approx(expected)
            around = [
                limits._folded_normal(np.array([mean + h]), np.array([deviation]))[0][0]
                for h in (-1e-5, 1e-5)
            ]
            assert slope[0] == pytest.approx((around[1] - around[0]) / 2e-5, rel=1e-5)

    def test_unknown_variance_begins_with_the_episode(self):
        plant = Parameters(noise_variance=0.5)
        variance = limits._unknown_variance(plant, 40, from_rest=True)
        assert variance[0] == 0.0  # y(0) = 0
        assert variance[1] == 0.5  # xi(1)
        assert variance[2] == pytest.approx(0.5 * (1 + (0.45181 - 0.35740) ** 2))
        assert variance[19:] == pytest.approx(minimum_variance(plant))
        later = limits._unknown_variance(plant, 40, from_rest=False)
        assert later == pytest.approx(np.full(40, minimum_variance(plant)))


class TestPredictiveController:
    def test_it_reaches_the_limit_without_noise(self):
        limit = limits.scenario_limit(SCENARIOS["constant"]).mae
        (absolute,), _ = sums(run_mpc(1, 600, setpoint=5.0))
        assert limit * (1 - 1e-6) <= absolute / 600 <= 1.05 * limit

    @pytest.mark.parametrize("name", ["square-noise", "constant-noise"])
    def test_it_comes_near_the_limit_with_noise_and_does_not_beat_it(self, name):
        scenario, runs = SCENARIOS[name], 200
        limit = limits.scenario_limit(scenario)
        absolute, square = sums(run_mpc(runs, scenario.samples, 77, **scenario.arguments))
        for total, least in ((absolute, limit.mae), (square, limit.mse)):
            mean = total.mean() / scenario.samples
            error = total.std() / scenario.samples / np.sqrt(runs)
            assert mean > least - 3 * error
            assert mean < 1.01 * least + 3 * error

    def test_it_foresees_the_plant_exactly(self):
        # Without a dead zone and far from the limits the output comes to the set point at the
        # first sample that a command can reach, and stays.
        runs = run_mpc(1, 60, dead_zone=0.0, u_min=-1e3, u_max=1e3, setpoint=5.0)
        assert np.all(runs.output[:19] == 0.0)
        assert runs.output[19:, 0] == pytest.approx(np.full(41, 5.0), abs=1e-3)

    def test_it_is_of_minimum_variance_where_nothing_limits_it(self):
        plant = {"a": (1.0, -0.9), "b": (-0.5,), "c": (1.0, 0.8, 0.15), "delay": 3}
        free = {"dead_zone": 0.0, "u_min": -1e3, "u_max": 1e3, "setpoint": 0.0}
        runs = run_mpc(100, 600, noise_variance=0.5, **plant, **free)
        least = minimum_variance(Parameters(noise_variance=0.5, **plant))
        assert runs.output[100:].var() == pytest.approx(least, rel=0.03)

    def test_it_holds_what_the_dead_zone_does_not_let_through(self):
        # 2 degC needs 2.9 t/h, inside the dead zone: it switches between 0 and the edge.
        runs = run_mpc(1, 600, setpoint=2.0)
        assert runs.output[300:].mean() == pytest.approx(2.0, abs=0.05)
        assert set(np.unique(runs.applied[300:].round(3))) <= {0.0, -5.0}

    @pytest.mark.parametrize(
        ("plant", "setpoint"),
        [
            ({"dead_zone": 7.0}, 2.0),  # no float32 action commands 7 t/h, nor 4.1
            ({"dead_zone": 4.1}, 1.0),
            ({"dead_zone": 7.0, "u_min": -6.0}, 2.0),  # -7 brings about -6, and -6 nothing
        ],
    )
    def test_the_plant_applies_what_it_believes_in(self, plant, setpoint):
        controller = PredictiveController(Parameters(**plant), 1)
        believed = []
        plants = make_plants(1, 600, setpoint=setpoint, **plant)
        newest = -20  # of its d + 2 inputs
        watch = lambda k: believed.append(controller._state[0, newest])  # noqa: E731
        runs = rollout(plants, controller, 600, seed=0, before=watch)
        np.testing.assert_allclose(believed[1:], runs.applied[:-1, 0], rtol=0, atol=1e-5)
        assert len(np.unique(runs.applied[300:].round(3))) == 2  # it switches ...
        assert runs.output[300:].mean() == pytest.approx(setpoint, abs=0.05)  # ... and holds

    def test_other_orders_of_plant(self):
        plant = {"a": (1.0, -0.9), "b": (-0.1, 0.0, -0.05), "c": (1.0,), "delay": 2}
        runs = run_mpc(2, 400, noise_variance=0.01, setpoint=9.0, **plant)
        assert np.abs(9.0 - runs.output[100:]).mean() < 0.2


def test_command(capsys):
    limits.main([])
    shown = capsys.readouterr().out
    for name in SCENARIOS:
        assert name in shown
    assert f"{limits.scenario_limit(SCENARIOS['square']).mae:.4f}" in shown


class TestOtherDynamics:
    def test_factors_are_worked_into_a_and_b(self, rng):
        given = Parameters(gain_factor=1.3, time_constant_factor=2.0, delay=9)
        worked_in = plain(given)
        assert worked_in.gain_factor == worked_in.time_constant_factor == 1.0
        actions = rng.uniform(-1, 1, 500)
        ours, theirs = (
            run(MiddlePointEnv(**asdict(parameters)), actions)["output"]
            for parameters in (given, worked_in)
        )
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12)
        assert np.ptp(ours) > 1.0

    def test_the_bound_of_a_stronger_plant_is_attained_too(self):
        arguments = {"setpoint": 5.0, "gain_factor": 1.3, "time_constant_factor": 0.8}
        scenario = Scenario("stronger", "", 600, arguments)
        plants = make_plants(1, 600, **arguments)
        controller = PredictiveController(Parameters(**arguments), 1)
        error = mean_error(rollout(plants, controller, 600, seed=0))[0]
        assert 1.0 <= error / scenario_limit(scenario).mae < 1.02

    @pytest.mark.parametrize(
        "more",
        [
            {"delay": [3, 4]},
            {"gain_drift": 2.0},
            {"disturbance_amplitude": 1.0},
            {"measurement_noise_variance": 0.1},
        ],
    )
    def test_there_is_no_limit_for_what_is_not_derived(self, more):
        with pytest.raises(ValueError, match="parameters must be of a plant without"):
            scenario_limit(Scenario("more", "", 600, more))
