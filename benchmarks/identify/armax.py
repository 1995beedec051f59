"""Least squares for (28): prediction errors of an ARMAX model with a delay."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, signal

Array = NDArray[np.float64]

INVERTIBLE = 0.995  # the largest magnitude of a root of C: beyond, xi is not to be recovered


@dataclass(frozen=True)
class Orders:
    """How many coefficients A, B and C have, without the leading 1 of A and C."""

    a: int
    b: int
    c: int

    @property
    def count(self) -> int:
        """Number of coefficients, with the constant."""
        return self.a + self.b + self.c + 1


@dataclass(frozen=True)
class Solution:
    """What minimises the sum of squares of the prediction errors.

    Attributes
    ----------
    linear
        Coefficients of the regressors.
    c
        C from z^-1 on.
    errors
        The prediction errors xi, one a row.
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
    """

    def __init__(self, known: NDArray[np.bool_]) -> None:
        self.index = np.flatnonzero(known)
        # Stretches without a gap: the recursion for xi starts anew in each.
        breaks = np.flatnonzero(np.diff(self.index) > 1) + 1
        bounds = [0, *breaks.tolist(), len(self.index)]
        self._stretches = list(itertools.pairwise(bounds))

    def __len__(self) -> int:
        return len(self.index)

    def lagged(self, values: Array, lags: Sequence[int]) -> Array:
        """Return a column for each lag, shape (rows, lags)."""
        return values[self.index[:, np.newaxis] - np.array(lags, dtype=np.intp)]

    def whitened(self, columns: Array, c: Array) -> Array:
        """Return the columns divided by C."""
        if not len(c):
            return columns
        denominator = np.concatenate([[1.0], c])
        if len(self._stretches) == 1:
            result: Array = signal.lfilter([1.0], denominator, columns, axis=0)
            return result
        parts = [
            signal.lfilter([1.0], denominator, columns[start:stop], axis=0)
            for start, stop in self._stretches
        ]
        return np.concatenate(parts)

    def solve(
        self, target: Array, regressors: Array, order: int, start: Array | None = None
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
            Of C.
        start
            C from z^-1 on, to search from.
        """
        columns = np.column_stack([target, regressors])

        latest: dict[bytes, tuple[Array, Array, Array]] = {}  # the search asks twice

        def project(c: Array) -> tuple[Array, Array, Array]:
            key = c.tobytes()
            if key in latest:
                return latest[key]
            latest.clear()
            white = self.whitened(columns, c)
            basis, triangle = np.linalg.qr(white[:, 1:])
            shares = basis.T @ white[:, 0]
            errors = white[:, 0] - basis @ shares
            linear = np.linalg.lstsq(triangle, shares, rcond=None)[0]
            latest[key] = errors, basis, linear
            return latest[key]

        def invertible(c: Array) -> bool:
            return bool(np.max(np.abs(np.roots([1.0, *c])), initial=0.0) <= INVERTIBLE)

        def residuals(c: Array) -> Array:
            return project(c)[0] if invertible(c) else np.full(len(target), np.inf)

        def jacobian(c: Array) -> Array:
            errors, basis, _ = project(c)
            slope = -self.whitened(errors[:, np.newaxis], c)
            lags = np.zeros((len(errors), order))
            for i in range(order):
                for begin, end in self._stretches:
                    lags[begin + i + 1 : end, i] = slope[begin : end - i - 1, 0]
            projected: Array = lags - basis @ (basis.T @ lags)
            return projected

        c = np.zeros(0)
        if order:
            first = np.zeros(order)
            if start is not None:
                first[: len(start)] = start[:order]
                if not invertible(first):  # a part of an invertible C need not be
                    first[:] = 0.0
            found = optimize.least_squares(
                residuals, first, jacobian, method="trf", ftol=1e-7, xtol=1e-6, max_nfev=40
            )
            c = np.asarray(found.x)
        errors, _, linear = project(c)
        return Solution(linear, c, errors)
