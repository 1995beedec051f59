"""Fits (28) by least squares: prediction errors of an ARMAX model."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize, signal

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

# The largest root of C beyond which xi is not to be recovered, and the largest magnitude of
# other roots: nearer to the unit circle, they cancel poles that fit a log by chance.
LARGEST, LARGEST_OTHER = 0.998, 0.8


@dataclass(frozen=True)
class Orders:
    """How many coefficients A, B and C have, without the leading 1 of A and C.

    With `walk`, a random walk is added to the noise. As an innovation, the sum of both is
    C' xi / (1 - z^-1), where C' has one coefficient more than C.
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
        """Number of coefficients, with the constant."""
        return self.a + self.b + self.noise + 1


def invertible(c: Array) -> bool:
    """Return whether the roots of C leave xi to be recovered."""
    roots = np.roots([1.0, *c])
    slow = (np.abs(roots.imag) < 1e-3) & (roots.real > 0.0)
    return bool(np.all(np.abs(roots) <= np.where(slow, LARGEST, LARGEST_OTHER)))


@dataclass(frozen=True)
class Solution:
    """What minimises the sum of squares of the prediction errors.

    Attributes
    ----------
    linear
        Coefficients of the regressors.
    c
        C, or C' with a walk, from z^-1 on.
    errors
        The prediction errors xi, one a row that counts.
    """

    linear: Array
    c: Array
    errors: Array

    @property
    def square(self) -> float:
        """Sum of squares of the errors."""
        return float(self.errors @ self.errors)


class Rows:
    """The rows of a log in which everything is known that (28) needs.

    Parameters
    ----------
    known
        Which rows k to predict, shape (samples,).
    counted
        Which of them to count: the others are bridges, with temperatures that were filled in.
    """

    def __init__(self, known: Flags, counted: Flags | None = None) -> None:
        self.index = np.flatnonzero(known)
        self.counts = np.ones(len(self.index), bool) if counted is None else counted[known]
        # Stretches without a gap: the recursion for xi starts anew in each.
        breaks = np.flatnonzero(np.diff(self.index) > 1) + 1
        bounds = [0, *breaks.tolist(), len(self.index)]
        self._stretches = list(itertools.pairwise(bounds))

    def __len__(self) -> int:
        return int(self.counts.sum())

    @property
    def counted(self) -> NDArray[np.intp]:
        """Which rows of the log count."""
        return self.index[self.counts]

    def lagged(self, values: Array, lags: Sequence[int]) -> Array:
        """Return a column for each lag, shape (rows, lags)."""
        return values[self.index[:, np.newaxis] - np.array(lags, dtype=np.intp)]

    def levels(self, orders: Orders) -> Array:
        """Return the columns of what is constant: one, or with a walk one a stretch."""
        if not orders.walk:
            return np.ones((len(self.index), 1))
        # The walk starts from the first row of a stretch, and from there at an unknown level.
        longest = sorted(self._stretches, key=lambda ends: ends[0] - ends[1])[:12]
        columns = np.zeros((len(self.index), len(longest)))
        for i, (start, stop) in enumerate(longest):
            columns[start + 1 : stop, i] = 1.0
        return columns

    def whitened(self, columns: Array, c: Array, *, walk: bool = False) -> Array:
        """Return the columns divided by C, and with a walk differenced, in all rows."""
        denominator = np.concatenate([[1.0], c])
        parts = []
        for start, stop in self._stretches:
            part = columns[start:stop]
            if walk:
                part = np.diff(part, axis=0, prepend=part[:1])
            parts.append(signal.lfilter([1.0], denominator, part, axis=0) if len(c) else part)
        return np.concatenate(parts) if parts else columns

    def _later(self, values: Array, order: int) -> Array:
        """Return values moved back by 1 to `order` rows, 0 where a stretch begins."""
        lags = np.zeros((len(values), order))
        for i in range(order):
            for begin, end in self._stretches:
                lags[begin + i + 1 : end, i] = values[begin : max(end - i - 1, begin)]
        return lags

    def solve(
        self,
        target: Array,
        regressors: Array,
        order: int,
        start: Array | None = None,
        *,
        walk: bool = False,
    ) -> Solution:
        """Minimise the squares of xi = (target - regressors @ linear) / C over linear and C.

        For a given C the problem is linear, so that only C is searched: variable projection
        (G. H. Golub and V. Pereyra, SIAM Journal on Numerical Analysis 10, 1973, 413-432), with
        L. Kaufman's approximation of the Jacobian (BIT 15, 1975, 49-57).

        Parameters
        ----------
        target
            Shape (rows,).
        regressors
            Shape (rows, n).
        order
            Of C, or of C' with a walk.
        start
            C from z^-1 on, to search from.
        walk
            Whether a random walk is part of the noise.
        """
        columns = np.column_stack([target, regressors])
        latest: dict[bytes, tuple[Array, Array, Array]] = {}  # the search asks twice

        def project(c: Array) -> tuple[Array, Array, Array]:
            key = c.tobytes()
            if key not in latest:
                latest.clear()
                white = self.whitened(columns, c, walk=walk)
                basis, triangle = np.linalg.qr(white[self.counts, 1:])
                shares = basis.T @ white[self.counts, 0]
                linear = np.linalg.lstsq(triangle, shares, rcond=None)[0]
                latest[key] = white[:, 0] - white[:, 1:] @ linear, basis, linear
            return latest[key]

        def residuals(c: Array) -> Array:
            if not invertible(c):
                return np.full(len(self), np.inf)
            return project(c)[0][self.counts]

        def jacobian(c: Array) -> Array:
            errors, basis, _ = project(c)
            slopes = self._later(-self.whitened(errors, c), order)[self.counts]
            projected: Array = slopes - basis @ (basis.T @ slopes)
            return projected

        c = np.zeros(0)
        if order:
            first = np.zeros(order)
            if start is not None:
                first[: len(start)] = start[:order]
                if not invertible(first):  # a part of an invertible C need not be
                    first[:] = 0.0
            if walk and not first.any():
                first[0] = -0.7
            found = optimize.least_squares(
                residuals, first, jacobian, method="trf", ftol=1e-7, xtol=1e-5, max_nfev=30
            )
            c = np.asarray(found.x)
        errors, _, linear = project(c)
        return Solution(linear, c, errors[self.counts])

    def covariance(
        self, target: Array, regressors: Array, solution: Solution, *, walk: bool
    ) -> Array:
        """Return the covariance of `linear` and C, from the curvature of the likelihood."""
        white = self.whitened(regressors, solution.c, walk=walk)
        left = self.whitened(target, solution.c, walk=walk) - white @ solution.linear
        slopes = self._later(self.whitened(left, solution.c), len(solution.c))
        jacobian = np.hstack([white, slopes])[self.counts]
        scale = np.linalg.norm(jacobian, axis=0)
        scale[scale == 0.0] = 1.0  # of a flow that never leaves a dead zone
        information = (jacobian / scale).T @ (jacobian / scale)
        variance = solution.square / max(len(self) - jacobian.shape[1], 1)
        spread: Array = variance * linalg.pinvh(information) / np.outer(scale, scale)
        return spread
