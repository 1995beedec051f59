"""Solve the linear program behind every bound, and plan the flow of a reference."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy  # loads its modules on first use
from numpy.typing import ArrayLike, NDArray

from benchmarks.lib.errors import NoBoundError
from benchmarks.loop.linear import LinearModel
from benchmarks.loop.rollout import held

Array = NDArray[np.float64]

# Effects of a flow on an output below this fraction of the largest effect are set to 0, so that
# the matrix of a linear program is sparse.
NEGLIGIBLE_RESPONSE = 1e-9
# Pairs of a method of `scipy.optimize.linprog` and whether its solver, HiGHS, simplifies the
# program first. For a few plants a pair fails, and the next pair is tried.
SOLVERS = ("highs-ds", True), ("highs-ds", False), ("highs-ipm", True)
TIME_LIMIT = 30.0  # s for each attempt; most programs take less than 1 s

# A plant counts as settled if the flow stays within this fraction of the actuator's range for
# the lag of the plant, the time from a flow to its first effect.
SETTLED = 0.05
# Samples by which the plan of a reference looks beyond a change of the set point, in addition
# to the lag. With more samples the references of the presets are the same.
TAIL = 60
# Two small prices that select among plans with equal errors; the price of an error is 1. With
# `SMALLEST_SLOPE`, degC for each degC, a plan ends at the set point. With `TRAVEL_PRICE`, degC
# for each t/h of valve travel, the valve moves no more than needed.
SMALLEST_SLOPE = 0.001
TRAVEL_PRICE = 1e-4


@dataclass(frozen=True)
class Unknown:
    """Lower bounds of E|m - n| at each sample: the highest of lines in |m|.

    Here n is the part of the output, degC, that no flow can counteract in time, and m the error
    without n; see `unknown.py`. A line is intercept + slope * |m|.
    """

    # The slopes of the lines, ascending from 0 to 1, shape (slopes,). If nothing is unknown, n
    # is 0, and the only slope is 1.
    slopes: Array
    intercepts: Array  # of the lines at each sample, degC, shape (samples, slopes)

    def mean_error(self, m: Array) -> Array:
        """Return the lower bounds of E|m(k) - n(k)| for expected errors m(k).

        `m` holds the expected errors of the first samples, degC, shape (count,), and the bounds
        have the same unit and shape.
        """
        lines = self.intercepts[: len(m)] + self.slopes * np.abs(m)[:, np.newaxis]
        return np.asarray(lines.max(axis=1))

    @property
    def lengths(self) -> Array:
        """Lengths of the intervals of |m| on which each line is the highest line, degC.

        The shape is (samples, slopes). The interval of the last line is infinitely long.
        """
        ends = np.full(self.intercepts.shape, np.inf)
        corners = -np.diff(self.intercepts, axis=1) / np.diff(self.slopes)
        ends[:, :-1] = np.maximum.accumulate(corners, axis=1)
        return np.diff(ends, axis=1, prepend=0.0)


def equations(model: LinearModel, samples: int) -> tuple[Any, Any]:
    """Return the matrices A and B of A y = B u for the plant without noise and load.

    The vectors y and u hold the outputs, degC, and the flows, t/h, of an episode from rest. The
    matrix equation is equation (28) of the paper for all samples of an episode. `model` is the
    plant, and `samples` the length of the episode. Both matrices are sparse and have the shape
    (samples, samples).
    """
    past_outputs = _lagged(model.alpha[:samples], 1)
    past_flows = _lagged(model.beta[:samples], int(model.numbers.delay) + 1)
    return (scipy.sparse.eye_array(samples) - past_outputs).tocsr(), past_flows


def _lagged(coefficients: Array, lag: int) -> Any:
    """Return a sparse square matrix with coefficients[k, i] in row k, column k - lag - i.

    `coefficients` has the shape (samples, order), and the matrix (samples, samples).
    """
    samples, order = coefficients.shape
    diagonals = coefficients.T, lag + np.arange(order)
    return scipy.sparse.dia_array(diagonals, shape=(samples, samples)).T.tocsr()


def response(A: Any, B: Any) -> Array:
    """Return G, which solves A G = B: a flow of 1 t/h at sample j adds G[k, j] degC to y(k).

    `A` and `B` are what `equations` returns, of shape (samples, samples), as is G.
    """
    return np.asarray(scipy.linalg.solve_triangular(A.toarray(), B.toarray(), lower=True))


class Plan(NamedTuple):
    """The mean flow for which the sum of the bounds of E|e(k)| is least, and these bounds."""

    errors: Array  # lower bounds of E|e(k)|, degC, shape (samples,)
    flow: Array  # the mean of u_a(k), t/h, shape (samples,)


def plan(
    model: LinearModel,
    unknown: Unknown,
    setpoint: Array,
    *,
    past: ArrayLike = (),
    quiet: bool = False,
    penalty: ArrayLike = 0.0,
) -> Plan:
    """Return the mean flow for which the sum of the bounds of E|e(k)| is least.

    The minimum is a lower bound for every controller, causal or not. To see this, let y and u_a
    be the means of output and flow over all noise, load and randomness of the controller. As
    equation (28) of the paper is linear, these means satisfy equation (28) without noise. As
    the flow always lies within the limits, so does its mean. As E|m - n| is convex in the error
    m without the unknown effects n, its mean over everything that may be known is at least its
    value at the mean of m, which is y_d - y, the set point minus the mean output (Jensen's
    inequality). So the controller's mean error is at least the minimum over all mean flows
    within the limits. The minimum is a linear program, as each bound of E|m - n| is a maximum
    of lines.

    The bound is loose where the required flow lies inside the dead zone: the mean of the flows
    0 and 5 t/h is 2.5 t/h, which no valve with a dead zone of 5 t/h passes. The bound is also
    loose where the flow must alternate between the two sides of a limit.

    Parameters
    ----------
    model
        The plant, for at least as many samples as `setpoint` has.
    unknown
        The lower bounds of E|m - n| for this plant.
    setpoint
        Set points y_d(k), degC, shape (samples,).
    past
        Flows at k = 0, 1, ... that are already decided, t/h, shape (start,).
    quiet
        Whether to prefer, among plans with equal errors, the plan that reaches the set point
        with the least valve travel.
    penalty
        The price of the flow u_a(k), degC for each t/h, of shape (samples,); or a number, the
        price at all samples.

    Raises
    ------
    RuntimeError
        If no solver solves the linear program within `TIME_LIMIT`.
    """
    samples = len(setpoint)
    start = np.size(past)
    price = np.broadcast_to(np.asarray(penalty, float), samples)
    A, B = equations(model, samples)
    flow = np.zeros(samples)
    flow[:start] = past
    n = samples - 1 - start  # outputs after `start`, and flows from `start` on
    if n:
        output_of_past = scipy.sparse.linalg.spsolve_triangular(A, B @ flow)
        lengths = np.repeat(unknown.lengths[start + 1 : samples], 2, axis=1).T.ravel()
        slopes = unknown.slopes
        targets = (setpoint - output_of_past)[start + 1 :]
        moves = 0
        if quiet:
            # A line may be level near m = 0, where a quiet plan needs a slope.
            slopes = np.maximum(slopes, SMALLEST_SLOPE)
            last_flow = flow[start - 1]  # from which the first move starts; 0 at the beginning
            targets = np.concatenate([targets, [last_flow], np.zeros(n - 1)])
            moves = 2 * n
        program = _Program(
            A=A[start + 1 :, start + 1 :],
            B=B[start + 1 :, start:-1],
            targets=targets,
            outputs=_variables(n, 0.0, -np.inf, np.inf),
            flows=_variables(n, price[start:-1], *model.limits),
            pieces=_variables(len(lengths), np.repeat(slopes, 2 * n), 0.0, lengths),
            moves=_variables(moves, TRAVEL_PRICE, 0.0, np.inf),
        )
        flow[start:-1] = _solve(program, zeros=np.roots(model.parameters.b))
    if samples > 1:
        flow[-1] = flow[-2]  # The last flow affects no output; it costs nothing if it stays.
    output = scipy.sparse.linalg.spsolve_triangular(A, B @ flow)
    return Plan(unknown.mean_error(setpoint - output), flow)


class _Variables(NamedTuple):
    """Variables of a linear program; each array has the shape (variables,)."""

    cost: Array  # cost of each unit of a variable
    low: Array  # lower bound of a variable
    high: Array  # upper bound of a variable


def _variables(count: int, cost: Any, low: Any, high: Any) -> _Variables:
    """Return `count` variables of a linear program.

    `cost` is the cost of each unit of a variable, and `low` and `high` are the bounds of the
    variables. Each is an array of shape (count,), or a number for all variables.
    """
    return _Variables(*(np.broadcast_to(values, count) for values in (cost, low, high)))


class _Program(NamedTuple):
    """The linear program of `plan` over n samples.

    The outputs y and the flows u satisfy A y = B u. The expected error m(k) is a sum of pieces
    above 0 and pieces below 0, one of each for every slope of its bound. The first n targets
    are the set points minus the effects of past flows: target k equals output k, plus the
    pieces of m(k) above 0, minus the pieces of m(k) below 0. A quiet plan, which limits valve
    travel, has n more targets: each equals flow k minus flow k - 1, minus the move up, plus the
    move down. These n targets are 0, except the first, which is the last past flow.
    """

    A: Any  # sparse matrix of the plant, shape (n, n)
    B: Any  # sparse matrix of the plant, shape (n, n)
    targets: Array  # right sides, shape (n,), or (2 n,) in a quiet plan
    outputs: _Variables  # the effects of the flows on the outputs, degC, n variables
    flows: _Variables  # t/h, n variables
    pieces: _Variables  # pieces of m, degC: for each slope, n above 0 and then n below 0
    moves: _Variables  # t/h: n moves up and n moves down in a quiet plan, otherwise none


def _solve(program: _Program, zeros: NDArray[Any]) -> Array:
    """Return the flows with the least cost, t/h, shape (n,).

    Parameters
    ----------
    program
        The linear program.
    zeros
        The zeros of the polynomial B in equation (28) of the paper.

    Raises
    ------
    RuntimeError
        If no solver solves the program within `TIME_LIMIT`.
    """
    n = len(program.flows.cost)
    # With outputs among the variables the program is sparse, and fast where A is slow. But if
    # a zero of B lies outside the unit circle, the flow that gives an output grows without
    # bound: solvers that vary outputs freely fail, or end away from the optimum.
    outputs_first = bool(np.all(np.abs(zeros) <= 1.0))
    for with_outputs in (outputs_first, not outputs_first):
        matrix, right = _equalities(program, with_outputs)
        variables: Sequence[_Variables] = program.flows, program.pieces, program.moves
        if with_outputs:
            variables = program.outputs, *variables
        cost, low, high = np.hstack(variables)
        for method, presolve in SOLVERS:
            solution = scipy.optimize.linprog(
                cost,
                A_eq=matrix,
                b_eq=right,
                bounds=np.column_stack([low, high]),
                method=method,
                options={"time_limit": TIME_LIMIT, "presolve": presolve},
            )
            if solution.success:
                first_flow = n if with_outputs else 0
                flows: Array = solution.x[first_flow : first_flow + n]
                return flows
    raise RuntimeError(
        f"the linear program of {n} samples was not solved in any of {2 * len(SOLVERS)} ways: "
        f"{solution.message}"
    )


def _equalities(program: _Program, with_outputs: bool) -> tuple[Any, Array]:
    """Return the equality constraints of a program: a matrix M and a vector r with M x = r.

    The vector x holds all variables of `program`: outputs, if `with_outputs`, then flows,
    pieces and moves. Without outputs among the variables, an output is expressed as the sum of
    the effects of the flows. M is sparse.
    """
    n = len(program.flows.cost)
    rows = len(program.targets)
    eye = scipy.sparse.eye_array(n)
    differences = eye - scipy.sparse.eye_array(n, k=-1)
    of_outputs = scipy.sparse.eye_array(rows, n)
    of_flows = scipy.sparse.eye_array(rows, n, k=-n, format="csr") @ differences
    of_pieces = scipy.sparse.hstack([eye, -eye] * (len(program.pieces.cost) // (2 * n)))
    if rows > n:
        of_pieces = scipy.sparse.block_diag([of_pieces, scipy.sparse.hstack([-eye, eye])])
    if with_outputs:
        blocks: Any = [[program.A, -program.B, None], [of_outputs, of_flows, of_pieces]]
        right = np.concatenate([np.zeros(n), program.targets])
    else:
        G = response(program.A, program.B)
        G[np.abs(G) < NEGLIGIBLE_RESPONSE * np.abs(G).max(initial=0.0)] = 0.0
        blocks = [[of_outputs @ scipy.sparse.csr_array(G) + of_flows, of_pieces]]
        right = program.targets
    return scipy.sparse.block_array(blocks).tocsc(), right


def reference(model: LinearModel, unknown: Unknown, setpoint: Array) -> Plan:
    """Return the plan of a controller that never expects another change of the set point.

    For set points that are not random (a square wave, a list), the only lower bound is the
    bound for controllers with preview, as a controller may have the times of all changes built
    in. The reference replaces a bound without preview. At each change of the set point, the
    controller chooses the flow that is best if the new set point stays for ever. If the plant
    has settled before the next change, each change causes the least error that is possible
    without preview; see `plan`.

    Parameters
    ----------
    model
        The plant, for `model.lag + TAIL` samples more than `setpoint` has.
    unknown
        The lower bounds of E|m - n| for this plant; see `unknown.py`.
    setpoint
        Set points y_d(k), degC, shape (samples,).

    Raises
    ------
    NoBoundError
        If the plant has not settled when the set point changes.
    RuntimeError
        If no solver solves a linear program within `TIME_LIMIT`.
    """
    low, high = model.limits
    flow = np.zeros(0)
    errors = np.zeros(len(setpoint))
    for start, stop in held(setpoint):
        is_last = stop == len(setpoint)
        ahead = setpoint[:stop]
        if not is_last:
            beyond = np.full(model.lag + TAIL, setpoint[start])
            ahead = np.concatenate([ahead, beyond])
        planned = plan(model, unknown, ahead, past=flow[:start], quiet=True)
        flow = planned.flow
        errors[start:stop] = planned.errors[start:stop]
        moves = np.ptp(flow[max(stop - model.lag - 1, start - 1, 0) : stop])  # t/h
        has_settled = stop - start >= model.lag and moves <= SETTLED * (high - low)
        if not (is_last or has_settled):
            raise NoBoundError(
                "setpoint must be held until the plant has settled, or there is no reference; "
                f"got a hold of {stop - start} samples"
            )
    return Plan(errors, flow)
