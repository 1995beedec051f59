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
SETTLED_FLOW_RANGE = 0.05
# Samples by which the plan of a reference looks beyond a change of the set point, in addition
# to the lag. With more samples the references of the presets are the same.
LOOKAHEAD = 60
# Two small prices that select among plans with equal errors; the price of an error is 1. With
# `SMALLEST_SLOPE`, degC for each degC, a plan ends at the set point. With `TRAVEL_PRICE`, degC
# for each t/h of valve travel, the valve moves no more than needed.
SMALLEST_SLOPE = 0.001
TRAVEL_PRICE = 1e-4


@dataclass(frozen=True)
class ErrorBounds:
    """Lower bounds of the mean absolute error E|e| at each sample, as functions of |E[e]|.

    A bound is the highest of several lines, intercept + slope * |E[e]|; see `unknown.py`.
    """

    # The slopes of the lines, ascending from 0 to 1, shape (slopes,). If neither noise nor load
    # is random, the only slope is 1.
    slopes: Array
    intercepts: Array  # of the lines at each sample, degC, shape (samples, slopes)

    def mean_error(self, expected_errors: Array) -> Array:
        """Return the lower bounds of the mean absolute errors E|e|, degC, shape (count,).

        `expected_errors` holds the expected errors E[e] of the first samples, degC, shape
        (count,).
        """
        magnitudes = np.abs(expected_errors)[:, np.newaxis]
        lines = self.intercepts[: len(expected_errors)] + self.slopes * magnitudes
        return np.asarray(lines.max(axis=1))

    @property
    def lengths(self) -> Array:
        """For each line, the length of the interval on which the line is the highest, degC.

        The intervals divide the magnitudes of the expected error from 0 to infinity. The
        lengths have the shape (samples, slopes), and the last length is infinite.
        """
        ends = np.full(self.intercepts.shape, np.inf)
        corners = -np.diff(self.intercepts, axis=1) / np.diff(self.slopes)
        ends[:, :-1] = np.maximum.accumulate(corners, axis=1)
        return np.diff(ends, axis=1, prepend=0.0)


def equations(model: LinearModel, samples: int) -> tuple[Any, Any]:
    """Return the matrices A and B of A y = B u, the plant without noise and load.

    The vectors y and u hold the outputs, degC, and the applied flows, t/h, of all `samples` of
    an episode from rest. The matrix equation is equation (28) of the paper. Both matrices are
    sparse and have the shape (samples, samples).
    """
    A = scipy.sparse.eye_array(samples) - _lagged(model.alpha[:samples], 1)
    B = _lagged(model.beta[:samples], int(model.numbers.delay) + 1)
    return A.tocsr(), B


def _lagged(coefficients: Array, lag: int) -> Any:
    """Return a sparse square matrix with coefficients[k, i] in row k, column k - lag - i.

    `coefficients` has the shape (samples, order), and the matrix (samples, samples).
    """
    samples, order = coefficients.shape
    # An element of a diagonal is placed by its column, so the transpose places it by its row.
    diagonals = coefficients.T, lag + np.arange(order)
    return scipy.sparse.dia_array(diagonals, shape=(samples, samples)).T.tocsr()


def response(A: Any, B: Any) -> Array:
    """Return G, which solves A G = B: a flow of 1 t/h at sample j adds G[k, j] degC to y(k).

    `A` and `B` are the sparse matrices of `equations`. G has the shape (samples, samples).
    """
    return np.asarray(scipy.linalg.solve_triangular(A.toarray(), B.toarray(), lower=True))


class Plan(NamedTuple):
    """Mean flows of an episode, and the bounds of the mean errors that the flows cause."""

    errors: Array  # lower bounds of E|e(k)|, degC, shape (samples,)
    flow: Array  # the mean of u_a(k), t/h, shape (samples,)


