"""Compute mean errors, valve travels and scores, for evaluations and for the benchmarks."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

Values = NDArray[np.float64]  # of runs or episodes

INTERVAL_ENDS: Final = 0.025, 0.975  # the quantiles that are the ends of a 95 % interval
RESAMPLES: Final = 2000  # of a bootstrap; with more, the interval hardly changes


def mean_absolute_error(errors: Values) -> Values:
    """Return the mean absolute error of each run, degC, shape (runs,).

    `errors` has the errors e(k) at the samples k = 1 to N, degC, shape (N, runs). The error at
    k = 0 is left out, since no controller can change it.
    """
    return np.asarray(np.abs(errors).mean(axis=0))


def valve_travel(flows: Values) -> Values:
    """Return the sum of the absolute changes of the flow in each run, t/h, shape (runs,).

    `flows` has the flows that the valve applies at the samples k = 0 to N - 1, t/h, shape
    (N, runs). The first change is that from the flow at rest, 0 t/h.
    """
    return np.asarray(np.abs(np.diff(flows, axis=0, prepend=0.0)).sum(axis=0))


def scores(errors: ArrayLike, idle_errors: ArrayLike, references: ArrayLike) -> Values:
    """Return scores: 0 for the error of an idle valve, 1 for the reference error.

    The arguments are mean errors in degC, whose shapes broadcast to that of the result: those
    of a controller, those of a valve that never moves, and the reference errors.
    """
    idle = np.asarray(idle_errors, np.float64)
    return np.asarray((idle - np.asarray(errors)) / (idle - np.asarray(references)))


def score(errors: Values, idle_errors: Values, references: Values) -> float:
    """Return the score over all episodes; the arguments are those of `scores`.

    The score is a quotient of two means. The mean of the quotients would give a large weight to
    episodes in which an idle valve is hardly worse than the reference.
    """
    return float((idle_errors - errors).mean() / (idle_errors - references).mean())


def score_interval(
    errors: Values, idle_errors: Values, references: Values
) -> tuple[float, float]:
    """Return the 95 % confidence interval of `score`, from a bootstrap over the episodes.

    The arguments are those of `scores`, each of shape (episodes,).
    """
    episodes = len(errors)
    generator = np.random.default_rng(0)  # always this seed, for equal intervals
    resampled = []
    for _ in range(RESAMPLES):
        drawn = generator.integers(episodes, size=episodes)  # with replacement
        resampled.append(score(errors[drawn], idle_errors[drawn], references[drawn]))
    low, high = np.quantile(resampled, INTERVAL_ENDS).tolist()
    return low, high
