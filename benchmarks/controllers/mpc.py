"""A predictive controller that knows the plant and the actuator exactly, but not the future.

It shows how near the bounds of `benchmarks.limits` a controller can come.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agents.controller import action_from_command
from benchmarks.scenarios import plain
from mptc_gym import Parameters

Array = NDArray[np.float64]

HORIZON = 5  # commands that are planned; the first is given, then all are planned anew
SWEEPS, TOLERANCE = 100, 1e-4  # of coordinate descent: how many at most, and t/h to stop at


class PredictiveController:
    """Plans, at each sample, the inputs that bring the expected output to the set point.

    Of the plant (28) it knows A, B, C and d, so that it recovers xi from what it measures, and
    predicts the output that is to be expected without further commands. Over the samples that
    the planned commands reach first it minimises the sum of the squared errors, the set point
    staying as it is, with inputs within the limits. A first input inside the dead zone becomes
    0 or what a command on the edge brings about, whichever the rest of a plan makes better.

    The roots of C must lie within the unit circle, as the paper's do; else xi cannot be told
    from what is measured.

    Parameters
    ----------
    parameters
        All arguments of the environment.
    num_envs
        Number of loops.

    Raises
    ------
    ValueError
        If the plant has what (28) and (29) have not: see `benchmarks.scenarios.plain`.
    """

    def __init__(self, parameters: Parameters, num_envs: int) -> None:
        self._p = parameters = plain(parameters)
        self._num_envs = num_envs
        self._predict = _prediction(parameters)
        self._one_step = _one_step(parameters)
        impulse = _impulse_response(parameters, HORIZON)
        self._G = np.array(
            [
                [impulse[i - j] if i >= j else 0.0 for j in range(HORIZON)]
                for i in range(HORIZON)
            ]
        )
        self._Q = self._G.T @ self._G
        self.reset()

    def reset(self) -> None:
        """Forget the episode: the plant is at rest."""
        # Outputs, disturbances xi and inputs, each newest first, those of the last sample too.
        n_y, n_xi, n_u = _memory(self._p)
        self._state = np.zeros((self._num_envs, n_y + n_xi + n_u))
        self._plan = np.zeros((self._num_envs, HORIZON))

    def act(self, observation: Array) -> NDArray[np.float32]:
        """Return actions, shape (runs, 1), for observations, shape (runs, n_obs)."""
        n_y, n_xi, _ = _memory(self._p)
        seen = np.asarray(observation, dtype=np.float64)
        setpoint = seen[:, 0]
        output = setpoint - seen[:, self._p.setpoint_window]
        xi = output - self._state @ self._one_step
        y, old_xi, u = np.split(self._state, [n_y, n_y + n_xi], axis=1)
        y = np.column_stack([output, y[:, :-1]])
        old_xi = np.column_stack([xi, old_xi[:, :-1]])

        free = np.hstack([y, old_xi, u]) @ self._predict.T
        target = (setpoint[:, np.newaxis] - free) @ self._G
        plan = self._optimise(target, np.column_stack([self._plan[:, 1:], self._plan[:, -1]]))
        inside = np.abs(plan[:, 0]) < self._p.dead_zone
        if inside.any():
            edge = np.copysign(self._p.dead_zone, plan[:, 0])
            edge = edge.clip(self._p.u_min, self._p.u_max)
            plans = [
                self._optimise(target, plan, first) for first in (np.zeros_like(edge), edge)
            ]
            costs = [self._cost(target, p) for p in plans]
            best = np.where((costs[0] <= costs[1])[:, np.newaxis], *plans)
            plan = np.where(inside[:, np.newaxis], best, plan)
        applied = plan[:, 0]
        self._plan = plan
        self._state = np.hstack([y, old_xi, applied[:, np.newaxis], u[:, :-1]])
        # A limit inside the dead zone is reached by a command on the edge.
        needed = np.copysign(np.maximum(np.abs(applied), self._p.dead_zone), applied)
        command = np.where(applied == 0.0, 0.0, needed)
        return action_from_command(command, self._p.u_min, self._p.u_max, self._p.dead_zone)

    def _optimise(self, target: Array, start: Array, first: Array | None = None) -> Array:
        """Minimise u Q u / 2 - target u within the limits, one coordinate after the other."""
        plan = start.copy()
        if first is not None:
            plan[:, 0] = first
        for _ in range(SWEEPS):
            before = plan.copy()
            for i in range(0 if first is None else 1, HORIZON):
                slope = target[:, i] - plan @ self._Q[i]
                step = slope / self._Q[i, i]
                plan[:, i] = (plan[:, i] + step).clip(self._p.u_min, self._p.u_max)
            if np.abs(plan - before).max() < TOLERANCE:
                break
        return plan

    def _cost(self, target: Array, plan: Array) -> Array:
        cost: Array = ((plan @ self._Q) * plan).sum(axis=1) / 2 - (target * plan).sum(axis=1)
        return cost


def _memory(p: Parameters) -> tuple[int, int, int]:
    """Return how many outputs, disturbances and inputs the next output depends on."""
    return max(len(p.a) - 1, 1), max(len(p.c) - 1, 1), p.delay + len(p.b)


def _impulse_response(p: Parameters, samples: int) -> Array:
    """Return the response to a unit input, from the first sample on in which it shows."""
    y = np.zeros(samples)
    for k in range(samples):
        y[k] = p.b[k] if k < len(p.b) else 0.0
        y[k] -= sum(a * y[k - i] for i, a in enumerate(p.a[1:], 1) if k >= i)
    return y


def _one_step(p: Parameters) -> Array:
    """Return the row from the state at the end of a sample to the output expected next."""
    n_y, n_xi, n_u = _memory(p)
    row = np.zeros(n_y + n_xi + n_u)
    row[: len(p.a) - 1] = np.negative(p.a[1:])
    row[n_y : n_y + len(p.c) - 1] = p.c[1:]
    row[n_y + n_xi + p.delay :] = p.b
    return row


def _prediction(p: Parameters) -> Array:
    """Return the matrix from the state to the outputs that commands from now on reach.

    The state is that of y(k) and xi(k) with the inputs up to u(k - 1). The outputs are those
    expected from y(k + d + 1) on, if no command follows.
    """
    n_y, n_xi, n_u = _memory(p)
    nothing = np.zeros(n_y + n_xi + n_u)
    y, xi, u = np.split(np.eye(len(nothing)), [n_y, n_y + n_xi])  # rows over the state
    outputs = []
    for _ in range(p.delay + HORIZON):
        u = np.vstack([nothing, u[:-1]])  # the sample goes by without a command ...
        output = _one_step(p) @ np.vstack([y, xi, u])  # ... and the next one comes
        y = np.vstack([output, y[:-1]])
        xi = np.vstack([nothing, xi[:-1]])
        outputs.append(output)
    return np.array(outputs[p.delay :])
