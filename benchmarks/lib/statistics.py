"""Estimate quantities from several runs, with 95 % confidence intervals, and percentiles."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # loads its modules on first use
from numpy.typing import ArrayLike, NDArray

ENDS = 0.025, 0.975  # quantiles at the ends of an interval; 95 % is SciPy's default, too
RESAMPLES = 2000  # bootstrap resamples


@dataclass(frozen=True)
class Estimate:
    """A value with its confidence interval, estimated from `runs` runs."""

    value: float
    low: float
    high: float
    runs: int

    def scaled(self, factor: float) -> "Estimate":
        """Return the estimate of a positive multiple."""
        return Estimate(factor * self.value, factor * self.low, factor * self.high, self.runs)

    def __format__(self, form: str) -> str:
        """Return `value (low to high)`; the value alone if nothing was random."""
        value, low, high = (written(end, form) for end in (self.value, self.low, self.high))
        if math.isinf(self.high):
            return f"{value} (one run)"
        return value if low == high else f"{value} ({low} to {high})"


def written(value: float, form: str) -> str:
    """Return a number as text, but never -0."""
    text = format(value, form)
    return text.lstrip("-") if set(text) <= set("-0.") else text


def student(values: ArrayLike) -> Estimate:
    """Estimate the mean over runs, shape (runs,), with Student's t interval.

    A single run, or equal values, give an interval of zero width.
    """
    numbers = np.asarray(values, dtype=np.float64)
    mean, runs = float(numbers.mean()), len(numbers)
    if runs < 2 or np.ptp(numbers) == 0.0:
        return Estimate(mean, mean, mean, runs)
    error = float(numbers.std(ddof=1)) / math.sqrt(runs)
    # That of scipy.stats.t, which takes long to import.
    half = float(scipy.special.stdtrit(runs - 1, ENDS[1])) * error
    return Estimate(mean, mean - half, mean + half, runs)


def quantile(values: ArrayLike, probability: float) -> Estimate:
    """Estimate a quantile over runs, shape (runs,).

    The interval, that of `scipy.stats.quantile_test`, lies between two of the ordered values.
    It assumes nothing about their distribution, and is infinite where there are too few runs.
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64))
    interval = scipy.stats.quantile_test(ordered, p=probability).confidence_interval()
    low = -np.inf if np.isnan(interval.low) else interval.low
    high = np.inf if np.isnan(interval.high) else interval.high
    value = percentiles(ordered, value=100.0 * probability)["value"]
    return Estimate(float(value), float(low), float(high), len(ordered))


def share(happened: NDArray[np.bool_]) -> Estimate:
    """Estimate the share of runs in which something happens, with Wilson's interval."""
    count, runs = int(happened.sum()), len(happened)
    interval = scipy.stats.binomtest(count, runs).proportion_ci(method="wilson")
    return Estimate(count / runs, float(interval.low), float(interval.high), runs)


def bootstrap(*tasks: NDArray[np.float64], seed: int) -> Estimate:
    """Estimate the mean over the runs of one or more tasks, by a percentile bootstrap.

    Tasks have the same shape: (runs,), or (members, runs) for several trained controllers in
    the same runs. Members share the noise of a run, so members and runs are resampled
    independently, and a resample takes every crossing of the two (A. B. Owen, "The pigeonhole
    bootstrap", Annals of Applied Statistics 1, 2007, 386-411). With only five members that
    differ far more than runs do, its coverage is 82 %.
    """
    tables = [np.atleast_2d(np.asarray(task, dtype=np.float64)) for task in tasks]
    together = np.concatenate([table.ravel() for table in tables])
    value = float(together.mean())
    if all(np.ptp(table) == 0.0 for table in tables):  # nothing was random
        return Estimate(value, value, value, together.size)
    generator = np.random.default_rng(seed)
    members, runs = tables[0].shape
    samples = []
    for table in tables:
        member = generator.integers(members, size=(RESAMPLES, members, 1))
        run = generator.integers(runs, size=(RESAMPLES, 1, runs))
        samples.append(table[member, run].reshape(RESAMPLES, -1))
    low, high = np.quantile(np.hstack(samples).mean(axis=-1), ENDS)
    return Estimate(value, float(low), float(high), together.size)


def percentiles(
    values: NDArray[np.float64], method: Any = "linear", **named: float
) -> dict[str, Any]:
    """Return percentiles along the last axis, by default the median, the 10th and the 90th.

    Infinite values ("not settled") cannot be interpolated: the next higher value is used.
    """
    method = method if np.isfinite(values).all() else "higher"
    named = named or {"median": 50, "p10": 10, "p90": 90}
    return {n: np.percentile(values, at, axis=-1, method=method) for n, at in named.items()}