def plan(
    model: LinearModel,
    bounds: ErrorBounds,
    setpoint: Array,
    *,
    past: ArrayLike = (),
    quiet: bool = False,
    penalty: ArrayLike = 0.0,
) -> Plan:
    """Return the mean flow for which the sum of the bounds of the errors is least.

    The least sum is a lower bound for every controller, even for a controller that knows the
    future. The proof uses y and u, the means of output and applied flow over all noise, loads
    and random decisions of a controller:

    - Equation (28) of the paper is linear, so y and u satisfy equation (28) without noise.
    - The flow always lies within the limits of the actuator, so u lies within the limits.
    - The expected error is the set point minus y, and `bounds` gives a lower bound of the mean
      absolute error for each expected error.

    So the controller's mean error is at least the minimum of the bounds over all u within the
    limits. The minimum is a linear program, as each bound is a maximum of lines.

    The bound is loose where the required flow lies inside the dead zone: the mean of the flows
    0 and 5 t/h is 2.5 t/h, which no valve with a dead zone of 5 t/h passes. The bound is also
    loose where the flow must alternate between the two sides of a limit.

    Parameters
    ----------
    model
        The plant, for at least as many samples as `setpoint` has.
    bounds
        The lower bounds of the mean absolute errors for this plant.
    setpoint
        Set points y_d(k), degC, shape (samples,).
    past
        Flows at k = 0, 1, ... that are already decided, t/h, shape (decided,).
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
    flow = np.zeros(samples)
    decided = np.size(past)
    flow[:decided] = past
    if decided < samples - 1:
        price = np.broadcast_to(np.asarray(penalty, float), samples)
        program = _program(model, bounds, setpoint, flow, decided, quiet, price)
        flow[decided:-1] = _solve(program, zeros=np.roots(model.parameters.b))
    if samples > 1:
        flow[-1] = flow[-2]  # The last flow affects no output; it costs nothing if it stays.
    A, B = equations(model, samples)
    output = scipy.sparse.linalg.spsolve_triangular(A, B @ flow)
    return Plan(bounds.mean_error(setpoint - output), flow)


class _Variables(NamedTuple):
    """Variables of a linear program; each array has the shape (variables,)."""

    cost: Array  # cost of each unit of a variable
    low: Array  # lower bound of a variable
    high: Array  # upper bound of a variable


def _variables(count: int, cost: Any, low: Any, high: Any) -> _Variables:
    """Return `count` variables of a linear program, with numbers repeated for all variables.

    `cost`, `low` and `high` are arrays of shape (count,), or numbers.
    """
    return _Variables(*(np.broadcast_to(values, count) for values in (cost, low, high)))


class _Program(NamedTuple):
    """The linear program of `plan` for the n flows that are not decided yet.

    The outputs y and the flows u satisfy A y = B u. The expected error at k is the sum of
    positive pieces minus the sum of negative pieces. There is a piece of each sign for every
    slope of the bound. The first n targets are the set points minus the effects of past flows:
    target k equals output k plus the expected error at k. A quiet plan, which limits valve
    travel, has n more targets: target n + k equals flow k minus flow k - 1, minus the move up,
    plus the move down. Target n is the last past flow, and the targets after n are 0.
    """

    A: Any  # sparse matrix of the plant, shape (n, n)
    B: Any  # sparse matrix of the plant, shape (n, n)
    targets: Array  # right sides, shape (n,), or (2 n,) in a quiet plan
    outputs: _Variables  # the effects of the flows on the outputs, degC, n variables
    flows: _Variables  # t/h, n variables
    # Pieces of the expected errors, degC: for each slope, n positive and n negative pieces.
    pieces: _Variables
    moves: _Variables  # t/h: n moves up and n moves down in a quiet plan, otherwise none


def _program(
    model: LinearModel,
    bounds: ErrorBounds,
    setpoint: Array,
    flow: Array,
    decided: int,
    quiet: bool,
    price: Array,
) -> _Program:
    """Return the linear program of `plan`, whose solution has the flows that are not decided.

    Parameters
    ----------
    model, bounds, setpoint, quiet
        Arguments of `plan`.
    flow
        The flows that are decided, and 0 for all later flows, t/h, shape (samples,).
    decided
        The number of flows that are decided.
    price
        The price of each flow, degC for each t/h, shape (samples,).
    """
    samples = len(setpoint)
    first = decided + 1  # the first output after the decided flows
    n = samples - first
    A, B = equations(model, samples)
    output_of_past = scipy.sparse.linalg.spsolve_triangular(A, B @ flow)
    targets = (setpoint - output_of_past)[first:]
    slopes = bounds.slopes
    moves = 0
    if quiet:
        # A line may be level near an error of 0, where a quiet plan needs a slope.
        slopes = np.maximum(slopes, SMALLEST_SLOPE)
        last_flow = flow[decided - 1]  # 0 if no flow is decided
        targets = np.concatenate([targets, [last_flow], np.zeros(n - 1)])
        moves = 2 * n
    # In the order of `_Program.pieces`.
    lengths = np.repeat(bounds.lengths[first:samples], 2, axis=1).T.ravel()
    return _Program(
        A=A[first:, first:],
        B=B[first:, decided:-1],
        targets=targets,
        outputs=_variables(n, 0.0, -np.inf, np.inf),
        flows=_variables(n, price[decided:-1], *model.limits),
        pieces=_variables(len(lengths), np.repeat(slopes, 2 * n), 0.0, lengths),
        moves=_variables(moves, TRAVEL_PRICE, 0.0, np.inf),
    )


def _solve(program: _Program, zeros: NDArray[Any]) -> Array:
    """Return the flows of a linear program with the least cost, t/h, shape (n,).

    Parameters
    ----------
    program
        The linear program, with n flows.
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

    The vector x holds the flows, pieces and moves of `program`, after the outputs if
    `with_outputs` is true. If `with_outputs` is false, the equations contain the effects of the
    flows in place of the outputs. M is sparse.
    """
    n = len(program.flows.cost)
    rows = len(program.targets)
    eye = scipy.sparse.eye_array(n)
    differences = eye - scipy.sparse.eye_array(n, k=-1)  # flow k minus flow k - 1
    slopes = len(program.pieces.cost) // (2 * n)
    # Columns of the matrix in the rows of the targets: outputs and pieces stand in the first n
    # rows; flows and moves stand in the next n rows, which only a quiet plan has.
    output_columns = scipy.sparse.eye_array(rows, n)
    flow_columns = scipy.sparse.eye_array(rows, n, k=-n, format="csr") @ differences
    piece_columns = scipy.sparse.hstack([eye, -eye] * slopes)
    if rows > n:  # The columns of the moves follow those of the pieces.
        move_columns = scipy.sparse.hstack([-eye, eye])
        piece_columns = scipy.sparse.block_diag([piece_columns, move_columns])
    if with_outputs:
        plant_rows = [program.A, -program.B, None]
        blocks: Any = [plant_rows, [output_columns, flow_columns, piece_columns]]
        right = np.concatenate([np.zeros(n), program.targets])
    else:
        G = response(program.A, program.B)
        G[np.abs(G) < NEGLIGIBLE_RESPONSE * np.abs(G).max(initial=0.0)] = 0.0
        effects = output_columns @ scipy.sparse.csr_array(G)
        blocks = [[effects + flow_columns, piece_columns]]
        right = program.targets
    return scipy.sparse.block_array(blocks).tocsc(), right


def reference(model: LinearModel, bounds: ErrorBounds, setpoint: Array) -> Plan:
    """Return the plan of a controller that never expects another change of the set point.

    At each change of the set point, the controller chooses the flow that is best if the new set
    point stays for ever. If the plant has settled before each change, no controller that is
    surprised by the changes has a smaller error. The reference is not a lower bound, since a
    controller can have the times of all changes of a square wave built in.

    Parameters
    ----------
    model
        The plant, for `model.lag + LOOKAHEAD` samples more than `setpoint` has.
    bounds
        The lower bounds of the mean absolute errors for this plant.
    setpoint
        Set points y_d(k), degC, shape (samples,).

    Raises
    ------
    NoBoundError
        If the set point changes before the plant has settled.
    RuntimeError
        If no solver solves a linear program within `TIME_LIMIT`.
    """
    low, high = model.limits
    flow = np.zeros(0)
    errors = np.zeros(len(setpoint))
    for start, stop in held(setpoint):
        is_last = stop == len(setpoint)
        expected_setpoint = setpoint[:stop]
        if not is_last:
            beyond = np.full(model.lag + LOOKAHEAD, setpoint[start])
            expected_setpoint = np.concatenate([expected_setpoint, beyond])
        planned = plan(model, bounds, expected_setpoint, past=flow[:start], quiet=True)
        flow = planned.flow
        errors[start:stop] = planned.errors[start:stop]
        # The range of the flows that affect outputs after the change, t/h.
        flow_range = np.ptp(flow[max(stop - model.lag - 1, start - 1, 0) : stop])
        is_long = stop - start >= model.lag
        has_settled = is_long and flow_range <= SETTLED_FLOW_RANGE * (high - low)
        if not (is_last or has_settled):
            raise NoBoundError(
                "setpoint must be held until the plant has settled, or there is no reference; "
                f"got a hold of {stop - start} samples"
            )
    return Plan(errors, flow)
