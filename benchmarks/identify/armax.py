"""Fit (28), an ARMAX model, by least squares on its prediction errors."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize, signal

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Orders:
    """Number of coefficients of A, B and C, without the leading 1 of A and C.

    With `walk`, a random walk is added to the noise. In innovation form, the sum of both is
    C' xi / (1 - z^-1), where C' has one more coefficient than C.
    """

    a: int
    b: int
    c: int
    walk: bool = False

    @property
    def noise(self) -> int:
        """Number of coefficients of C, or of C' with a walk."""
        return self.c + self.walk

    @property
    def count(self) -> int:
        """Number of all coefficients, including the constant."""
        return self.a + self.b + self.noise + 1


def invertible(c: Array) -> bool:
    """Return whether the roots of C allow xi to be recovered.

    Roots near the unit circle cancel poles that fit a log by chance, but for a slow real one.
    """
    roots = np.roots([1.0, *c])
    slow = (np.abs(roots.imag) < 1e-3) & (roots.real > 0.0)
    return bool(np.all(np.abs(roots) <= np.where(slow, 0.998, 0.8)))


class Rows:
    """The rows k of a log in which everything that (28) needs is known.

    Some `known` rows are not `counted`: those that need temperatures that were filled in.
    """

    def __init__(self, known: Flags, counted: Flags) -> None:
        self.index = np.flatnonzero(known)
        self.counts = counted[known]
        # Stretches without a gap: the recursion for xi restarts in each.
        breaks = np.flatnonzero(np.diff(self.index) > 1) + 1
        self._stretches = list(itertools.pairwise([0, *breaks.tolist(), len(self.index)]))

    def __len__(self) -> int:
        return int(self.counts.sum())

    def lagged(self, values: Array, lags: Sequence[int]) -> Array:
        """Return a column for each lag, shape (rows, lags)."""
        return values[self.index[:, np.newaxis] - np.array(lags, dtype=np.intp)]

    def levels(self, orders: Orders) -> Array:
        """Return the columns for the level: one, or with a walk one per long stretch."""
        if not orders.walk:
            return np.ones((len(self.index), 1))
        # The walk restarts in the first row of a stretch, at an unknown level from the next on.
        longest = sorted(self._stretches, key=lambda ends: ends[0] - ends[1])[:12]
        columns = np.zeros((len(self.index), len(longest)))
        for i, (start, stop) in enumerate(longest):
            columns[start + 1 : stop, i] = 1.0
        return columns

    def whitened(self, columns: Array, c: Array, walk: bool = False) -> Array:
        """Return the columns filtered by 1 / C, and differenced with a walk, in all rows."""
        parts = []
        for start, stop in self._stretches:
            part = columns[start:stop]
            if walk:
                part = np.diff(part, axis=0, prepend=part[:1])
            parts.append(signal.lfilter([1.0], [1.0, *c], part, axis=0) if len(c) else part)
        return np.concatenate(parts)

    def square(self, errors: Array) -> float:
        """Return the sum of squared errors over the counted rows."""
        counted = errors[self.counts]
        return float(counted @ counted)

    def _slopes(self, errors: Array, c: Array) -> Array:
        """Return the negative derivatives of the errors by the coefficients of C."""
        white, slopes = self.whitened(errors, c), np.zeros((len(errors), len(c)))
        for lag, (start, stop) in itertools.product(range(1, len(c) + 1), self._stretches):
            slopes[start + lag : stop, lag - 1] = white[start : max(stop - lag, start)]
        return slopes

    def solve(
        self, table: Array, orders: Orders, start: Array | None = None
    ) -> tuple[Array, Array, Array]:
        """Return the coefficients of the regressors, C from z^-1 on, and xi in all rows.

        They minimise the sum of squares of xi = (target - regressors @ linear) / C. For a given
        C the problem is linear, so only C is searched: variable projection (G. H. Golub and V.
        Pereyra, SIAM Journal on Numerical Analysis 10, 1973, 413-432), with L. Kaufman's
        approximation of the Jacobian (BIT 15, 1975, 49-57).

        The table holds the target and the regressors, shape (rows, 1 + n). The search begins
        at `start`, padded with zeros.
        """

        @lru_cache(maxsize=1)  # the search needs each C twice
        def project(c: tuple[float, ...]) -> tuple[Array, Array, Array]:
            white = self.whitened(table, np.array(c), orders.walk)
            basis, triangle = np.linalg.qr(white[self.counts, 1:])
            shares = basis.T @ white[self.counts, 0]
            linear = np.linalg.lstsq(triangle, shares, rcond=None)[0]
            return white[:, 0] - white[:, 1:] @ linear, basis, linear

        def residuals(c: Array) -> Array:
            if not invertible(c):
                return np.full(len(self), np.inf)
            return project(tuple(c))[0][self.counts]

        def jacobian(c: Array) -> Array:
            errors, basis, _ = project(tuple(c))
            slopes = -self._slopes(errors, c)[self.counts]
            projected: Array = slopes - basis @ (basis.T @ slopes)
            return projected

        c = np.zeros(orders.noise)
        if len(c):
            if start is not None and invertible(start[: len(c)]):  # a part of C may not be
                c[: len(start)] = start[: len(c)]
            if orders.walk and not c.any():
                c[0] = -0.7
            c = optimize.least_squares(
                residuals, c, jacobian, method="trf", ftol=1e-7, xtol=1e-5, max_nfev=30
            ).x
        errors, _, linear = project(tuple(c))
        return linear, c, errors

    def covariance(self, table: Array, orders: Orders, c: Array, errors: Array) -> Array:
        """Return the covariance of `linear`, from the curvature of the likelihood."""
        white = self.whitened(table[:, 1:], c, orders.walk)
        jacobian = np.hstack([white, self._slopes(errors, c)])[self.counts]
        scale = np.linalg.norm(jacobian, axis=0)
        scale[scale == 0.0] = 1.0  # a flow that never leaves a dead zone
        information = (jacobian / scale).T @ (jacobian / scale)
        variance = self.square(errors) / max(len(self) - jacobian.shape[1], 1)
        spread = variance * linalg.pinvh(information) / np.outer(scale, scale)
        of_linear: Array = spread[: white.shape[1], : white.shape[1]]
        return of_linear
