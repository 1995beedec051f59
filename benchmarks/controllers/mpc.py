"""Implement model predictive control (MPC) with an exact model of the plant and the actuator.

The controller knows all parameters of the plant, the noise and the load, but no future noise,
loads and set points. The errors of the controller show how close a controller can come to the
error bounds of `benchmarks.bounds`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agents.actuator import applied_flow, float32_action
from agents.hedge import RandomSetpoint
from benchmarks.loop.linear import LinearModel
from benchmarks.loop.rollout import drawn_numbers
from mptc_gym import Parameters
from mptc_gym.plant.dynamics import DRIFT_INTERVAL
from mptc_gym.plant.signals import LOAD_INTERVAL, Levels

Array = NDArray[np.float64]

HORIZON = 5  # flows in a plan, one a sample; the first flow is applied, then all are replanned
SWEEPS = 100  # limit of the sweeps of coordinate descent, to bound the time of a sample
TOLERANCE = 1e-4  # t/h; coordinate descent stops if a sweep changes no flow by this much
TINY = 1e-9  # added to variances, degC^2, so that none of them is 0
SMALLEST = np.finfo(np.float64).tiny  # least divisor, in place of 0
WARM_UP = 200  # samples until the covariance of the Kalman filter hardly changes


@dataclass(frozen=True)
class _Model:
    """The plants of n runs at one sample, and the effect of planned flows on the outputs.

    Attributes
    ----------
    plants : LinearModel
        The plants of all runs.
    response : Array
        The matrix G, shape (n, HORIZON, HORIZON), degC per t/h. G times the planned flows is
        the change of the first HORIZON outputs that these flows can affect.
    hessian : Array
        The product of the transpose of G and G, shape (n, HORIZON, HORIZON).
    rows : Array
        `hessian` with the axis of the runs last, shape (HORIZON, HORIZON, n): operations on all
        runs are faster in this order.
    """

    plants: LinearModel
    response: Array
    hessian: Array
    rows: Array

    @classmethod
    def of(cls, plants: LinearModel) -> "_Model":
        """Return the model of `plants`, the plants of all runs at one sample."""
        impulse_response = plants.impulse_response(HORIZON)
        response = np.zeros((len(impulse_response), HORIZON, HORIZON))
        for j in range(HORIZON):
            response[:, j:, j] = impulse_response[:, : HORIZON - j]
        hessian = response.transpose(0, 2, 1) @ response
        rows = np.ascontiguousarray(hessian.transpose(1, 2, 0))
        return cls(plants, response, hessian, rows)

    def cost(self, plan: Array, slopes: Array) -> Array:
        """Return the cost of a plan in each of n runs, degC^2, shape (n,).

        The cost is half the sum of squared differences between the targets and the outputs with
        the plan, without the part of the sum that does not depend on the plan.

        Parameters
        ----------
        plan
            The planned flows, t/h, shape (HORIZON, n).
        slopes
            The transpose of G times the differences between the targets and the outputs that
            are expected without the planned flows, shape (HORIZON, n).
        """
        quadratic = np.einsum("in,nij,jn->n", plan, self.hessian, plan) / 2.0
        return np.asarray(quadratic - (slopes * plan).sum(axis=0))


class PredictiveController:
    """Plan, at each sample, the flows that bring the expected output to the set point.

    The controller knows the polynomials A, B and C and the delay d of the plant, equation (28)
    of the paper, and how A and B drift, even if the plant is random and differs from run to
    run. A Kalman filter estimates the output, the white noise xi and the load from the
    transmitter's readings. The load jumps, so the load is not normally distributed; the Kalman
    filter is then still the best linear filter.

    The score depends on the mean of |e|, the absolute error. So the expected outputs are
    medians, and the load is expected to stay as it is. The planned flows minimise the sum of
    squared differences between the expected outputs and the target outputs, for flows within
    the limits of the actuator. The sum is over the first HORIZON outputs that the planned flows
    can affect. A first planned flow inside the dead zone is replaced by 0 or by the flow at the
    edge of the dead zone, whichever gives the plan with the smaller sum.

    The target outputs are equal to the present set point, as if the set point never changed. If
    the environment draws set points at random, the time since the latest set-point change shows
    how likely the set point is to change within the delay, and `agents.hedge` computes the
    target outputs.

    Parameters
    ----------
    parameters : Parameters
        All arguments of the environment.
    num_envs : int
        Number of runs in the batch.
    seed : int
        Seed of the first run: the controller knows the plant numbers that the environment draws
        for run i with the seed `seed + i`.
    """

    def __init__(self, parameters: Parameters, num_envs: int, seed: int = 0) -> None:
        self._parameters = parameters
        self._num_envs = num_envs
        self._numbers = drawn_numbers(parameters, num_envs, seed)
        self._delay = self._numbers.delay.astype(np.intp)
        # At each sample at which the load may step, it steps with the probability p. A load of
        # x degC then becomes (1 - p) x in the mean; the variance of the load stays the same.
        interval = self._numbers.disturbance_interval
        self._load_stays = 1.0 - np.minimum(LOAD_INTERVAL / interval, 1.0)
        load_variance = (
            np.square(self._numbers.disturbance_amplitude) / 3.0
        )  # of a uniform level
        steps_variance = load_variance * (1.0 - np.square(self._load_stays))
        walk_variance = LOAD_INTERVAL * self._numbers.disturbance_walk_variance
        noise_variance = self._numbers.noise_variance + TINY
        self._variances = np.stack([noise_variance, steps_variance, walk_variance], axis=1)
        # The state: y(k), y(k-1), ...; xi(k), xi(k-1), ...; the steps of the load and its walk.
        self._n_y = max(len(parameters.a) - 1, 1)
        self._size = self._n_y + len(parameters.c) - 1 + 2
        # For each output from y(k) on and each coefficient of B: the index, in `_inputs`, of
        # the flow that the coefficient multiplies; 0 for flows from u(k) on, not yet decided.
        ahead = np.arange(int(self._delay.max()) + HORIZON + 1)[:, np.newaxis]
        lag = np.arange(len(parameters.b)) + 1
        self._shows = (self._delay[:, np.newaxis, np.newaxis] + lag - ahead).clip(0)
        self._reached = self._delay[:, np.newaxis] + np.arange(HORIZON, dtype=np.intp)
        self._models: dict[int, _Model] = {}  # by the sample from which the coefficients hold
        self._random: RandomSetpoint | None = None
        levels = Levels(parameters)
        if levels.random:
            self._random = RandomSetpoint(levels.shortest, levels.longest, levels.amplitude)
            self._deviation = self._forecast_deviation()
        self.reset()

    def reset(self) -> None:
        """Prepare for a new episode: forget all readings and flows, as the plant is at rest."""
        n = self._num_envs
        self._k = 0
        self._state = np.zeros((n, self._size))
        self._covariance = np.zeros((n, self._size, self._size))
        # u(k-1), u(k-2), ..., after a 0 that stands for future inputs.
        longest_memory = int(self._delay.max()) + len(self._parameters.b)
        self._inputs = np.zeros((n, 1 + longest_memory))
        self._plan = np.zeros((HORIZON, n))
        self._setpoint = np.full(n, np.nan)  # the latest set point, degC
        self._age = np.zeros(n, np.intp)  # samples since the set point changed

    def act(self, observation: Array) -> NDArray[np.float32]:
        """Return the actions of a sample, from -1 to 1, shape (runs, 1).

        `observation` has the observations of the environment, shape (runs, elements): the
        latest set points, degC, newest first, and then the latest errors, degC.
        """
        observation = np.asarray(observation, dtype=np.float64)
        setpoint = observation[:, 0]
        if self._k > 0:
            error = observation[:, self._parameters.setpoint_window]
            self._filter(setpoint - error)
        model = self._model(self._k)
        free_outputs = np.take_along_axis(self._predict(), self._reached, axis=1)
        missing = self._aims(setpoint) - free_outputs
        slopes = np.ascontiguousarray(np.einsum("ni,nij->nj", missing, model.response).T)
        start = np.vstack([self._plan[1:], self._plan[-1:]])
        plan = self._optimise(model, slopes, start)
        command = plan[0].copy()
        is_inside = np.abs(command) < self._numbers.dead_zone
        if is_inside.any():
            edge = np.copysign(self._numbers.dead_zone, command)
            flow = applied_flow(
                edge, self._numbers.dead_zone, self._numbers.u_min, self._numbers.u_max
            )
            resting_plan = self._optimise(model, slopes, plan, first_flow=0.0)
            edge_plan = self._optimise(model, slopes, plan, first_flow=flow)
            rests = model.cost(resting_plan, slopes) <= model.cost(edge_plan, slopes)
            plan = np.where(is_inside, np.where(rests, resting_plan, edge_plan), plan)
            command = np.where(is_inside, np.where(rests, 0.0, edge), command)
        self._plan = plan
        self._inputs[:, 2:] = self._inputs[:, 1:-1].copy()
        self._inputs[:, 1] = plan[0]
        self._k += 1
        action = float32_action(
            command, self._numbers.u_min, self._numbers.u_max, self._numbers.dead_zone
        )
        return action[:, np.newaxis]

    def _aims(self, setpoint: Array) -> Array:
        """Return the target outputs, degC, shape (runs, HORIZON); called once a sample.

        Column i has the target of the output that the planned flow i is the first to affect.
        `setpoint` has the present set points, degC, shape (runs,).
        """
        if self._random is None:
            return np.broadcast_to(setpoint[:, np.newaxis], (len(setpoint), HORIZON))
        self._age = np.where(setpoint == self._setpoint, self._age + 1, 0)
        self._setpoint = setpoint
        ages = self._age[:, np.newaxis].astype(np.float64)
        held = self._random.probability_held(ages, self._reached + 1.0)
        deviation = np.maximum(self._deviation, TINY)[:, np.newaxis]
        return np.asarray(
            self._random.targets(setpoint[:, np.newaxis], held, deviation), np.float64
        )

    def _forecast_deviation(self) -> Array:
        """Return the standard deviation of the forecast error of each run, degC, shape (runs,).

        The forecast is of the first output that a new command affects. The Kalman filter is
        taken to have settled, and the plant is taken not to drift.
        """
        self.reset()
        plants = self._model(0).plants
        for k in range(1, WARM_UP):
            self._update_covariance(*self._transition(k, plants))
        P = self._covariance
        variance = np.zeros(self._num_envs)
        for ahead in range(int(self._delay.max()) + 1):
            F, Q = self._transition(WARM_UP + ahead, plants)
            P = F @ P @ F.transpose(0, 2, 1) + Q
            variance = np.where(ahead == self._delay, P[:, 0, 0], variance)
        return np.sqrt(variance)

    def _filter(self, output: Array) -> None:
        """Advance the Kalman filter from sample k - 1 to the present sample k.

        `output` has the transmitter's readings at sample k, degC, shape (runs,).
        """
        plants = self._model(self._k).plants
        F, Q = self._transition(self._k, plants)
        state = np.einsum("nij,nj->ni", F, self._state)
        flows = np.take_along_axis(self._inputs, self._shows[:, 0], axis=1)
        state[:, 0] += (flows * plants.beta).sum(axis=1)
        gain = self._update_covariance(F, Q)
        self._state = state + gain * (output - state[:, 0])[:, np.newaxis]

    def _update_covariance(self, F: Array, Q: Array) -> Array:
        """Advance the Kalman filter's covariance by a sample, and return the filter's gain.

        F is the state transition matrix, and Q is the covariance of the process noise, both of
        shape (runs, size, size), where size is the length of the state. The gain is the factor
        from the deviation of the reading to the correction of the state, shape (runs, size).
        """
        P = F @ self._covariance @ F.transpose(0, 2, 1) + Q
        variance = P[:, 0, 0] + self._numbers.measurement_noise_variance
        gain: Array = P[:, :, 0] / variance[:, np.newaxis]
        self._covariance = P - gain[:, :, np.newaxis] * P[:, np.newaxis, 0]
        return gain

    def _transition(self, k: int, plants: LinearModel) -> tuple[Array, Array]:
        """Return the matrices F and Q of the Kalman filter for the step from k - 1 to k.

        F is the state transition matrix, and Q is the covariance of the process noise, both of
        shape (runs, size, size), where size is the length of the state. `plants` has the
        plants of all runs at sample k.
        """
        load_changes = k % LOAD_INTERVAL == 0
        steps, walk = self._size - 2, self._size - 1  # the parts of the load in the state
        F = np.zeros((self._num_envs, self._size, self._size))
        sources = np.zeros((self._num_envs, self._size, 3))  # xi, the steps and the walk
        F[:, :steps, :steps], sources[:, :steps, 0] = plants.state_space()
        F[:, steps, steps] = self._load_stays if load_changes else 1.0
        F[:, walk, walk] = 1.0
        F[:, 0, steps] = plants.load * F[:, steps, steps]
        F[:, 0, walk] = plants.load
        sources[:, 0, 1:] = plants.load[:, np.newaxis]
        sources[:, steps, 1] = 1.0
        sources[:, walk, 2] = 1.0
        variances = self._variances * [1, load_changes, load_changes]
        return F, np.einsum("nk,nik,njk->nij", variances, sources, sources)

    def _predict(self) -> Array:
        """Return the outputs that are expected if all flows from the present sample k on are 0.

        Column i has the outputs y(k + 1 + i), degC, of all runs. The shape is
        (runs, longest delay + HORIZON).
        """
        c = self._parameters.c
        runs = np.arange(self._num_envs)[:, np.newaxis, np.newaxis]
        flows = self._inputs[runs, self._shows[:, 1:]]
        models = [self._model(self._k + 1 + ahead).plants for ahead in range(flows.shape[1])]
        flows *= np.stack([plants.beta for plants in models], axis=1)
        responses = flows.sum(axis=2)
        outputs = [self._state[:, i] for i in reversed(range(self._n_y))]  # the newest last
        xi = self._state[:, self._n_y : -2]
        load = self._state[:, -2] + self._state[:, -1]
        for ahead, plants in enumerate(models):
            output = responses[:, ahead] + plants.load * load
            for j in range(len(self._parameters.a) - 1):
                output = output + plants.alpha[:, j] * outputs[-1 - j]
            for j in range(ahead + 1, len(c)):
                output = output + c[j] * xi[:, j - ahead - 1]
            outputs.append(output)
        return np.stack(outputs[self._n_y :], axis=1)

    def _model(self, k: int) -> _Model:
        """Return the plants of all runs in the step from sample k - 1 to sample k, as a model.

        Models are stored, since the plants change only every `DRIFT_INTERVAL` samples.
        """
        first = 0
        if self._parameters.drifts:
            first = k // DRIFT_INTERVAL * DRIFT_INTERVAL
        if first not in self._models:
            plants = LinearModel(self._parameters, self._numbers, first)
            self._models[first] = _Model.of(plants)
        return self._models[first]

    def _optimise(
        self,
        model: _Model,
        slopes: Array,
        start: Array,
        first_flow: Array | float | None = None,
    ) -> Array:
        """Return the planned flows with the least cost, t/h, shape (HORIZON, runs).

        The flows lie within the limits of the actuator. The method is coordinate descent.

        Parameters
        ----------
        model
            The plants, for which `_Model.cost` is minimised.
        slopes
            The second argument of `_Model.cost`, shape (HORIZON, runs).
        start
            The planned flows with which the descent starts, t/h, shape (HORIZON, runs).
        first_flow
            A fixed value of the first planned flow, t/h, shape (runs,) or one number for all
            runs; None if the first flow is chosen like the other flows.
        """
        plan = start.copy()
        free = range(HORIZON)
        if first_flow is not None:
            plan[0] = first_flow
            free = range(1, HORIZON)
        for _ in range(SWEEPS):
            before = plan.copy()
            for i in free:
                # The derivative of the cost by this flow becomes 0 at the best flow.
                descent = slopes[i] - np.add.reduce(plan * model.rows[i])
                # If the flow affects no output within the horizon, both numbers are 0.
                best = plan[i] + descent / np.maximum(model.rows[i, i], SMALLEST)
                np.maximum(best, self._numbers.u_min, out=best)
                np.minimum(best, self._numbers.u_max, out=plan[i])
            if np.abs(plan - before).max() < TOLERANCE:
                break
        return plan
