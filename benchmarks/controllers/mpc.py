"""Implement a predictive controller that knows plant and actuator exactly, not the future.

It shows how close a controller can come to the bounds of `benchmarks.bounds`.
"""

import numpy as np
from numpy.typing import NDArray

from agents.actuator import applied_flow, float32_action
from benchmarks.loop.linear import LinearModel
from benchmarks.loop.rollout import drawn_numbers
from mptc_gym import Parameters
from mptc_gym.plant import DRIFT_INTERVAL
from mptc_gym.signals import LOAD_INTERVAL, Levels

Array = NDArray[np.float64]

HORIZON = 5  # planned commands; the first is applied, then all are planned again
SWEEPS, TOLERANCE = 100, 1e-4  # of coordinate descent: most sweeps, and t/h to stop at
TINY = 1e-9  # degC^2, added to the variance of xi so that the filter trusts the readings
BISECTIONS = 20  # of a hedged set point: to a millionth of the range of levels
WARM_UP = 200  # samples until the covariance of the filter hardly changes


def probability_held(
    age: NDArray[np.intp], ahead: NDArray[np.intp], shortest: int, longest: int
) -> Array:
    """Return the probability that a random level still holds `ahead` samples later.

    A level holds for a number of samples that is uniform from `shortest` to `longest`. It began
    `age` samples ago. All arguments broadcast together.
    """
    longer = np.clip((longest - age - ahead) / (longest - shortest + 1), 0.0, 1.0)
    until_now = np.clip((longest - age) / (longest - shortest + 1), TINY, 1.0)
    return np.asarray(longer / until_now)


def hedged_setpoints(setpoint: Array, held: Array, amplitude: float, deviation: Array) -> Array:
    """Return the outputs to aim at while the set point may change on the way, degC.

    A flow shows only after the delay. By then the set point is still `setpoint` with the
    probability `held`, otherwise it is a new level, uniform within +-`amplitude`, degC. Let the
    output be r + n, where n is normal with the standard deviation `deviation`, degC. The r that
    minimises E|y_d - r - n| is the median of y_d - n:

        held Phi((r - setpoint) / deviation) + (1 - held) G(r) = 1/2.

    G(r) is the mean of Phi((r - x) / deviation) over all levels x: with the integral of Phi,
    I(z) = z Phi(z) + phi(z),

        G(r) = deviation (I((r + amplitude) / deviation) - I((r - amplitude) / deviation))
               / (2 amplitude).

    The left side rises with r, so bisection finds it. All arguments broadcast together.
    """
    from scipy.special import ndtr  # here: slow to import

    deviation = np.maximum(deviation, TINY)  # without noise the normal law becomes a step
    shape = np.broadcast_shapes(*map(np.shape, (setpoint, held, deviation)))
    low, high = np.full(shape, -amplitude), np.full(shape, amplitude)
    for _ in range(BISECTIONS):
        r = (low + high) / 2.0
        below_level = ndtr((r - setpoint) / deviation)
        upper = _integral_of_phi((r + amplitude) / deviation)
        lower = _integral_of_phi((r - amplitude) / deviation)
        below_next = deviation * (upper - lower) / (2.0 * amplitude)
        too_low = held * below_level + (1.0 - held) * below_next < 0.5
        low = np.where(too_low, r, low)
        high = np.where(too_low, high, r)
    return np.asarray((low + high) / 2.0)


def _integral_of_phi(z: Array) -> Array:
    """Return the integral of the standard normal distribution function up to z."""
    from scipy.special import ndtr  # here: slow to import

    density = np.exp(-(z**2) / 2.0) / np.sqrt(2.0 * np.pi)
    return np.asarray(z * ndtr(z) + density)


