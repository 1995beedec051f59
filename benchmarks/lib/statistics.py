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
    """A value with its 95 % confidence interval from `low` to `high`, from `runs` runs."""

    value: float
    low: float
    high: float
    runs: int

    def scaled(self, factor: float) -> "Estimate":
        """Return this estimate, and both ends of its interval, times a positive factor."""
        return Estimate(factor * self.value, factor * self.low, factor * self.high, self.runs)

    def __format__(self, form: str) -> str:
        """Return "value (low to high)"; the value alone if nothing was random."""
        value = written(self.value, form)
        low = written(self.low, form)
        high = written(self.high, form)
        if math.isinf(self.high):
            return f"{value} (one run)"
        if low == high:
            return value
        return f"{value} ({low} to {high})"


def written(value: float, form: str) -> str:
    """Return a number as text in a format, but never -0."""
    text = format(value, form)
    if set(text) <= set("-0."):
        return text.lstrip("-")
    return text


def student(values: ArrayLike) -> Estimate:
    """Estimate the mean over runs, shape (runs,), with Student's t interval.

    A single run, or equal values, give an interval of zero width.
    """
    numbers = np.asarray(values, dtype=np.float64)
    mean = float(numbers.mean())
    runs = len(numbers)
    if runs < 2 or np.ptp(numbers) == 0.0:
        return Estimate(mean, mean, mean, runs)
    standard_error = float(numbers.std(ddof=1)) / math.sqrt(runs)
    # The quantile of scipy.stats.t, which takes long to import.
    half_width = float(scipy.special.stdtrit(runs - 1, ENDS[1])) * standard_error
    return Estimate(mean, mean - half_width, mean + half_width, runs)


def quantile(values: ArrayLike, probability: float) -> Estimate:
    """Estimate a quantile over runs, shape (runs,).

    The interval of `scipy.stats.quantile_test` is used. Its ends are two of the ordered values,
    or infinite if there are too few runs. It assumes nothing about their distribution.
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64))
    value = percentiles(ordered, value=100.0 * probability)["value"]
    interval = scipy.stats.quantile_test(ordered, p=probability).confidence_interval()
    low = float(interval.low)
    if math.isnan(low):
        low = -math.inf
    high = float(interval.high)
    if math.isnan(high):
        high = math.inf
    return Estimate(float(value), low, high, len(ordered))


def share(happened: NDArray[np.bool_]) -> Estimate:
    """Estimate the share of runs in which something happened, with Wilson's interval."""
    count = int(happened.sum())
    runs = len(happened)
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
    all_values = np.concatenate([table.ravel() for table in tables])
    mean = float(all_values.mean())
    if all(np.ptp(table) == 0.0 for table in tables):  # nothing was random
        return Estimate(mean, mean, mean, all_values.size)
    generator = np.random.default_rng(seed)
    members, runs = tables[0].shape
    resamples = []
    for table in tables:
        member_indices = generator.integers(members, size=(RESAMPLES, members, 1))
        run_indices = generator.integers(runs, size=(RESAMPLES, 1, runs))
        resamples.append(table[member_indices, run_indices].reshape(RESAMPLES, -1))
    low, high = np.quantile(np.hstack(resamples).mean(axis=-1), ENDS)
    return Estimate(mean, float(low), float(high), all_values.size)


def percentiles(
    values: NDArray[np.float64], method: Any = "linear", **percents: float
) -> dict[str, Any]:
    """Return percentiles along the last axis, by the names that they are given.

    By default they are `median`, `p10` and `p90`. `method` is that of `numpy.percentile`, for
    finite values. Infinite values, such as the time of a run that never settles, cannot be
    interpolated: then the next higher value is used.
    """
    if not np.isfinite(values).all():
        method = "higher"
    percents = percents or {"median": 50, "p10": 10, "p90": 90}
    return {
        name: np.percentile(values, percent, axis=-1, method=method)
        for name, percent in percents.items()
    }
