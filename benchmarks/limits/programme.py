"""The linear programme behind every bound: the best mean flow for a course and a set point."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize, sparse

from benchmarks.limits.unknown import Unknown
from benchmarks.loop.linear import Course

Array = NDArray[np.float64]

NOTHING = 1e-9  # of the largest response: what is smaller is left out
SOLVERS = ("highs-ds", True), ("highs-ds", False), ("highs-ipm", True)  # with presolve or not
TIME_LIMIT = 30.0  # s, of each attempt


class NotSolvedError(RuntimeError):
    """The optimum of a linear programme was not found; the message says why."""


class Programme(NamedTuple):
    """Equations in blocks, a row of matrices each; and cost, low and high of the unknowns."""

    rows: list[list[Any]]
    right: list[Array]
    unknowns: list[Array]


@dataclass(frozen=True)
class Plan:
    """What the programme found. All arrays have the shape (samples,)."""

    error: Array
    """The bound of E|e(k)|, degC."""
    output: Array
    """The mean of y(k), degC."""
    flow: Array
    """The mean of u_a(k), t/h."""
    value: float
    """The least value of what was minimised, degC times samples."""

    @property
    def cost(self) -> float:
        """The value over k = 1 to N: nothing changes e(0)."""
        return self.value - float(self.error[0])

    @property
    def travel(self) -> Array:
        """|u_a(k) - u_a(k-1)| of the mean flow, t/h; 0 before k = 0."""
        moves: Array = np.abs(np.diff(self.flow, prepend=0.0))
        return moves


def plan(
    course: Course,
    unknown: Unknown,
    setpoint: Array,
    *,
    before: Plan | None = None,
    start: int = 0,
    price: float = 0.0,
    penalty: Array | None = None,
    least_slope: float = 0.0,
) -> Plan:
    """Minimise the sum of the bounds of E|e(k)| over the mean flow.

    Let a controller be given, causal or not, and let y and u_a stand for their means over all
    noise, load and own randomness of the controller. As (28) is linear, the means obey it
    without noise; as u_a(k) always lies within [low, high], so does its mean; and as E|m - n|
    is convex in m, its mean over everything that may be known is at least that for the mean of
    m, which is y_d - y (Jensen). So what the controller comes to is at least the minimum over
    all mean flows within the limits: a linear programme, as the bounds of E|m - n| are highest
    lines. The mean travel of a flow is at least the travel of the mean flow, by Jensen again.

    It is loose where the flow that is needed lies within the dead zone or on both sides of a
    limit by turns: the mean of 0 and 5 t/h is 2.5 t/h, and that of what the noise asks for may
    lie within limits that single demands exceed.

    Parameters
    ----------
    course
        The plant, for as many samples as there are set points, or more.
    unknown
        What no command can answer in time.
    setpoint
        y_d(k), degC, shape (samples,).
    before, start
        Outputs up to sample `start`, and flows before it, are those of this plan. Without it,
        the plant has been at rest before k = 0, and `start` is 0.
    price
        Of valve travel, degC times samples for each t/h.
    penalty
        What each t/h of u_a(k) costs in addition, shape (samples,).
    least_slope
        Of the bounds of E|m - n|, while planning: above 0, of all plans that are as good by the
        bounds, which are level near 0, one that comes to the set point is taken.

    Returns
    -------
    Plan
        `value` counts the samples from `start` on.

    Raises
    ------
    NotSolvedError
        If all attempts fail or take too long.
    """
    samples = len(setpoint)
    output, flow = np.zeros(samples), np.zeros(samples)
    if before is not None:
        output[: start + 1], flow[:start] = before.output[: start + 1], before.flow[:start]
    n = samples - 1 - start  # outputs after `start`, and flows from it on
    of_now = unknown.of(start, samples)
    if n:
        solved = _solve(
            course, of_now, setpoint, output, flow, start, price, penalty, least_slope
        )
        output[start + 1 :], flow[start:-1] = solved[:n], solved[n : 2 * n]
    # The last flow shows in no output; without a move it costs nothing either.
    flow[-1] = flow[-2] if samples > 1 else 0.0
    error = np.zeros(samples)
    error[start:] = of_now.mean_error(setpoint[start:] - output[start:])
    moves = np.abs(np.diff(flow, prepend=0.0))[start:]
    value = error[start:].sum() + price * moves.sum()
    if penalty is not None:
        value += float(penalty[start:] @ flow[start:])
    return Plan(error, output, flow, float(value))


def _solve(
    course: Course,
    unknown: Unknown,
    setpoint: Array,
    output: Array,
    flow: Array,
    start: int,
    price: float,
    penalty: Array | None,
    least_slope: float,
) -> Array:
    """Return outputs after `start`, then flows from it on."""
    samples = len(setpoint)
    n = samples - 1 - start
    eye, nothing = sparse.eye_array(n), sparse.csr_array((n, n))

    # (28) without noise: A y = B u, rows from start + 1 on; what is past goes to the right.
    A = sparse.eye_array(samples) - _lagged(course.alpha, samples, 1)
    B = _lagged(course.beta, samples, course.delay + 1)
    A, B = A.tocsr()[start + 1 :], B.tocsr()[start + 1 :]
    past = B[:, :start] @ flow[:start] - A[:, : start + 1] @ output[: start + 1]
    A, B = A[:, start + 1 :], B[:, start:-1]

    # E|m - n| as a sum of pieces of |m|, each with its slope; between lines there are corners.
    slopes, intercepts = unknown.slopes, unknown.intercepts[1:]
    corners = (intercepts[:, :-1] - intercepts[:, 1:]) / np.diff(slopes)
    corners = np.maximum.accumulate(corners, axis=1)
    ends = np.column_stack([corners, np.full(n, np.inf)])
    lengths = np.diff(ends, axis=1, prepend=0.0) if len(slopes) > 1 else ends
    pieces = [(s, sign, length) for s, length in zip(slopes, lengths.T, strict=True)
              for sign in (1.0, -1.0)]  # fmt: skip

    def unknowns(cost: Any, low: Any, high: Any) -> Array:
        return np.column_stack([np.broadcast_to(each, n) for each in (cost, low, high)])

    # y, u, the pieces; then the moves up and down, if they have a price.
    columns = [
        unknowns(0.0, -np.inf, np.inf),
        unknowns(0.0 if penalty is None else penalty[start:-1], course.low, course.high),
        *(unknowns(max(slope, least_slope), 0.0, length) for slope, _, length in pieces),
    ]
    rows = [
        [A, -B, *[nothing] * len(pieces)],
        [eye, nothing, *(sign * eye for _, sign, _ in pieces)],
    ]
    right = [past, setpoint[start + 1 :]]
    if price:
        moves = eye - sparse.eye_array(n, k=-1)
        rows = [[*row, nothing, nothing] for row in rows]
        rows.append([nothing, moves, *[nothing] * len(pieces), -eye, eye])
        first = np.zeros(n)
        first[0] = flow[start - 1] if start else 0.0
        right.append(first)
        columns += [unknowns(price, 0.0, np.inf)] * 2
    programme = Programme(rows, right, columns)
    ways = [_as_recursion, _as_response]
    if np.any(np.abs(np.roots(course.beta[start])) > 1.0):
        ways.reverse()
    attempts = list(itertools.product(ways, SOLVERS))
    found: Array | None
    why = ""
    for way, (method, presolve) in attempts:
        options = {"time_limit": TIME_LIMIT, "presolve": presolve}
        found, why = way(programme, method=method, options=options)
        if found is not None:
            return found
    raise NotSolvedError(
        f"the linear programme of {n} samples was not solved in any of {len(attempts)} ways: "
        f"{why}"
    )


def _as_recursion(programme: Programme, **solver: Any) -> tuple[Array | None, str]:
    """Solve with the outputs among the unknowns: sparse, and fast where A is slow.

    What is returned are the unknowns, or None, and what the solver says.

    Where a zero of B lies outside the unit circle, the flow that belongs to an output grows
    without end: solvers that try outputs at will fail, or end at what is not the optimum.
    """
    unknowns = np.concatenate(programme.unknowns)
    solved = optimize.linprog(
        unknowns[:, 0],
        A_eq=sparse.vstack([sparse.hstack(row) for row in programme.rows]).tocsc(),
        b_eq=np.concatenate(programme.right),
        bounds=unknowns[:, 1:],
        **solver,
    )
    return (solved.x if solved.success else None), solved.message


def _as_response(programme: Programme, **solver: Any) -> tuple[Array | None, str]:
    """Solve for the flows alone, with each output the sum of what the flows do to it."""
    rows, right, unknowns = programme
    A, B = rows[0][0].toarray(), -rows[0][1].toarray()
    alone = linalg.solve_triangular(A, right[0], lower=True)
    G = linalg.solve_triangular(A, B, lower=True)
    G[np.abs(G) < NOTHING * np.abs(G).max(initial=0.0)] = 0.0
    second = [sparse.csr_array(G), *rows[1][2:]]
    reduced = [second, *(row[1:] for row in rows[2:])]
    of_flows = Programme(reduced, [right[1] - alone, *right[2:]], unknowns[1:])
    solved, why = _as_recursion(of_flows, **solver)
    if solved is None:
        return None, why
    return np.concatenate([alone + G @ solved[: len(alone)], solved]), why


def _lagged(coefficients: Array, samples: int, lag: int) -> sparse.sparray:
    """Return the matrix that adds up coefficients[k, i] times x(k - lag - i)."""
    inside = [i for i in range(coefficients.shape[1]) if lag + i < samples]
    if not inside:
        return sparse.csr_array((samples, samples))
    diagonals = [coefficients[lag + i : samples, i] for i in inside]
    offsets = [-(lag + i) for i in inside]
    return sparse.diags_array(diagonals, offsets=offsets, shape=(samples, samples))