class PredictiveController:
    """Plan, at each sample, the inputs that bring the expected output to the set point.

    The controller knows A, B, C and d of the plant (28), even where loop i draws them with seed
    `seed + i`, and the course of their drift. A Kalman filter estimates the output, xi and the
    load from the transmitter's readings; for the jumps of the load, which are not normal, it is
    the best linear filter. The score is the mean of |e|, so the expected outputs are medians:
    the load is expected to stay as it is. The plan minimises the sum of squared differences
    between these and the outputs to aim at, over the samples that its commands reach first, for
    inputs within the limits. A first input inside the dead zone is replaced by 0 or by the
    input at a command on the edge, whichever gives the better plan.

    The outputs to aim at are the set point, as if it held for ever. Random set points have a
    law, which tells from the age of a level how likely it is to change before a command shows:
    see `hedged_setpoints`.
    """

    def __init__(self, parameters: Parameters, num_envs: int, seed: int = 0) -> None:
        self._p = parameters
        self._num_envs = num_envs
        self._numbers = numbers = drawn_numbers(parameters, num_envs, seed)
        self._delay = numbers.delay.astype(np.intp)
        self._u_min, self._u_max = numbers.u_min, numbers.u_max
        self._dead_zone = numbers.dead_zone
        # Where the load may change, a level x becomes (1 - p) x in the mean, and its variance
        # stays the same.
        self._stays = 1.0 - np.minimum(LOAD_INTERVAL / numbers.disturbance_interval, 1.0)
        uniform = np.square(numbers.disturbance_amplitude) / 3.0
        steps = uniform * (1.0 - np.square(self._stays))
        walk = LOAD_INTERVAL * numbers.disturbance_walk_variance
        self._variances = np.stack([numbers.noise_variance + TINY, steps, walk], axis=1)
        self._drifts = parameters.drifts
        # The state: y(k), y(k-1), ...; xi(k), xi(k-1), ...; the steps of the load and its walk.
        self._n_y = max(len(parameters.a) - 1, 1)
        self._size = self._n_y + len(parameters.c) - 1 + 2
        # For each sample from k on and each b, the index of the input that shows; 0 for none.
        ahead = np.arange(int(self._delay.max()) + HORIZON + 1)[:, np.newaxis]
        lag = np.arange(len(parameters.b)) + 1
        self._shows = (self._delay[:, np.newaxis, np.newaxis] + lag - ahead).clip(0)
        self._reached = self._delay[:, np.newaxis] + np.arange(HORIZON, dtype=np.intp)
        self._models: dict[int, tuple[LinearModel, Array, Array]] = {}  # by age, samples
        self._levels = Levels(parameters)
        if self._levels.random:
            self._deviation = self._forecast_deviation()
        self.reset()

    def reset(self) -> None:
        """Forget the episode: the plant is at rest."""
        n = self._num_envs
        self._k = 0
        self._state = np.zeros((n, self._size))
        self._covariance = np.zeros((n, self._size, self._size))
        # u(k-1), u(k-2), ..., after a 0 that stands for future inputs.
        self._inputs = np.zeros((n, 1 + int(self._delay.max()) + len(self._p.b)))
        self._plan = np.zeros((HORIZON, n))
        self._setpoint = np.full(n, np.nan)  # the latest, degC
        self._age = np.zeros(n, np.intp)  # samples since it began

    def act(self, observation: Array) -> NDArray[np.float32]:
        """Return actions, shape (runs, 1), for observations, shape (runs, n_obs)."""
        seen = np.asarray(observation, dtype=np.float64)
        setpoint = seen[:, 0]
        if self._k:
            self._filter(setpoint - seen[:, self._p.setpoint_window])
        _, G, Q = self._model(self._k)
        free = np.take_along_axis(self._predict(), self._reached, axis=1)
        target = np.einsum("ni,nij->nj", self._aims(setpoint) - free, G)
        start = np.vstack([self._plan[1:], self._plan[-1:]])
        plan = self._optimise(Q, target, start)
        command = plan[0]
        inside = np.abs(command) < self._dead_zone
        if inside.any():
            edge = np.copysign(self._dead_zone, command)
            flow = applied_flow(edge, self._dead_zone, self._u_min, self._u_max)
            plans = [self._optimise(Q, target, plan, first) for first in (0.0, flow)]
            rests = np.less_equal(
                *(np.einsum("in,nij,jn->n", u, Q, u) / 2 - (target.T * u).sum(0) for u in plans)
            )
            plan = np.where(inside, np.where(rests, *plans), plan)
            command = np.where(inside, np.where(rests, 0.0, edge), command)
        self._plan = plan
        self._inputs[:, 2:] = self._inputs[:, 1:-1].copy()
        self._inputs[:, 1] = plan[0]
        self._k += 1
        action = float32_action(command, self._u_min, self._u_max, self._dead_zone)
        return action[:, np.newaxis]

    def _aims(self, setpoint: Array) -> Array:
        """Return the outputs to aim at when the planned commands show, (runs, HORIZON)."""
        if not self._levels.random:
            return np.broadcast_to(setpoint[:, np.newaxis], (len(setpoint), HORIZON))
        self._age = np.where(setpoint == self._setpoint, self._age + 1, 0)
        self._setpoint = setpoint
        held = probability_held(
            self._age[:, np.newaxis],
            self._reached + 1,
            self._levels.shortest,
            self._levels.longest,
        )
        return hedged_setpoints(
            setpoint[:, np.newaxis],
            held,
            self._levels.amplitude,
            self._deviation[:, np.newaxis],
        )

    def _forecast_deviation(self) -> Array:
        """Return the standard deviation of the first output that a new command reaches, degC.

        It is that of the best forecast from the readings of a plant that does not drift, once
        the filter has settled. The shape is (runs,).
        """
        self.reset()
        model, *_ = self._model(0)
        for k in range(1, WARM_UP):
            self._update_covariance(*self._transition(k, model))
        P = self._covariance
        variance = np.zeros(self._num_envs)
        for ahead in range(int(self._delay.max()) + 1):
            F, Q = self._transition(WARM_UP + ahead, model)
            P = F @ P @ F.transpose(0, 2, 1) + Q
            variance = np.where(ahead == self._delay, P[:, 0, 0], variance)
        return np.sqrt(variance)

    def _filter(self, output: Array) -> None:
        """Advance the state from k - 1 to k, and correct it with the reading y(k)."""
        model, *_ = self._model(self._k)
        F, Q = self._transition(self._k, model)
        x = np.einsum("nij,nj->ni", F, self._state)
        past = np.take_along_axis(self._inputs, self._shows[:, 0], axis=1)
        x[:, 0] += (past * model.beta).sum(axis=1)
        gain = self._update_covariance(F, Q)
        self._state = x + gain * (output - x[:, 0])[:, np.newaxis]

    def _update_covariance(self, F: Array, Q: Array) -> Array:
        """Advance the covariance by a sample, and return the gain of its reading."""
        P = F @ self._covariance @ F.transpose(0, 2, 1) + Q
        variance = P[:, 0, 0] + self._numbers.measurement_noise_variance
        gain: Array = P[:, :, 0] / variance[:, np.newaxis]
        self._covariance = P - gain[:, :, np.newaxis] * P[:, np.newaxis, 0]
        return gain

    def _transition(self, k: int, model: LinearModel) -> tuple[Array, Array]:
        """Return the state transition from k - 1 to k, and the process noise's covariance."""
        changes = k % LOAD_INTERVAL == 0
        F = np.zeros((self._num_envs, self._size, self._size))
        sources = np.zeros((self._num_envs, self._size, 3))  # xi, the steps and the walk
        F[:, :-2, :-2], sources[:, :-2, 0] = model.state_space()
        F[:, -2, -2], F[:, -1, -1] = self._stays if changes else 1.0, 1.0
        F[:, 0, -2:] = model.load[:, np.newaxis] * F[:, [-2, -1], [-2, -1]]
        sources[:, 0, 1:] = model.load[:, np.newaxis]
        sources[:, -2, 1] = sources[:, -1, 2] = 1.0
        variances = self._variances * [1, changes, changes]
        return F, np.einsum("nk,nik,njk->nij", variances, sources, sources)

    def _predict(self) -> Array:
        """Return the outputs expected from k + 1 on without further commands."""
        c, n_y = self._p.c, self._n_y
        every = np.arange(self._num_envs)[:, np.newaxis, np.newaxis]
        moved = self._inputs[every, self._shows[:, 1:]]
        ahead = range(self._k + 1, self._k + 1 + moved.shape[1])
        models = [self._model(k)[0] for k in ahead]
        moved *= np.stack([model.beta for model in models], axis=1)
        outputs = [self._state[:, i] for i in range(n_y - 1, -1, -1)]
        xi = self._state[:, n_y:-2]
        load = self._state[:, -2] + self._state[:, -1]
        for i, (model, flow) in enumerate(zip(models, moved.sum(axis=2).T, strict=True)):
            output = flow + model.load * load
            for j in range(len(self._p.a) - 1):
                output = output + model.alpha[:, j] * outputs[-1 - j]
            for j in range(i + 1, len(c)):
                output = output + c[j] * xi[:, j - i - 1]
            outputs.append(output)
        return np.stack(outputs[n_y:], axis=1)

    def _model(self, k: int) -> tuple[LinearModel, Array, Array]:
        """Return the plants for the step to sample k; G, from planned inputs to outputs; G' G.

        The sum of squared errors of a plan u is u G' G u - 2 (target G) u, but for a constant.
        """
        age = k // DRIFT_INTERVAL * DRIFT_INTERVAL if self._drifts else 0
        if age not in self._models:
            plants = LinearModel(self._p, self._numbers, age)
            response = plants.impulse_response(HORIZON)
            G = np.zeros((self._num_envs, HORIZON, HORIZON))
            for j in range(HORIZON):
                G[:, j:, j] = response[:, : HORIZON - j]
            self._models[age] = plants, G, G.transpose(0, 2, 1) @ G
        return self._models[age]

    def _optimise(
        self, Q: Array, target: Array, start: Array, first: Array | float | None = None
    ) -> Array:
        """Minimise u Q u / 2 - target u within the limits by coordinate descent.

        Plans have one row per command here, shape (HORIZON, runs).
        """
        plan = start.copy()
        if first is not None:
            plan[0] = first
        rows = np.ascontiguousarray(Q.transpose(1, 2, 0))
        targets = np.ascontiguousarray(target.T)
        for _ in range(SWEEPS):
            before = plan.copy()
            for i in range(0 if first is None else 1, HORIZON):
                slope = targets[i] - np.add.reduce(plan * rows[i])
                best = np.maximum(plan[i] + slope / rows[i, i], self._u_min)
                np.minimum(best, self._u_max, out=plan[i])
            if np.abs(plan - before).max() < TOLERANCE:
                break
        return plan
