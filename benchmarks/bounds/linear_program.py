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

NOTHING = 1e-9  # fraction of the largest response below which a response is left out
# Method, and whether HiGHS simplifies the program first, which fails for a few plants.
SOLVERS = ("highs-ds", True), ("highs-ds", False), ("highs-ipm", True)
TIME_LIMIT = 30.0  # s for each attempt; most programs take less than 1 s

# For a reference.
SETTLED = 0.05  # fraction of the flow's range that a settled flow may move within the lag
# Samples that a plan looks beyond the end of a hold, in addition to the lag: with more, the
# references of the presets are the same.
TAIL = 60
# Two prices far below that of an error, which is 1, select among equally good plans: the least
# slope of the error makes them end at the set point, the price of travel, per t/h, keeps the
# valve quiet.
LEVEL = 0.001
SMOOTH = 1e-4


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
    past_outputs, past_flows = (
        # Row k has coefficients[k, i] in column k - lag - i.
        scipy.sparse.dia_array(
            (coefficients[:samples].T, lag + np.arange(coefficients.shape[1])),
            shape=(samples, samples),
        ).T.tocsr()
        for coefficients, lag in zip((model.alpha, model.beta), lags, strict=True)
    )
    return (scipy.sparse.eye_array(samples) - past_outputs).tocsr(), past_flows


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
        targets = np.zeros(n + n * quiet)
        targets[:n] = (setpoint - idle)[start + 1 :]
        targets[n : n + 1] = flow[start - 1]  # which the moves start from: 0 at the beginning
        program = _Program(
            A=A[start + 1 :, start + 1 :],
            B=B[start + 1 :, start:-1],
            targets=targets,
            outputs=_Variables.of(n, 0.0, -np.inf, np.inf),
            flows=_Variables.of(n, price[start:-1], *model.limits),
            pieces=_Variables.of(len(lengths), np.repeat(slopes, 2 * n), 0.0, lengths),
            moves=_Variables.of(2 * n * quiet, SMOOTH, 0.0, np.inf),
        )
        flow[start:-1] = _solve(program, zeros=np.roots(model.parameters.b))
    # The last flow affects no output; if it does not move, it costs nothing either.
    flow[-1] = flow[-2] if samples > 1 else 0.0
    output = scipy.sparse.linalg.spsolve_triangular(A, B @ flow)
    return unknown.mean_error(setpoint - output), flow


class _Variables(NamedTuple):
    """Variables of a linear program, each array of shape (variables,)."""

    cost: Array
    low: Array
    high: Array

    @classmethod
    def of(cls, count: int, cost: Any, low: Any, high: Any) -> "_Variables":
        """Return `count` variables, whose costs and ends are arrays or hold for all."""
        return cls(*(np.broadcast_to(values, count) for values in (cost, low, high)))


class _Program(NamedTuple):
    """The linear program of `plan` over n samples.

    The outputs y and the flows u obey A y = B u. Each target is a sum: the first n, set points
    without the effect of past flows, are an output plus the pieces of m above 0 minus those
    below 0. In a quiet plan n further targets are a move of the flow minus the moves up plus
    the moves down.
    """

    A: Any  # sparse, shape (n, n)
    B: Any  # sparse, shape (n, n)
    targets: Array  # shape (n,), or (2 n,) of a quiet plan
    outputs: _Variables  # degC
    flows: _Variables  # t/h
    pieces: _Variables  # of m, degC: for each slope n above 0 and n below
    moves: _Variables  # of a quiet plan, t/h: n up and n down


class _Form(NamedTuple):
    """A program as solvers take it: `matrix` times all variables is `right`."""

    matrix: Any  # sparse, shape (equations, variables)
    right: Array  # shape (equations,)
    variables: Sequence[_Variables]
    first_flow: int  # place of the first flow among the variables


def _solve(program: _Program, zeros: NDArray[Any]) -> Array:
    """Return the flows of the least cost, t/h, shape (n,). `zeros` are those of B in (28)."""
    forms = [_with_outputs, _with_flows_alone]
    # With outputs among the variables the program is sparse, and fast where A is slow. But if
    # a zero of B lies outside the unit circle, the flow that gives an output grows without
    # bound: solvers that vary outputs freely fail, or end away from the optimum.
    if np.any(np.abs(zeros) > 1.0):
        forms.reverse()
    for make_form in forms:
        form = make_form(program)
        cost, low, high = np.hstack(form.variables)
        for method, presolve in SOLVERS:
            solution = scipy.optimize.linprog(
                cost,
                A_eq=form.matrix,
                b_eq=form.right,
                bounds=np.column_stack([low, high]),
                method=method,
                options={"time_limit": TIME_LIMIT, "presolve": presolve},
            )
            if solution.success:
                end = form.first_flow + len(program.flows.cost)
                flows: Array = solution.x[form.first_flow : end]
                return flows
    raise RuntimeError(
        f"the linear program of {program.A.shape[0]} samples was not solved in any of "
        f"{len(forms) * len(SOLVERS)} ways: {solution.message}"
    )


def _with_outputs(program: _Program) -> _Form:
    """Return the form in which the outputs are variables."""
    n = program.A.shape[0]
    of_outputs, of_flows, of_pieces = _target_matrices(program)
    blocks: Any = [[program.A, -program.B, None], [of_outputs, of_flows, of_pieces]]
    return _Form(
        matrix=scipy.sparse.block_array(blocks).tocsc(),
        right=np.concatenate([np.zeros(n), program.targets]),
        variables=[program.outputs, program.flows, program.pieces, program.moves],
        first_flow=n,
    )


def _with_flows_alone(program: _Program) -> _Form:
    """Return the form in which each output is the sum of the effects of the flows."""
    of_outputs, of_flows, of_pieces = _target_matrices(program)
    G = response(program.A, program.B)
    G[np.abs(G) < NOTHING * np.abs(G).max(initial=0.0)] = 0.0
    blocks: Any = [[of_outputs @ scipy.sparse.csr_array(G) + of_flows, of_pieces]]
    return _Form(
        matrix=scipy.sparse.block_array(blocks).tocsc(),
        right=program.targets,
        variables=[program.flows, program.pieces, program.moves],
        first_flow=0,
    )


def _target_matrices(program: _Program) -> tuple[Any, Any, Any]:
    """Return what outputs, flows, and pieces with moves contribute to the targets."""
    n = program.A.shape[0]
    rows = len(program.targets)
    eye = scipy.sparse.eye_array(n)
    slopes = len(program.pieces.cost) // (2 * n)
    of_pieces = scipy.sparse.hstack([eye, -eye] * slopes)
    if len(program.moves.cost):
        of_pieces = scipy.sparse.block_diag([of_pieces, scipy.sparse.hstack([-eye, eye])])
    of_outputs = scipy.sparse.eye_array(rows, n)
    differences = eye - scipy.sparse.eye_array(n, k=-1)
    of_flows = scipy.sparse.eye_array(rows, n, k=-n, format="csr") @ differences
    return of_outputs, of_flows, of_pieces


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
        error_of_hold, flow = plan(model, unknown, ahead, past=flow[:start], quiet=True)
        error[start:stop] = error_of_hold[start:stop]
        moving = np.ptp(flow[max(stop - model.lag - 1, start - 1, 0) : stop])
        if not last and (stop - start < model.lag or moving > SETTLED * (high - low)):
            raise NoBoundError(
                "setpoint must be held until the plant has settled, or there is no reference; "
                f"got a hold of {stop - start} samples"
            )
    return error, flow
