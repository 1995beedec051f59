"""Control the plant by model predictive control (MPC), with an exact model of the plant.

The controller knows all arguments of the environment, such as the variance of the noise and the
amplitude of the load, and the dynamics of the plant. The controller knows neither the values of
noise and load nor future set points. The mean error of model predictive control shows how close
to the lower bounds of `benchmarks.bounds` an error can be.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agents.hedge import RandomSetpoint
from benchmarks.loop.linear import LOAD_STEPS, LOAD_WALK, LinearModel
from benchmarks.loop.runs import drawn_numbers
from mptc_gym import Parameters
from mptc_gym.plant.actuator import applied_flow, float32_action
from mptc_gym.plant.dynamics import DRIFT_INTERVAL
from mptc_gym.plant.signals import LOAD_INTERVAL, SetPointLevels

Array = NDArray[np.float64]

HORIZON = 5  # number of flows in a plan, one for each sample
MOST_SWEEPS = 100  # largest number of sweeps of coordinate descent per sample
# Coordinate descent stops if a sweep changes no flow by this share of the range of the flow.
TOLERANCE = 5e-6
# Numbers in place of 0, divided by the largest set point or its square: added to the variance
# of the noise, and the least standard deviation of a forecast error.
SMALL_VARIANCE = 1e-9 / 5.0**2
SMALL_DEVIATION = 1e-9 / 5.0
SMALLEST_CURVATURE = np.finfo(np.float64).tiny  # degC^2 per (t/h)^2; a divisor in place of 0
WARM_UP = 200  # number of samples after which the Kalman filter's covariance hardly changes


@dataclass(frozen=True)
class _Model:
    """The plants of n runs at one sample, and the effect of planned flows on the outputs.

    Attributes
    ----------
    plants : LinearModel
        Plants of all runs.
    response : Array
        Matrix of each run, from planned flows to changes of outputs, degC per t/h, shape (n,
        HORIZON, HORIZON). The matrix of a run times the planned flows from sample k on is the
        effect of the planned flows on the outputs y(k + d + 1) to y(k + d + HORIZON), where d
        is the plant's delay in samples.
    hessian : Array
        Transpose of `response` times `response` for each run, (degC per t/h)^2, shape (HORIZON,
        HORIZON, n). The axis of the runs is last, because NumPy operations on all runs are
        faster in this order.
    curvature : Array
        Second derivative of the cost of a plan by each planned flow, shape (HORIZON, n). If a
        planned flow affects none of the HORIZON outputs, its curvature is `SMALLEST_CURVATURE`,
        to avoid a division by 0.
    """

    plants: LinearModel
    response: Array
    hessian: Array
    curvature: Array

    @classmethod
    def of(cls, plants: LinearModel) -> "_Model":
        """Return the model of the plants of n runs at one sample."""
        impulse_response = plants.impulse_response(HORIZON)
        response = np.zeros((len(impulse_response), HORIZON, HORIZON))
        for j in range(HORIZON):  # Flow j affects the outputs from output j on.
            response[:, j:, j] = impulse_response[:, : HORIZON - j]
        products = response.transpose(0, 2, 1) @ response
        hessian = np.ascontiguousarray(products.transpose(1, 2, 0))
        diagonal = np.diagonal(hessian).T
        curvature = np.ascontiguousarray(np.maximum(diagonal, SMALLEST_CURVATURE))
        return cls(plants, response, hessian, curvature)

    def cost(self, plan: Array, slopes: Array) -> Array:
        """Return the cost of a plan in each of n runs, degC^2, shape (n,).

        The cost is half the sum of squared differences between the target outputs and the
        outputs with the plan, minus a number that does not depend on the plan.

        Parameters
        ----------
        plan
            The planned flows, t/h, shape (HORIZON, n).
        slopes
            Negative derivative of the cost by each planned flow, at a plan of zeros, degC^2 per
            t/h, shape (HORIZON, n).
        """
        quadratic = np.einsum("in,ijn,jn->n", plan, self.hessian, plan) / 2.0
        return np.asarray(quadratic - (slopes * plan).sum(axis=0))


class PredictiveController:
    """Plan, at each sample, the flows that bring forecast outputs to target outputs.

    The controller knows the polynomials A, B and C and the delay d of each run's plant,
    equation (28) of the paper, and how A and B drift, even if the environment draws the plants
    at random. A Kalman filter estimates the output, the white noise xi and the load from the
    transmitter's readings. Since the load jumps and is not normally distributed, the Kalman
    filter is the best linear filter, but not the best of all filters.

    The mean absolute error is least if the median of the output is at the set point. So the
    controller forecasts medians of the outputs, and assumes that the load does not change. The
    planned flows lie within the limits of the actuator, and minimise the sum of squared
    differences between forecast outputs and target outputs. The sum of squared differences
    between forecast and target outputs has HORIZON terms, beginning with the first output that
    the planned flows can affect. If the first planned flow lies inside the dead zone, the
    controller replaces the flow by 0 or by the flow at the edge of the dead zone, whichever
    gives the smaller sum of squared differences.

    If set points are not random, the target outputs are equal to the present set point. If set
    points are random, `agents.hedge` computes the target outputs from the probability that the
    set point changes within the plant's delay, given the time since the latest change.

    Parameters
    ----------
    parameters : Parameters
        All arguments of the environment.
    num_envs : int
        Number of runs in the batch.
    seed : int
        Seed of the first run. The controller of run i knows the plant that the environment
        draws with the seed `seed + i`.
    """

    def __init__(self, parameters: Parameters, num_envs: int, seed: int = 0) -> None:
        self._parameters = parameters
        self._num_envs = num_envs
        # Parameter values of the plant of each run: arrays of shape (runs,).
        self._numbers = drawn_numbers(parameters, num_envs, seed)
        self._delay = self._numbers.delay.astype(np.intp)
        self._longest_delay = int(self._delay.max())
        # At every multiple of LOAD_INTERVAL samples, the piecewise constant part of the load
        # jumps with the probability p to a random level with the mean 0, so a level of x degC
        # becomes (1 - p) x in the mean. A random change with the variance `jump_variance` keeps
        # the variance of the level constant.
        jump_probability = np.minimum(LOAD_INTERVAL / self._numbers.disturbance_interval, 1.0)
        self._no_jump_probability = 1.0 - jump_probability
        # Variance of a uniform distribution from -amplitude to amplitude, degC^2.
        level_variance = np.square(self._numbers.disturbance_amplitude) / 3.0
        jump_variance = level_variance * (1.0 - np.square(self._no_jump_probability))
        walk_variance = LOAD_INTERVAL * self._numbers.disturbance_walk_variance
        scale = parameters.largest_setpoint or parameters.temperature_span  # degC
        noise_variance = self._numbers.noise_variance + SMALL_VARIANCE * scale**2
        # The variances of v(k) in `LinearModel.state_space_with_load`, degC^2, shape (runs, 3).
        self._variances = np.stack([noise_variance, jump_variance, walk_variance], axis=1)
        # Flow i of a plan affects the output y(k + 1 + delay + i) at the earliest. This output
        # is in column delay + i of the result of `_predict`, since column 0 is y(k + 1). Shape
        # (runs, HORIZON).
        self._reached_columns = self._delay[:, np.newaxis] + np.arange(HORIZON, dtype=np.intp)
        # Coefficient i of B multiplies the flow u_a(k + ahead - d - 1 - i) in the equation of
        # y(k + ahead). In `_flows`, whose column j is u_a(k - j), this flow is in column d + 1
        # + i - ahead. Column 0, which is always 0, stands for all flows from sample k on. Shape
        # (runs, outputs, coefficients of B).
        ahead = np.arange(self._longest_delay + HORIZON + 1)[:, np.newaxis]
        samples_back = self._delay[:, np.newaxis, np.newaxis] + 1 + np.arange(len(parameters.b))
        self._flow_columns = np.maximum(samples_back - ahead, 0)
        self._models: dict[int, _Model] = {}  # by the first sample at which the model holds
        outputs_in_state = self._model(0).plants.outputs_in_state
        # The state also has past values of xi, and the two parts of the load.
        self._state_size = outputs_in_state + len(parameters.c) - 1 + 2
        self._random: RandomSetpoint | None = None
        levels = SetPointLevels(parameters)
        if levels.random and levels.amplitude > 0.0:
            self._random = RandomSetpoint(levels.shortest, levels.longest, levels.amplitude)
            deviation = self._forecast_deviation()
            self._deviation = np.maximum(deviation, SMALL_DEVIATION * scale)
        self.reset()

    def reset(self) -> None:
        """Prepare for a new episode, which begins at rest: forget all readings and flows."""
        runs = self._num_envs
        self._k = 0
        # The state of the plants, which `LinearModel.state_space_with_load` describes.
        self._state = np.zeros((runs, self._state_size))
        self._covariance = np.zeros((runs, self._state_size, self._state_size))
        # Column j is the flow u_a(k - j), t/h. Column 0 is always 0, since `_predict` assumes
        # that the flows from the present sample k on are 0.
        self._flows = np.zeros((runs, 1 + self._longest_delay + len(self._parameters.b)))
        self._plan = np.zeros((HORIZON, runs))
        self._setpoint = np.full(runs, np.nan)  # the latest set point, degC
        self._age = np.zeros(runs, np.intp)  # number of samples since the set point changed

    def act(self, observation: Array) -> NDArray[np.float32]:
        """Return the actions of one sample, from -1 to 1, shape (runs, 1).

        `observation` has the observations of the environment, shape (runs, elements): the
        latest set points, degC, newest first, and then the latest errors, degC, newest first.
        """
        observation = np.asarray(observation, dtype=np.float64)
        setpoint = observation[:, 0]
        if self._k > 0:  # The state at k = 0 is known: the plant is at rest.
            # The newest error follows the set points. Set point minus error is the reading.
            error = observation[:, self._parameters.setpoint_window]
            self._filter(setpoint - error)
        model = self._model(self._k)
        free_outputs = np.take_along_axis(self._predict(), self._reached_columns, axis=1)
        differences = self._targets(setpoint) - free_outputs
        slopes = np.ascontiguousarray(np.einsum("ni,nij->nj", differences, model.response).T)
        # The search starts at the plan of the previous sample, shifted by a sample, with the
        # last flow repeated.
        start = np.vstack([self._plan[1:], self._plan[-1:]])
        plan = self._optimise(model, slopes, start)
        self._plan, command = self._avoid_dead_zone(model, slopes, plan)
        # The next call is for sample k + 1, from which each flow is a sample farther back.
        self._flows[:, 2:] = self._flows[:, 1:-1].copy()
        self._flows[:, 1] = self._plan[0]
        self._k += 1
        numbers = self._numbers
        action = float32_action(command, numbers.u_min, numbers.u_max, numbers.dead_zone)
        return action[:, np.newaxis]

    def _targets(self, setpoint: Array) -> Array:
        """Return the target outputs, degC, shape (runs, HORIZON), and store the set points.

        Column i of the result has the target of the output y(k + 1 + d + i), where k is the
        present sample and d the delay of the run's plant in samples. `setpoint` has the present
        set points, degC, shape (runs,). `_targets` must be called once per sample, as the
        method counts the samples since the latest change of the set point.
        """
        if self._random is None:
            return np.broadcast_to(setpoint[:, np.newaxis], (len(setpoint), HORIZON))
        self._age = np.where(setpoint == self._setpoint, self._age + 1, 0)
        self._setpoint = setpoint
        ages = self._age[:, np.newaxis].astype(np.float64)
        # Column i of the forecasts is i + 1 samples ahead.
        held = self._random.probability_held(ages, self._reached_columns + 1.0)
        deviation = self._deviation[:, np.newaxis]
        targets = self._random.targets(setpoint[:, np.newaxis], held, deviation)
        return np.asarray(targets, np.float64)

    def _forecast_deviation(self) -> Array:
        """Return the standard deviation of the forecast error of each run, degC, shape (runs,).

        The forecast is the expected value of the output y(k + d + 1) at sample k, where d is
        the plant's delay in samples. The standard deviation is that of a Kalman filter after
        `WARM_UP` samples, computed without drift of the plant.
        """
        plants = self._model(0).plants
        P = np.zeros((self._num_envs, self._state_size, self._state_size))
        # F and Q depend on k, as the load changes only at every LOAD_INTERVAL-th sample.
        for k in range(1, WARM_UP):
            _, P = self._gain_and_covariance(P, *self._transition(k, plants))
        variance = np.zeros(self._num_envs)
        # Element 0 of the state is the output. After `delay` + 1 steps, P belongs to the output
        # y(k + delay + 1), and is the one of the runs with this delay.
        for delay in range(self._longest_delay + 1):
            F, Q = self._transition(WARM_UP + delay, plants)
            P = F @ P @ F.transpose(0, 2, 1) + Q
            variance = np.where(delay == self._delay, P[:, 0, 0], variance)
        return np.sqrt(variance)

    def _filter(self, reading: Array) -> None:
        """Advance the state and the covariance of the Kalman filter from sample k - 1 to k.

        `reading` has the transmitter's readings at sample k, degC, shape (runs,).
        """
        plants = self._model(self._k).plants
        F, Q = self._transition(self._k, plants)
        state = np.einsum("nij,nj->ni", F, self._state)
        # The past flows that the coefficients of B multiply in the equation of y(k).
        # They are at 0 samples ahead, in the first row of each run.
        flows = np.take_along_axis(self._flows, self._flow_columns[:, 0], axis=1)
        state[:, 0] += (flows * plants.beta).sum(axis=1)  # the output y(k)
        gain, self._covariance = self._gain_and_covariance(self._covariance, F, Q)
        self._state = state + gain * (reading - state[:, 0])[:, np.newaxis]

    def _gain_and_covariance(self, before: Array, F: Array, Q: Array) -> tuple[Array, Array]:
        """Return the Kalman filter's gain at a sample, and its covariance after the reading.

        `before` is the covariance after the reading of the previous sample, and `_transition`
        describes F and Q. All matrices have the shape (runs, size, size), where size is the
        length of the state. The gain, of shape (runs, size), multiplies the difference between
        a reading and the forecast of the reading. Element 0 of the state is the output, of
        which the transmitter gives a reading.
        """
        P = F @ before @ F.transpose(0, 2, 1) + Q
        variance = P[:, 0, 0] + self._numbers.measurement_noise_variance
        gain: Array = P[:, :, 0] / variance[:, np.newaxis]
        return gain, P - gain[:, :, np.newaxis] * P[:, np.newaxis, 0]

    def _transition(self, k: int, plants: LinearModel) -> tuple[Array, Array]:
        """Return the matrices F and Q of the Kalman filter for the step to sample k.

        F has the state transition matrices and Q the covariances of the process noise, both of
        shape (runs, size, size), where size is the length of the state. `plants` has the plants
        of all runs at sample k.
        """
        no_jump_probability = self._no_jump_probability
        variances = self._variances
        if k % LOAD_INTERVAL:
            # The load does not change at this sample. Only the noise xi in v(k) has a variance.
            no_jump_probability = np.ones_like(no_jump_probability)
            variances = variances * [1.0, 0.0, 0.0]
        F, E = plants.state_space_with_load(no_jump_probability)
        return F, np.einsum("nv,niv,njv->nij", variances, E, E)

    def _predict(self) -> Array:
        """Return forecast outputs if all flows from the present sample k on are 0, degC.

        The forecasts assume that the load does not change. Column i of the result has the
        forecast output y(k + 1 + i) of each run. The number of columns is HORIZON plus the
        longest delay of a run in samples.
        """
        runs = np.arange(self._num_envs)[:, np.newaxis, np.newaxis]
        # The past flow that each coefficient of B multiplies in the equation of each forecast
        # output, or 0; shape (runs, outputs, coefficients of B). The forecasts begin with 1
        # sample ahead.
        flows = self._flows[runs, self._flow_columns[:, 1:]]
        models = [self._model(self._k + 1 + i).plants for i in range(flows.shape[1])]
        flows *= np.stack([plants.beta for plants in models], axis=1)
        effects = flows.sum(axis=2)
        c = self._parameters.c
        order = models[0].outputs_in_state  # the same for all models
        noise = self._state[:, order:LOAD_STEPS]  # xi(k), xi(k-1), ...
        load = self._state[:, LOAD_STEPS] + self._state[:, LOAD_WALK]
        outputs = [self._state[:, i] for i in reversed(range(order))]  # the newest last
        for ahead, plants in enumerate(models, start=1):  # Forecast y(k + ahead).
            output = effects[:, ahead - 1] + plants.load_factor * load
            for i in range(plants.alpha.shape[-1]):
                output += plants.alpha[:, i] * outputs[-1 - i]
            for i in range(ahead, len(c)):  # The noise xi after k is expected to be 0.
                output += c[i] * noise[:, i - ahead]
            outputs.append(output)
        return np.stack(outputs[order:], axis=1)

    def _model(self, k: int) -> _Model:
        """Return the model of all runs' plants in the step from sample k - 1 to sample k.

        The method keeps each model for later calls, since plants change only every
        `DRIFT_INTERVAL` samples.
        """
        first = 0
        if self._parameters.drifts:
            first = k // DRIFT_INTERVAL * DRIFT_INTERVAL
        if first not in self._models:
            plants = LinearModel(self._parameters, self._numbers, first)
            self._models[first] = _Model.of(plants)
        return self._models[first]

    def _avoid_dead_zone(
        self, model: _Model, slopes: Array, plan: Array
    ) -> tuple[Array, Array]:
        """Return a plan whose first flow the actuator can apply, and the command for this flow.

        A first flow inside the dead zone is replaced by 0 or by the flow at the edge of the
        dead zone, whichever gives the plan with the lower cost after the later flows have been
        planned again with this first flow. A plan has the planned flows of all runs, t/h, shape
        (HORIZON, runs). The returned command is in t/h and has the shape (runs,). `slopes` has
        the negative derivative of the cost by each planned flow, at a plan of zeros, as in
        `_Model.cost`.
        """
        numbers = self._numbers
        flow = plan[0]
        is_inside = np.abs(flow) < numbers.dead_zone
        if not is_inside.any():
            return plan, flow
        edge = np.copysign(numbers.dead_zone, flow)
        # The actuator clips the command `edge` to its limits, one of which may lie inside the
        # dead zone.
        edge_flow = applied_flow(edge, numbers.dead_zone, numbers.u_min, numbers.u_max)
        idle_plan = self._optimise(model, slopes, plan, first_flow=0.0)
        edge_plan = self._optimise(model, slopes, plan, first_flow=edge_flow)
        is_idle = model.cost(idle_plan, slopes) <= model.cost(edge_plan, slopes)
        new_plan = np.where(is_idle, idle_plan, edge_plan)
        new_command = np.where(is_idle, 0.0, edge)
        return np.where(is_inside, new_plan, plan), np.where(is_inside, new_command, flow)

    def _optimise(
        self,
        model: _Model,
        slopes: Array,
        start: Array,
        first_flow: Array | float | None = None,
    ) -> Array:
        """Return the flows with the least cost within the limits, t/h, shape (HORIZON, runs).

        Coordinate descent finds the flows, beginning with the flows `start`, t/h, shape
        (HORIZON, runs), where runs is the number of runs of the batch. If `first_flow` is not
        None, the first planned flow is `first_flow`, t/h, a number or an array with a number
        for each run of the batch. `slopes` has the negative derivative of the cost by each
        planned flow, at a plan of zeros, as in `_Model.cost`.
        """
        limits = self._parameters.lowest  # The limits are the same in all runs.
        smallest_change = TOLERANCE * (limits.u_max - limits.u_min)
        plan = start.copy()
        free_flows = range(HORIZON)
        if first_flow is not None:
            plan[0] = first_flow
            free_flows = range(1, HORIZON)
        for _ in range(MOST_SWEEPS):
            before = plan.copy()
            for i in free_flows:
                # At the best flow, the derivative of the cost by this flow is 0.
                derivative = np.add.reduce(plan * model.hessian[i]) - slopes[i]
                best = plan[i] - derivative / model.curvature[i]
                np.maximum(best, self._numbers.u_min, out=best)
                np.minimum(best, self._numbers.u_max, out=plan[i])
            if np.abs(plan - before).max() < smallest_change:
                break
        return plan
