"""Solve the linear program behind every bound, and plan the flow of a reference."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy  # loads its modules on first use
from numpy.typing import NDArray

from benchmarks.bounds.unknown import Unknown
from benchmarks.loop.linear import TimeVaryingModel
from benchmarks.loop.rollout import held

Array = NDArray[np.float64]

NOTHING = 1e-9  # fraction of the largest response below which a response is left out
SOLVERS = ("highs-ds", True), ("highs-ds", False), ("highs-ipm", True)  # method, and presolve
TIME_LIMIT = 30.0  # s for each attempt

# For a reference.
SETTLED = 0.05  # fraction of the flow's range that a settled flow may move within the lag
TAIL = 60  # samples that a plan looks beyond the end of a hold, in addition to the lag
LEVEL = 0.001  # least slope of the error in plans, so that they end at the set point
SMOOTH = 1e-4  # price per t/h of travel, which selects the quietest of equal plans


@dataclass(frozen=True)
class Plan:
    """A solution of the linear program. All arrays have the shape (samples,)."""

    error: Array
    """The lower bound of E|e(k)|, degC."""
    output: Array
    """The mean of y(k), degC."""
    flow: Array
    """The mean of u_a(k), t/h."""
    cost: float
    """The minimum of the objective over k = 1 to N, as no flow changes e(0); degC."""


def plan(
    model: TimeVaryingModel,
    unknown: Unknown,
    setpoint: Array,
    *,
    before: Plan | None = None,
    start: int = 0,
    quiet: bool = False,
    penalty: Array | None = None,
) -> Plan:
    """Minimise the sum of the bounds of E|e(k)| over the mean flow.

    Take any controller, causal or not, and let y and u_a stand for their means over all noise,
    load and randomness of the controller. As (28) is linear, the means obey it without noise;
    as u_a(k) always lies within [low, high], so does its mean; and as E|m - n| is convex in m,
    its mean over everything that may be known is at least its value at the mean of m, which is
    y_d - y (Jensen). So the controller's error is at least the minimum over all mean flows
    within the limits: a linear program, as each bound of E|m - n| is a maximum of lines.

    The bound is loose where the required flow lies within the dead zone, or alternates between
    the two sides of a limit: the mean of 0 and 5 t/h is 2.5 t/h, and the mean of what the noise
    requires may lie within limits that single demands exceed.

    The model covers at least the samples of `setpoint`, y_d(k) in degC. Outputs up to sample
    `start`, and flows before it, are those of the plan `before`; without one, the plant has
    been at rest. The cost counts the samples from `start` on, with a `penalty` in degC for
    each t/h of u_a(k), shape (samples,). A `quiet` plan is, of equally good ones, the one that
    comes to the set point with the least travel. A RuntimeError is raised if all attempts
    fail or take too long.
    """
    samples = len(setpoint)
    penalty = np.zeros(samples) if penalty is None else penalty
    output, flow = np.zeros(samples), np.zeros(samples)
    if before is not None:
        output[: start + 1], flow[:start] = before.output[: start + 1], before.flow[:start]
    n = samples - 1 - start  # outputs after `start`, and flows from it on
    of_now = unknown.of(start, samples)
    if n:
        output[start + 1 :], flow[start:-1] = _solve(
            model, of_now, setpoint, output, flow, start, quiet, penalty
        )
    # The last flow affects no output; if it does not move, it costs nothing either.
    flow[-1] = flow[-2] if samples > 1 else 0.0
    error = np.zeros(samples)
    error[start:] = of_now.mean_error(setpoint[start:] - output[start:])
    cost = error[1:].sum() + penalty[start:] @ flow[start:]
    return Plan(error, output, flow, float(cost))


def _solve(
    model: TimeVaryingModel,
    unknown: Unknown,
    setpoint: Array,
    output: Array,
    flow: Array,
    start: int,
    quiet: bool,
    penalty: Array,
) -> tuple[Array, Array]:
    """Return outputs after `start`, and flows from it on."""
    samples = len(setpoint)
    n = samples - 1 - start
    # (28) without noise: A y = B u, rows from start + 1 on; the past goes to the right side.
    A = scipy.sparse.eye_array(samples) - _lagged(model.alpha, samples, 1)
    B = _lagged(model.beta, samples, model.delay + 1)
    A, B = A.tocsr()[start + 1 :], B.tocsr()[start + 1 :]
    past = B[:, :start] @ flow[:start] - A[:, : start + 1] @ output[: start + 1]
    A, B = A[:, start + 1 :], B[:, start:-1]

    # The unknowns are y, u, the pieces of E|m - n| for m above and below 0, and the moves up
    # and down of a quiet plan.
    # The bound of E|m - n| may be level near 0, where a quiet plan needs a slope.
    slopes = np.maximum(unknown.slopes, LEVEL if quiet else 0.0)
    eye = scipy.sparse.eye_array(n)
    pieces = scipy.sparse.hstack([eye, -eye] * len(slopes))
    lengths = np.repeat(unknown.lengths[1:], 2, axis=1).T.ravel()
    columns = [
        _unknowns(n, 0.0, -np.inf, np.inf),
        _unknowns(n, penalty[start:-1], model.low, model.high),
        _unknowns(len(lengths), np.repeat(slopes, 2 * n), 0.0, lengths),
    ]
    rows: list[list[Any]] = [[A, -B, None], [eye, None, pieces]]
    right = [past, setpoint[start + 1 :]]
    if quiet:
        moves = eye - scipy.sparse.eye_array(n, k=-1)
        rows = [[*row, None] for row in rows]
        rows.append([None, moves, None, scipy.sparse.hstack([-eye, eye])])
        right.append(np.zeros(n))
        right[-1][0] = flow[start - 1] if start else 0.0
        columns.append(_unknowns(2 * n, SMOOTH, 0.0, np.inf))

    # With outputs among the unknowns the program is sparse, and fast where A is slow. But if
    # a zero of B lies outside the unit circle, the flow that gives an output grows without
    # bound: solvers that vary outputs freely fail, or end away from the optimum.
    for_flows_alone = [False, True]
    if np.any(np.abs(np.roots(model.beta[start])) > 1.0):
        for_flows_alone.reverse()
    attempts = list(itertools.product(for_flows_alone, SOLVERS))
    for flows_alone, (method, presolve) in attempts:
        blocks, targets, unknowns = rows, right, columns
        if flows_alone:  # each output is the sum of the effects of the flows
            idle = scipy.linalg.solve_triangular(A.toarray(), past, lower=True)
            G = scipy.linalg.solve_triangular(A.toarray(), B.toarray(), lower=True)
            G[np.abs(G) < NOTHING * np.abs(G).max(initial=0.0)] = 0.0
            blocks = [[scipy.sparse.csr_array(G), *rows[1][2:]], *(row[1:] for row in rows[2:])]
            targets, unknowns = [right[1] - idle, *right[2:]], columns[1:]
        costs_and_ends = np.concatenate(unknowns)
        solved = scipy.optimize.linprog(
            costs_and_ends[:, 0],
            A_eq=scipy.sparse.block_array(blocks).tocsc(),
            b_eq=np.concatenate(targets),
            bounds=costs_and_ends[:, 1:],
            method=method,
            options={"time_limit": TIME_LIMIT, "presolve": presolve},
        )
        if solved.success and flows_alone:
            return idle + G @ solved.x[:n], solved.x[:n]
        if solved.success:
            return solved.x[:n], solved.x[n : 2 * n]
    raise RuntimeError(
        f"the linear program of {n} samples was not solved in any of {len(attempts)} ways: "
        f"{solved.message}"
    )


def _unknowns(count: int, cost: Any, low: Any, high: Any) -> Array:
    return np.column_stack([np.broadcast_to(each, count) for each in (cost, low, high)])


def _lagged(coefficients: Array, samples: int, lag: int) -> scipy.sparse.sparray:
    """Return the matrix that maps x to the sum over i of coefficients[k, i] x(k - lag - i)."""
    inside = [i for i in range(coefficients.shape[1]) if lag + i < samples]
    if not inside:
        return scipy.sparse.csr_array((samples, samples))
    diagonals = [coefficients[lag + i : samples, i] for i in inside]
    offsets = [-(lag + i) for i in inside]
    return scipy.sparse.diags_array(diagonals, offsets=offsets, shape=(samples, samples))


def reference(model: TimeVaryingModel, unknown: Unknown, setpoint: Array) -> Plan:
    """Return the best mean flow of a controller that never expects another change.

    Where set points have no law (a square wave, a list), the only bound is that with preview:
    for one given sequence any controller may have the times of its changes built in. The
    reference holds under a condition. At each change the controller takes, from where it is,
    the flow that is best if the new set point stays. If the plant has settled by the next
    change, each change costs the least that is possible without preview; see `plan`. If it has
    not settled, a ValueError is raised.

    The model covers `model.lag + TAIL` samples more than `setpoint`.
    """
    settled = SETTLED * (model.high - model.low)
    error = np.zeros(len(setpoint))
    found: Plan | None = None
    for start, stop in held(setpoint):
        last = stop == len(setpoint)
        beyond = np.full(0 if last else model.lag + TAIL, setpoint[start])
        ahead = np.concatenate([setpoint[:stop], beyond])
        found = plan(model, unknown, ahead, before=found, start=start, quiet=True)
        error[start:stop] = found.error[start:stop]
        moving = found.flow[max(stop - model.lag - 1, start - 1, 0) : stop]
        if not last and (stop - start < model.lag or np.ptp(moving) > settled):
            raise ValueError(
                "setpoint must be held until the plant has settled, or there is no reference; "
                f"got a hold of {stop - start} samples"
            )
    assert found is not None
    travel = np.abs(np.diff(found.flow, prepend=0.0)).sum()
    return replace(found, error=error, cost=float(error[1:].sum() + SMOOTH * travel))
