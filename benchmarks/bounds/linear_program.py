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

# A response below this fraction of the largest response is left out of a program.
NEGLIGIBLE_RESPONSE = 1e-9
# A method of `scipy.optimize.linprog`, and whether HiGHS simplifies the program first. For a
# few plants the simplification fails, so the next pair is tried.
SOLVERS = ("highs-ds", True), ("highs-ds", False), ("highs-ipm", True)
TIME_LIMIT = 30.0  # s for each attempt; most programs take less than 1 s

# A plant counts as settled if its flow moves by less than this fraction of the range of the
# flow during one lag.
SETTLED = 0.05
# Samples by which a plan looks beyond the end of a hold, in addition to the lag. With more
# samples the references of the presets are the same.
TAIL = 60
# Two prices far below the price of an error, which is 1, select among equally good plans: the
# smallest slope of the error makes a plan end at the set point, and the price of each t/h of
# valve travel keeps the valve quiet.
SMALLEST_SLOPE = 0.001
TRAVEL_PRICE = 1e-4


@dataclass(frozen=True)
class Unknown:
    """Lower bounds of E|m - n|: at each k, the highest of the lines intercept + slope * |m|.

    Here m is the expected error and n what remains unknown, degC; see `unknown.py`.
    """

    slopes: Array  # ascending, from 0 to 1; or 1 alone if nothing is unknown; shape (slopes,)
    intercepts: Array  # degC, shape (samples, slopes)

    def mean_error(self, m: Array) -> Array:
        """Return the lower bounds of E|m(k) - n(k)|, degC, shape (len(m),).

        m(k), degC, are the expected errors of the first len(m) samples.
        """
        lines = self.intercepts[: len(m)] + self.slopes * np.abs(m)[:, np.newaxis]
        return np.asarray(lines.max(axis=1))

    @property
    def lengths(self) -> Array:
        """Lengths of the intervals of |m| on which each line is the highest, degC.

        The shape is that of `intercepts`. The last line is the highest up to infinity.
        """
        ends = np.full(self.intercepts.shape, np.inf)
        corners = -np.diff(self.intercepts, axis=1) / np.diff(self.slopes)
        ends[:, :-1] = np.maximum.accumulate(corners, axis=1)
        return np.diff(ends, axis=1, prepend=0.0)


def equations(model: LinearModel, samples: int) -> tuple[Any, Any]:
    """Return A and B of (28) without noise, A y = B u, for an episode from rest.

    Both are sparse matrices of shape (samples, samples), for y in degC and u in t/h.
    """
    past_outputs = _lagged(model.alpha[:samples], 1)
    past_flows = _lagged(model.beta[:samples], int(model.numbers.delay) + 1)
    return (scipy.sparse.eye_array(samples) - past_outputs).tocsr(), past_flows


def _lagged(coefficients: Array, lag: int) -> Any:
    """Return a sparse square matrix with coefficients[k, i] in row k, column k - lag - i."""
    samples, order = coefficients.shape
    diagonals = coefficients.T, lag + np.arange(order)
    return scipy.sparse.dia_array(diagonals, shape=(samples, samples)).T.tocsr()


def response(A: Any, B: Any) -> Array:
    """Return G, which solves A G = B: a flow of 1 t/h at j adds G[k, j] degC to y(k)."""
    return np.asarray(scipy.linalg.solve_triangular(A.toarray(), B.toarray(), lower=True))


class Plan(NamedTuple):
    """The expected flow with the smallest bound, and this bound."""

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
    """Minimise the sum of the bounds of E|e(k)| over the mean flow.

    Take any controller, causal or not, and let y and u_a stand for their means over all noise,
    load and randomness of the controller. As (28) is linear, the means obey (28) without noise;
    as u_a(k) always lies within the limits, so does its mean; and as E|m - n| is convex in m,
    its mean over everything that may be known is at least its value at the mean of m, which is
    y_d - y (Jensen). So the controller's error is at least the minimum over all mean flows
    within the limits: a linear program, as each bound of E|m - n| is a maximum of lines.

    The bound is loose where the required flow lies within the dead zone, or alternates between
    the two sides of a limit: the mean of 0 and 5 t/h is 2.5 t/h.

    Parameters
    ----------
    model
        The plant, for at least as many samples as `setpoint` has.
    unknown
        The bounds of E|m - n| for this plant.
    setpoint
        y_d(k), degC, shape (samples,).
    past
        The flows at k = 0, 1, ... that are already decided, t/h, shape (start,).
    quiet
        Whether to take, of equally good plans, the one that comes to the set point with the
        least valve travel.
    penalty
        A price of u_a(k), degC for each t/h, of shape (samples,) or the same for all samples.

    Raises
    ------
    RuntimeError
        If no solver solves the program within `TIME_LIMIT`.
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
    """Variables of a linear program, each array of shape (variables,)."""

    cost: Array
    low: Array
    high: Array


def _variables(count: int, cost: Any, low: Any, high: Any) -> _Variables:
    """Return `count` variables; a cost or an end is an array or the same for all of them."""
    return _Variables(*(np.broadcast_to(values, count) for values in (cost, low, high)))


class _Program(NamedTuple):
    """The linear program of `plan` over n samples.

    The outputs y and the flows u obey A y = B u. The first n targets are set points minus the
    effect of past flows: target k is output k, plus the pieces of m(k) above 0, minus the
    pieces below 0. A quiet plan has n more targets: the target is flow k minus flow k - 1,
    minus the move up, plus the move down. It is 0 but for the first flow, which moves from the
    last past flow.
    """

    A: Any  # sparse, shape (n, n)
    B: Any  # sparse, shape (n, n)
    targets: Array  # shape (n,), or (2 n,) of a quiet plan
    outputs: _Variables  # degC, shape (n,)
    flows: _Variables  # t/h, shape (n,)
    pieces: _Variables  # of m, degC: for each slope n above 0 and n below 0
    moves: _Variables  # t/h: n up and n down in a quiet plan, otherwise none


def _solve(program: _Program, zeros: NDArray[Any]) -> Array:
    """Return the flows of the least cost, t/h, shape (n,). `zeros` are those of B in (28)."""
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
    """Return a matrix and the right side: the matrix times all variables is the right side.

    Without outputs among the variables, an output is the sum of the effects of the flows.
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

    Where set points have no law (a square wave, a list), the only bound is the one with
    preview: for one given sequence any controller may have the times of the changes built in.
    The reference holds under a condition. At each change the controller takes, from where it
    is, the flow that is best if the new set point stays. If the plant has settled by the next
    change, each change costs the least that is possible without preview; see `plan`.

    `setpoint` is y_d(k), degC, shape (samples,). The model covers `model.lag + TAIL` samples
    more. A `NoBoundError` is raised if the plant has not settled at a change.
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
