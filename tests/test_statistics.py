"""Estimates against counts by hand and their intervals against what they promise."""

import math

import numpy as np
import pytest
from scipy import stats

from benchmarks.statistics import exact, median, quantile, share


def test_median_by_hand():
    # Of 10 values, the 2nd and the 9th are the narrowest pair that encloses the median with
    # 95 %: outside of it lie 2 (1 + 10) / 2^10 = 2.1 %, outside the 3rd and 8th 11 %.
    estimate = median([10, 1, 2, 9, 3, 8, 4, 7, 5, 6])
    assert (estimate.value, estimate.low, estimate.high) == (5.5, 2, 9)
    assert estimate.runs == 10


def test_quantile_of_some_that_never_end():
    values = np.r_[np.arange(1.0, 91.0), [math.inf] * 10]
    assert quantile(values, 0.5).value == 51  # the next higher of 50 and 51, not between
    high = quantile(values, 0.95)
    assert high.value == high.high == math.inf


def test_few_runs_promise_little():
    estimate = median([1.0, 2.0, 3.0])
    assert (estimate.value, estimate.low, estimate.high) == (2.0, -math.inf, math.inf)


def test_share_by_hand():
    # Wilson: (p + z^2/2n +- z sqrt(p (1 - p)/n + z^2/4n^2)) / (1 + z^2/n)
    estimate = share(np.array([True] * 8 + [False] * 2))
    z, p, n = 1.959964, 0.8, 10
    half = z * math.sqrt(p * (1 - p) / n + z**2 / (4 * n**2)) / (1 + z**2 / n)
    middle = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    assert estimate.value == 0.8
    assert (estimate.low, estimate.high) == pytest.approx((middle - half, middle + half))


@pytest.mark.parametrize("how", ["median", "upper", "share"])
def test_intervals_hold_the_truth_as_often_as_they_promise(how, rng):
    trials, held = 400, 0
    for _ in range(trials):
        if how == "share":
            estimate, truth = share(rng.random(80) < 0.3), 0.3
        else:
            p = 0.5 if how == "median" else 0.8
            estimate, truth = quantile(rng.exponential(size=80), p), stats.expon.ppf(p)
        held += estimate.low <= truth <= estimate.high
    assert 0.92 <= held / trials <= 0.99  # 95 %, and a little more as counts are whole


def test_exact_has_no_width():
    assert vars(exact(3)) == {"value": 3.0, "low": 3.0, "high": 3.0, "runs": 1}


@pytest.mark.parametrize("values", [[], [1.0, math.nan], [[1.0, 2.0]]])
def test_bad_values(values):
    with pytest.raises(ValueError, match="values must be numbers"):
        median(values)


@pytest.mark.parametrize("flags", [[], [0.5, 1.0], [[True]]])
def test_bad_flags(flags):
    with pytest.raises(ValueError, match="flags must be booleans"):
        share(flags)
