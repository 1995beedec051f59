"""Solve the linear program behind every bound, and plan the flow of a reference."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # loads its modules on first use
from numpy.typing import ArrayLike, NDArray

from benchmarks.lib.errors import NoBoundError
from benchmarks.loop.linear import LinearModel
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
class Unknown:
    """Lower bounds of E|m - n|: the highest of the lines intercept + slope * |m|."""

    slopes: Array
    """Ascending, from 0 to 1; or 1 alone if nothing is unknown. Shape (slopes,)."""
    intercepts: Array
    """degC, shape (samples, slopes)."""

    def mean_error(self, m: Array) -> Array:
        """Return the bound of E|m - n| for the first len(m) samples, degC."""
        lines = self.intercepts[: len(m)] + self.slopes * np.abs(m)[:, np.newaxis]
        return np.asarray(lines.max(axis=1))

    @property
    def lengths(self) -> Array:
        """Lengths of the pieces of |m| that make up the bound, shaped like `intercepts`.

        Each piece has its slope, and ends at a corner between two lines.
        """
        ends = np.full(self.intercepts.shape, np.inf)
        corners = -np.diff(self.intercepts, axis=1) / np.diff(self.slopes)
        ends[:, :-1] = np.maximum.accumulate(corners, axis=1)
        return np.diff(ends, axis=1, prepend=0.0)


def equations(model: LinearModel, samples: int) -> tuple[Any, Any]:
    """Return A and B of (28) without noise, A y = B u, for an episode from rest."""
    lags = 1, int(model.numbers.delay) + 1
    below, B = (
        # Row k has coefficients[k, i] in column k - lag - i.
        scipy.sparse.dia_array(
            (each[:samples].T, lag + np.arange(each.shape[1])), shape=(samples, samples)
        ).T.tocsr()
        for each, lag in zip((model.alpha, model.beta), lags, strict=True)
    )
    return (scipy.sparse.eye_array(samples) - below).tocsr(), B


def response(A: Any, B: Any) -> Array:
    """Return G, which solves A G = B: 1 t/h at j adds G[k, j] to y(k)."""
    return np.asarray(scipy.linalg.solve_triangular(A.toarray(), B.toarray(), lower=True))


def plan(
    model: LinearModel,
    unknown: Unknown,
    setpoint: Array,
    *,
    past: ArrayLike = (),
    quiet: bool = False,
    penalty: ArrayLike = 0.0,
) -> tuple[Array, Array]:
    """Minimise the sum of the bounds of E|e(k)| over the mean flow; return bounds and flow.

    Take any controller, causal or not, and let y and u_a stand for their means over all noise,
    load and randomness of the controller. As (28) is linear, the means obey it without noise;
    as u_a(k) always lies within the limits, so does its mean; and as E|m - n| is convex in m,
    its mean over everything that may be known is at least its value at the mean of m, which is
    y_d - y (Jensen). So the controller's error is at least the minimum over all mean flows
    within the limits: a linear program, as each bound of E|m - n| is a maximum of lines.

    The bound is loose where the required flow lies within the dead zone, or alternates between
    the two sides of a limit: the mean of 0 and 5 t/h is 2.5 t/h.

    The model covers at least the samples of `setpoint`, y_d(k) in degC. The plant starts from
    rest with the flows of the `past`, shape (start,). A `penalty` is in degC for each t/h of
    u_a(k), shape (samples,). A `quiet` plan is, of equally good ones, the one that comes to the
    set point with the least travel. A RuntimeError is raised if no attempt solves it in time.
    """
    samples, start = len(setpoint), np.size(past)
    price = np.broadcast_to(np.asarray(penalty, float), samples)
    A, B = equations(model, samples)
    flow = np.zeros(samples)
    flow[:start] = past
    idle = scipy.sparse.linalg.spsolve_triangular(A, B @ flow)
    n = samples - 1 - start  # outputs after `start`, and flows from it on
    if n:
        # The bound of E|m - n| may be level near 0, where a quiet plan needs a slope.
        slopes = np.maximum(unknown.slopes, LEVEL if quiet else 0.0)
        lengths = np.repeat(unknown.lengths[start + 1 : samples], 2, axis=1).T.ravel()
        unknowns = [
            _unknowns(n, 0.0, -np.inf, np.inf),
            _unknowns(n, price[start:-1], *model.limits),
            _unknowns(len(lengths), np.repeat(slopes, 2 * n), 0.0, lengths),
            _unknowns(2 * n * quiet, SMOOTH, 0.0, np.inf),
        ]
        targets = np.zeros(n + n * quiet)
        targets[:n] = (setpoint - idle)[start + 1 :]
        targets[n : n + 1] = flow[start - 1]  # which the moves start from: 0 at the beginning
        own = A[start + 1 :, start + 1 :], B[start + 1 :, start:-1]
        flow[start:-1] = _solve(*own, targets, unknowns, np.roots(model.parameters.b))
    # The last flow affects no output; if it does not move, it costs nothing either.
    flow[-1] = flow[-2] if samples > 1 else 0.0
    output = scipy.sparse.linalg.spsolve_triangular(A, B @ flow)
    return unknown.mean_error(setpoint - output), flow


def _unknowns(count: int, cost: Any, low: Any, high: Any) -> Array:
    return np.column_stack([np.broadcast_to(each, count) for each in (cost, low, high)])


def _solve(
    A: Any, B: Any, targets: Array, unknowns: Sequence[Array], zeros: NDArray[Any]
) -> Array:
    """Return the flows of the least cost.

    The unknowns, each with its cost and ends, are y, u, the pieces of E|m - n| for m above and
    below 0, and the moves up and down of a quiet plan. `zeros` are those of B.
    """
    n, rows = A.shape[0], len(targets)
    eye = scipy.sparse.eye_array(n)
    pieces = scipy.sparse.hstack([eye, -eye] * (len(unknowns[2]) // (2 * n)))
    if rows > n:
        pieces = scipy.sparse.block_diag([pieces, scipy.sparse.hstack([-eye, eye])])
    # The first n targets are y and its pieces, the others the moves of u and theirs.
    of_output = scipy.sparse.eye_array(rows, n)
    moves = eye - scipy.sparse.eye_array(n, k=-1)
    of_flow = scipy.sparse.eye_array(rows, n, k=-n, format="csr") @ moves

    # With outputs among the unknowns the program is sparse, and fast where A is slow. But if
    # a zero of B lies outside the unit circle, the flow that gives an output grows without
    # bound: solvers that vary outputs freely fail, or end away from the optimum.
    orders = sorted([False, True], reverse=bool(np.any(np.abs(zeros) > 1.0)))
    attempts = list(itertools.product(orders, SOLVERS))
    for flows_alone, (method, presolve) in attempts:
        blocks: Any = [[A, -B, None], [of_output, of_flow, pieces]]
        right, columns = np.concatenate([np.zeros(n), targets]), unknowns
        if flows_alone:  # each output is the sum of the effects of the flows
            G = response(A, B)
            G[np.abs(G) < NOTHING * np.abs(G).max(initial=0.0)] = 0.0
            blocks = [[of_output @ scipy.sparse.csr_array(G) + of_flow, pieces]]
            right, columns = targets, unknowns[1:]
        costs_and_ends = np.concatenate(columns)
        solved = scipy.optimize.linprog(
            costs_and_ends[:, 0],
            A_eq=scipy.sparse.block_array(blocks).tocsc(),
            b_eq=right,
            bounds=costs_and_ends[:, 1:],
            method=method,
            options={"time_limit": TIME_LIMIT, "presolve": presolve},
        )
        if solved.success:
            flows: Array = solved.x[:n] if flows_alone else solved.x[n : 2 * n]
            return flows
    raise RuntimeError(
        f"the linear program of {n} samples was not solved in any of {len(attempts)} ways: "
        f"{solved.message}"
    )


def reference(model: LinearModel, unknown: Unknown, setpoint: Array) -> tuple[Array, Array]:
    """Return what `plan` does, for a controller that never expects another change.

    Where set points have no law (a square wave, a list), the only bound is that with preview:
    for one given sequence any controller may have the times of its changes built in. The
    reference holds under a condition. At each change the controller takes, from where it is,
    the flow that is best if the new set point stays. If the plant has settled by the next
    change, each change costs the least that is possible without preview; see `plan`. If it has
    not settled, a `NoBoundError` is raised.

    The model covers `model.lag + TAIL` samples more than `setpoint`.
    """
    low, high = model.limits
    flow, error = np.zeros(0), np.zeros(len(setpoint))
    for start, stop in held(setpoint):
        last = stop == len(setpoint)
        beyond = np.full(0 if last else model.lag + TAIL, setpoint[start])
        ahead = np.concatenate([setpoint[:stop], beyond])
        of_hold, flow = plan(model, unknown, ahead, past=flow[:start], quiet=True)
        error[start:stop] = of_hold[start:stop]
        moving = np.ptp(flow[max(stop - model.lag - 1, start - 1, 0) : stop])
        if not last and (stop - start < model.lag or moving > SETTLED * (high - low)):
            raise NoBoundError(
                "setpoint must be held until the plant has settled, or there is no reference; "
                f"got a hold of {stop - start} samples"
            )
    return error, flow
