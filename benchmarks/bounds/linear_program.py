"""Find the flows with the least expected error in an episode by linear programming."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy  # loads its modules on first use
from numpy.typing import ArrayLike, NDArray

from benchmarks.loop.linear import LinearModel
from benchmarks.loop.measures import held

Array = NDArray[np.float64]

# Values of the arguments `method` and `presolve` of `scipy.optimize.linprog`. The pairs are
# tried in turn, since a pair fails for a few plants.
SOLVERS = ("highs-ds", True), ("highs-ds", False), ("highs-ipm", True)
TIME_LIMIT = 30.0  # s for each attempt; most programs take less than 1 s

# A plant counts as settled if the flow stays within this fraction of the actuator's range for
# the lag of the plant, the time from a flow to its first effect.
SETTLED_FLOW_RANGE = 0.05
# Number of samples by which a surprised plan looks beyond a change of the set point, in
# addition to the lag. With more samples, the presets' reference errors would be the same.
LOOKAHEAD = 60
# Two small prices that select one of several plans with equal errors. With `SMALLEST_SLOPE`,
# the least slope of an error bound, a plan ends at the set point. With `TRAVEL_PRICE`, the
# valve moves no more than needed: a move through the whole range of the flow costs as much as
# an error of this share of the largest set point.
SMALLEST_SLOPE = 0.001
TRAVEL_PRICE = 4e-4


class NoReferenceError(ValueError):
    """A case has no reference error of the requested kind.

    For example, a reference error of the kind "surprise" exists only if the plant settles
    before each change of the set point.
    """


@dataclass(frozen=True)
class ErrorBounds:
    """Lower bounds of the mean absolute error E|e| at each sample, as functions of |E[e]|.

    The lower bound of E|e| at a sample is the highest of several straight lines, intercept +
    slope * |E[e]|, which the module `unknown.py` derives.
    """

    # The slopes of the lines, ascending from 0 to 1, shape (slopes,). If neither noise nor load
    # is random, the only slope is 1.
    slopes: Array
    intercepts: Array  # intercepts of the lines, degC, shape (samples, slopes)

    def mean_error(self, expected_errors: Array) -> Array:
        """Return the lower bounds of the mean absolute errors E|e|, degC, shape (count,).

        `expected_errors` has the expected errors E[e] at the first `count` samples, degC, shape
        (count,).
        """
        magnitudes = np.abs(expected_errors)[:, np.newaxis]
        lines = self.intercepts[: len(expected_errors)] + self.slopes * magnitudes
        return np.asarray(lines.max(axis=1))

    @property
    def lengths(self) -> Array:
        """Length of the range of |E[e]| in which each line is the highest line, degC.

        The lengths have the shape (samples, slopes). The last length at each sample is
        infinite, since the steepest line is the highest line for all large values of |E[e]|.
        """
        ends = np.full(self.intercepts.shape, np.inf)
        corners = -np.diff(self.intercepts, axis=1) / np.diff(self.slopes)
        # An intercept is a minimum of functions that are linear in the slope, or a mean of such
        # minima. So intercepts are concave functions of the slope, and corners ascend except
        # for rounding. A line that is nowhere the highest line gets the length 0.
        ends[:, :-1] = np.maximum.accumulate(corners, axis=1)
        return np.diff(ends, axis=1, prepend=0.0)


def equations(model: LinearModel, samples: int) -> tuple[Any, Any]:
    """Return the matrices A and B of A y = B u, the plant without noise and load.

    The equation A y = B u is equation (28) of the paper for all `samples` of an episode that
    starts at rest: y has the outputs, degC, and u has the applied flows, t/h. Both matrices are
    sparse and have the shape (samples, samples).
    """
    A = scipy.sparse.eye_array(samples) - _lagged(model.alpha[:samples], 1)
    B = _lagged(model.beta[:samples], int(model.numbers.delay) + 1)
    return A.tocsr(), B


def _lagged(coefficients: Array, lag: int) -> Any:
    """Return a sparse square matrix with coefficients[k, i] in row k, column k - lag - i.

    `coefficients` has the shape (samples, order), and the returned matrix has the shape
    (samples, samples).
    """
    samples, order = coefficients.shape
    # SciPy places the elements of diagonals by column. The transpose places them by row.
    diagonals = coefficients.T, lag + np.arange(order)
    return scipy.sparse.dia_array(diagonals, shape=(samples, samples)).T.tocsr()


def response(A: Any, B: Any) -> Array:
    """Return the matrix G: a flow of 1 t/h at sample j adds G[k, j] degC to the output y(k).

    G solves A G = B, where `A` and `B` are the sparse matrices of `equations`, and has the
    shape (samples, samples).
    """
    return np.asarray(scipy.linalg.solve_triangular(A.toarray(), B.toarray(), lower=True))


class Plan(NamedTuple):
    """The planned flows of an episode, and lower bounds of the mean errors with these flows."""

    errors: Array  # lower bounds of E|e(k)|, degC, shape (samples,)
    flow: Array  # mean of the applied flow u_a(k), t/h, shape (samples,)


def plan(
    model: LinearModel,
    bounds: ErrorBounds,
    setpoint: Array,
    *,
    past: ArrayLike = (),
    travel_price: float = 0.0,
    penalty: ArrayLike = 0.0,
) -> Plan:
    """Return the flows with the least sum of lower bounds of the mean errors and of prices.

    Without `past`, `travel_price` and `penalty`, the least sum of the lower bounds is a lower
    bound of the sum of the mean errors for every controller, even for a controller that knows
    all future set points. In the proof, y and u are the means of output and applied flow over
    all noise, loads and random decisions of a controller:

    - Equation (28) of the paper is linear, so the means y and u satisfy equation (28) without
      noise.
    - The applied flow always lies within the limits of the actuator, so the mean flow u lies
      within the limits.
    - The expected error is the set point minus the mean output y, and `bounds` gives a lower
      bound of the mean absolute error for each expected error.

    So the sum of the mean errors of every controller is at least the least sum of the lower
    bounds over all mean flows u within the limits. A linear program finds the least sum of the
    lower bounds, since each lower bound is the maximum of several straight lines.

    The lower bound of the errors is far below the errors of real controllers where the required
    flow lies inside the dead zone: the mean of the flows 0 and 5 t/h is 2.5 t/h, but a valve
    with a dead zone of 5 t/h cannot apply a flow of 2.5 t/h. The lower bound of the errors is
    also far below the errors of real controllers where the required flow lies now inside and
    now outside the limits of the actuator.

    Parameters
    ----------
    model
        The plant at as many samples as `setpoint` has, or at more samples.
    bounds
        Lower bounds of the mean absolute errors for the plant `model`.
    setpoint
        Set points y_d(k), degC, shape (samples,).
    past
        Flows at the samples k = 0, 1, ... that the plan must not change, t/h, shape (count,):
        at most samples - 1 flows, as the last flow of an episode affects no output.
    travel_price
        Price of valve travel, degC per t/h. A small price chooses, among plans with equal
        errors, the plan with the least valve travel.
    penalty
        Price of the flow u_a(k), degC per t/h, shape (samples,), or one price for all samples.

    Raises
    ------
    RuntimeError
        If no solver solves the linear program within `TIME_LIMIT` seconds.
    """
    samples = len(setpoint)
    flow = np.zeros(samples)
    past_count = np.size(past)
    flow[:past_count] = past
    A, B = equations(model, samples)
    if past_count < samples - 1:
        # The errors if all flows after `past` are 0: the solution y of A y = B u is the output.
        error_without_plan = setpoint - scipy.sparse.linalg.spsolve_triangular(A, B @ flow)
        price = np.broadcast_to(np.asarray(penalty, float), samples)
        program = _program(
            model, bounds, error_without_plan, flow[:past_count], travel_price, price
        )
        chosen = samples - 1 - past_count  # number of flows
        # The variables of the program are `chosen` outputs, `chosen` flows, and others.
        flow[past_count:-1] = _solve(program)[chosen : 2 * chosen]
    if samples > 1:
        flow[-1] = flow[-2]  # The last flow affects no output, even without delay.
    output = scipy.sparse.linalg.spsolve_triangular(A, B @ flow)
    return Plan(bounds.mean_error(setpoint - output), flow)


def _program(
    model: LinearModel,
    bounds: ErrorBounds,
    error_without_plan: Array,
    past: Array,
    travel_price: float,
    price: Array,
) -> dict[str, Any]:
    """Return the linear program that chooses the n flows between past flows and last flow.

    The result has the arguments of `scipy.optimize.linprog`. The variables are, in this order:

    - the effects y of the n flows on the n outputs after the past flows, degC;
    - the n flows u, t/h;
    - pieces of the expected errors, degC: n positive and n negative pieces for each slope of
      the lower bound of the mean error;
    - if valve travel has a price, n upward and n downward moves of the valve, t/h.

    The equations are A y = B u, where A and B are the plant's matrices in equation (28) of the
    paper; y plus the positive pieces minus the negative pieces equals the error without the n
    flows; and, if valve travel has a price, each flow minus the previous flow equals the upward
    minus the downward move. With outputs among the variables, the linear program is sparse, so
    that solvers are fast even if the plant is slow.

    Parameters
    ----------
    model, bounds, travel_price
        Arguments of `plan`.
    error_without_plan
        Expected errors if all flows after the past flows are 0, degC, shape (samples,).
    past
        Past flows, which are fixed, t/h, shape (count,).
    price
        Price of each flow, degC per t/h, shape (samples,).
    """
    samples = len(error_without_plan)
    count = len(past)
    first = count + 1  # sample of the first output after the past flows
    n = samples - first
    A, B = equations(model, samples)
    eye = scipy.sparse.eye_array(n)
    slopes = bounds.slopes
    if travel_price:
        # A line may have the slope 0 near an error of 0, but a plan with little travel needs a
        # slope above 0 to end at the set point: with the slope 0, an error that saves travel
        # would cost nothing.
        slopes = np.maximum(slopes, SMALLEST_SLOPE)
    signs = scipy.sparse.hstack([eye, -eye] * len(slopes))
    # Rows of the n outputs, from `first` on, and columns of the n flows, from `count` on; the
    # last flow affects no output.
    blocks = [[A[first:, first:], -B[first:, count:-1], None], [eye, None, signs]]
    right = [np.zeros(n), error_without_plan[first:]]
    # For each slope, n lengths for the positive pieces, and the same for the negative pieces.
    lengths = np.repeat(bounds.lengths[first:samples], 2, axis=1).T.ravel()
    costs = [np.zeros(n), price[count:-1], np.repeat(slopes, 2 * n)]
    low = [np.full(n, -np.inf), np.full(n, model.limits[0]), np.zeros(len(lengths))]
    high = [np.full(n, np.inf), np.full(n, model.limits[1]), lengths]
    if travel_price:  # further columns and rows, for the moves
        differences = eye - scipy.sparse.eye_array(n, k=-1)  # flow k minus flow k - 1
        moves = scipy.sparse.hstack([-eye, eye])
        blocks = [[*row, None] for row in blocks]
        blocks.append([None, differences, None, moves])
        last_flow = past[-1] if count else 0.0  # before the first of the n flows
        right.append(np.append(last_flow, np.zeros(n - 1)))
        costs.append(np.full(2 * n, travel_price))
        low.append(np.zeros(2 * n))
        high.append(np.full(2 * n, np.inf))
    return {
        "c": np.concatenate(costs),
        "A_eq": scipy.sparse.block_array(blocks).tocsc(),
        "b_eq": np.concatenate(right),
        "bounds": np.column_stack([np.concatenate(low), np.concatenate(high)]),
    }


def _solve(program: dict[str, Any]) -> Array:
    """Return the variables of a linear program with the least cost, shape (variables,).

    A RuntimeError is raised if no solver solves `program` within `TIME_LIMIT` seconds.
    """
    for method, presolve in SOLVERS:
        solution = scipy.optimize.linprog(
            **program,
            method=method,
            options={"time_limit": TIME_LIMIT, "presolve": presolve},
        )
        if solution.success:
            return np.asarray(solution.x, np.float64)
    raise RuntimeError(
        f"scipy.optimize.linprog did not solve the linear program with {len(program['c'])} "
        f"variables in {len(SOLVERS)} attempts: {solution.message}"
    )


def price_of_travel(model: LinearModel, setpoint: Array) -> float:
    """Return the price of valve travel in a surprised plan, degC per t/h."""
    low, high = model.limits
    return TRAVEL_PRICE * float(np.abs(setpoint).max()) / (high - low)


def surprised_plan(model: LinearModel, bounds: ErrorBounds, setpoint: Array) -> Plan:
    """Return the plan of a controller that never expects another change of the set point.

    At each change of the set point, the controller chooses the flows that are best if the set
    point never changes again. If the plant has settled before each change of the set point, no
    controller that does not expect the changes has a smaller mean error than the plan. A
    controller that knows the times of the set-point changes in advance, as of a square wave,
    can have a smaller mean error than the plan, so the errors of the plan are not lower bounds
    for all controllers.

    Parameters
    ----------
    model
        The plant at all samples of `setpoint`, and at `model.lag + LOOKAHEAD` or more samples
        after them.
    bounds
        Lower bounds of the mean absolute errors for the plant `model`.
    setpoint
        Set points y_d(k), degC, shape (samples,).

    Raises
    ------
    NoReferenceError
        If `setpoint` changes before the plant has settled.
    RuntimeError
        If no solver solves a linear program within `TIME_LIMIT` seconds.
    """
    low, high = model.limits
    travel_price = price_of_travel(model, setpoint)
    flow = np.zeros(0)
    errors = np.zeros(len(setpoint))
    for start, stop in held(setpoint):
        is_last = stop == len(setpoint)
        expected_setpoint = setpoint[:stop]
        if not is_last:
            beyond = np.full(model.lag + LOOKAHEAD, setpoint[start])
            expected_setpoint = np.concatenate([expected_setpoint, beyond])
        past = flow[:start]  # without the flows that were planned for after this change
        planned = plan(model, bounds, expected_setpoint, past=past, travel_price=travel_price)
        flow = planned.flow
        errors[start:stop] = planned.errors[start:stop]
        # The range of the last lag + 1 flows before the change, t/h: the plant has settled if
        # the flow has hardly changed in the last `lag` samples.
        flow_range = np.ptp(flow[max(stop - model.lag - 1, start - 1, 0) : stop])
        is_long = stop - start >= model.lag
        has_settled = is_long and flow_range <= SETTLED_FLOW_RANGE * (high - low)
        if not (is_last or has_settled):
            raise NoReferenceError(
                "setpoint must be held until the plant has settled, "
                f"got a set point that is held for {stop - start} samples"
            )
    return Plan(errors, flow)
