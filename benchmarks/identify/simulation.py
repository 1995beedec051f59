"""Simulate a log with a model or an impulse response, and measure how much this explains."""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy import linalg, signal

from benchmarks.identify.armax import Array, Flags
from benchmarks.loop.linear import LinearModel


def held(values: Array) -> Array:
    """Return values with gaps filled from the last known value, or at first from the next."""
    return np.asarray(pd.Series(values).ffill().bfill(), np.float64)


def from_rest(model: LinearModel, flow: Array) -> Array:
    """Return the response to a flow from rest at its first value; NaN for an unstable plant."""
    if np.max(np.abs(model.poles), initial=0.0) >= 1.0:
        return np.full(len(flow), np.nan)
    known = held(flow)
    start = float(known[0])
    return model.response(known - start) + start * model.gain


def explained(output: Array, simulated: Array, rows: Flags) -> float:
    """Return the share of the variance in the given rows that a simulation explains.

    The best-fitting straight line is removed from its errors to account for slow disturbances.
    """
    known = rows & np.isfinite(output)
    if not known.any() or not np.isfinite(simulated[known]).all():
        return -np.inf
    times, error = np.flatnonzero(known), (output - simulated)[known]
    line = np.polyval(np.polyfit(times - times[0], error, 1), times - times[0])
    total = float(np.var(output[known] - line))
    return 1.0 - float(np.mean((error - line) ** 2)) / total if total else -np.inf


def of_impulse_response(inputs: list[Array], output: Array, fitted: Flags) -> Array:
    """Return the simulation by a finite impulse response with a slow tail, degC.

    60 coefficients and four slow exponentials for each input are fitted to the given rows by
    ridge regression; generalised cross-validation chooses the ridge (G. H. Golub, M. Heath and
    G. Wahba, Technometrics 21, 1979, 215-223).
    """
    lags, time_constants, columns = 60, (30.0, 60.0, 120.0, 240.0), []  # samples
    for each in map(held, inputs):
        moved = each - each[0]
        columns.append(linalg.toeplitz(moved, np.zeros(lags + 1))[:, 1:])
        for pole in np.exp(-1.0 / np.array(time_constants)):
            tail = signal.lfilter([0.0] * (lags + 1) + [1.0 - pole], [1.0, -pole], moved)
            columns.append(tail[:, np.newaxis])
    table = np.hstack(columns)
    known = fitted & np.isfinite(output)
    centre, level = table[known].mean(axis=0), output[known].mean()
    left, sizes, right = np.linalg.svd(table[known] - centre, full_matrices=False)
    target = output[known] - level
    shares = left.T @ target
    ridges = np.outer([1e-6, 1e-4, 1e-3, 1e-2, 1e-1, 1.0], sizes[0])
    kept = sizes**2 / (sizes**2 + ridges**2 + 1e-300)
    squares = np.sum((target - (kept * shares) @ left.T) ** 2, axis=1)
    scores = squares / (1.0 - kept.sum(axis=1) / len(target)) ** 2
    best = right.T @ (kept[np.argmin(scores)] * shares / np.maximum(sizes, 1e-300))
    simulated: Array = (table - centre) @ best + level
    return simulated
