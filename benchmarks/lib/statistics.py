"""Estimate quantities from several runs: means, shares and quantiles with their intervals."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # SciPy loads its modules on first use.
from numpy.typing import ArrayLike, NDArray

ENDS = 0.025, 0.975  # quantiles at the ends of a 95 % interval, as in SciPy
RESAMPLES = 2000  # of a bootstrap


@dataclass(frozen=True)
class Estimate:
    """A value with its 95 % confidence interval from `low` to `high`, from a number of runs."""

    value: float
    low: float
    high: float
    runs: int

    def scaled(self, factor: float) -> "Estimate":
        """Return the estimate with its value and both ends times a positive factor."""
        return Estimate(factor * self.value, factor * self.low, factor * self.high, self.runs)

    def __format__(self, form: str) -> str:
        """Return "value (low to high)" in a format; the value alone if the ends are equal.

        An interval without an upper end is written as "value (one run)".
        """
        value = written(self.value, form)
        low = written(self.low, form)
        high = written(self.high, form)
        if math.isinf(self.high):
            return f"{value} (one run)"
        if low == high:
            return value
        return f"{value} ({low} to {high})"


def written(value: float, form: str) -> str:
    """Return a number as text in a format, without the sign of a -0."""
    text = format(value, form)
    if set(text) <= set("-0."):
        return text.lstrip("-")
    return text


def student(values: ArrayLike) -> Estimate:
    """Estimate the mean of values, one a run, with the interval of Student's t distribution.

    The interval of a single value, or of equal values, has zero width.
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
    """Estimate a quantile of values, one a run.

    The interval is that of `scipy.stats.quantile_test`. The ends of the interval are two of the
    ordered values, or infinite if there are too few runs. The interval assumes nothing about
    the distribution of the values.
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
    """Estimate the share of runs in which an event happened, with Wilson's interval.

    `happened` tells for each run whether the event happened, shape (runs,).
    """
    count = int(happened.sum())
    runs = len(happened)
    interval = scipy.stats.binomtest(count, runs).proportion_ci(method="wilson")
    return Estimate(count / runs, float(interval.low), float(interval.high), runs)


def bootstrap(*tasks: NDArray[np.float64], seed: int) -> Estimate:
    """Estimate the mean of values over tasks, members and runs, by a percentile bootstrap.

    Each task is an array of values of the same shape: (runs,), or (members, runs) for several
    trained networks in the same runs. Tasks are not resampled. The members share the noise of a
    run, so members and runs are resampled independently, and a resample takes every pair of a
    member and a run (A. B. Owen, "The pigeonhole bootstrap", Annals of Applied Statistics 1,
    2007, 386-411). With only five members that differ far more than runs do, the interval holds
    the true mean in 82 % of the cases.
    """
    tables = [np.atleast_2d(np.asarray(task, dtype=np.float64)) for task in tasks]
    all_values = np.concatenate([table.ravel() for table in tables])
    mean = float(all_values.mean())
    if all(np.ptp(table) == 0.0 for table in tables):  # Nothing was random.
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
    """Return percentiles of values along their last axis, by name.

    Parameters
    ----------
    values
        Values, shape (..., runs).
    method
        The method of `numpy.percentile`. If some values are infinite, such as the time of a run
        that never settles, the method is "higher", since these cannot be interpolated.
    percents
        Percentages by name; by default `median`, `p10` and `p90`.
    """
    if not np.isfinite(values).all():
        method = "higher"
    percents = percents or {"median": 50, "p10": 10, "p90": 90}
    return {
        name: np.percentile(values, percent, axis=-1, method=method)
        for name, percent in percents.items()
    }
