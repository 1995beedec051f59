"""Estimates against counts by hand and their intervals against what they promise."""

import math

import numpy as np
import pytest

from benchmarks.lib import statistics
from benchmarks.lib.statistics import bootstrap, percentiles, quantile, share
from tests.conftest import assert_the_seed_is_all_that_differs

SOME_NEVER_END = np.r_[np.arange(1.0, 91.0), [math.inf] * 10]


@pytest.mark.parametrize(
    ("values", "level", "expected"),
    [
        # Of 10 values, the 2nd and the 9th are the narrowest pair that encloses the median with
        # 95 %: outside of it lie 2 (1 + 10) / 2^10 = 2.1 %, outside the 3rd and 8th 11 %.
        ([10, 1, 2, 9, 3, 8, 4, 7, 5, 6], 0.5, (5.5, 2, 9)),
        # Of 14 values, the 4th and the 11th enclose the median with 94.3 % alone: outside of
        # them lie 2 (1 + 14 + 91 + 364) / 2^14 = 5.7 %.
        (np.arange(1.0, 15.0), 0.5, (7.5, 3.0, 12.0)),
        # Few runs promise little.
        ([1.0, 2.0, 3.0], 0.5, (2.0, -math.inf, math.inf)),
        # Some that never end: the next higher of 50 and 51, not between.
        (SOME_NEVER_END, 0.5, (51.0, 40.0, 61.0)),
        (SOME_NEVER_END, 0.95, (math.inf, 90.0, math.inf)),
    ],
)
def test_quantiles_by_hand(values, level, expected):
    estimate = quantile(values, level)
    assert (estimate.value, estimate.low, estimate.high) == expected
    assert estimate.runs == len(values)


def test_what_never_ends_in_any_run_never_ends_in_the_median():
    assert {*percentiles(np.full(3, math.inf)).values()} == {math.inf}


def test_the_interval_of_two_values_is_wide():
    # Student's t of one degree of freedom: 12.7 standard errors.
    assert statistics.student([1.0, 3.0]).high == pytest.approx(2.0 + 12.706, abs=1e-3)


def test_the_share_has_wilsons_interval():
    estimate = share(np.array([True] * 8 + [False] * 2))
    assert estimate.value == 0.8
    assert (estimate.low, estimate.high) == pytest.approx((0.490, 0.943), abs=1e-3)


class TestBootstrap:
    def test_the_seed_is_all_that_it_depends_on(self, rng):
        values = rng.normal(size=50)
        assert_the_seed_is_all_that_differs(lambda seed: bootstrap(values, seed=seed).low)

    def test_tasks_are_not_drawn(self, rng):
        # How much they differ does not widen the interval.
        tables = [rng.normal(mean, 0.1, (2, 40)) for mean in (0.2, 0.8)]
        found = bootstrap(*tables, seed=0)
        assert found.value == pytest.approx(np.mean(tables))
        assert 0.2 < (found.high - found.low) / (4 * 0.1 / np.sqrt(160)) < 2.0

    @pytest.mark.parametrize(
        ("members", "of_members", "of_cells"),
        [(5, 0.0, 0.0), (5, 0.1, 0.3), (15, 0.3, 0.3)],
    )
    def test_intervals_of_members_in_the_same_runs_hold_the_truth(
        self, members, of_members, of_cells, rng, monkeypatch
    ):
        # What a run does to all members, what a member does in all runs, and what is left:
        # members that do the same in every run are no more runs than there were.
        monkeypatch.setattr(statistics, "RESAMPLES", 400)
        runs, trials, held, widths = 60, 120, 0, []
        for _ in range(trials):
            values = rng.normal(size=(1, runs)) + of_members * rng.normal(size=(members, 1))
            estimate = bootstrap(values + of_cells * rng.normal(size=(members, runs)), seed=0)
            held += estimate.low <= 0.0 <= estimate.high
            widths.append(estimate.high - estimate.low)
        assert 0.89 <= held / trials <= 0.99
        variance = 1 / runs + of_members**2 / members + of_cells**2 / (members * runs)
        assert np.mean(widths) == pytest.approx(2 * 1.96 * math.sqrt(variance), rel=0.1)

    def test_no_value_is_trimmed_away(self):
        values = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 1000.0])
        estimate = bootstrap(values, 0.0 * values, seed=0)
        assert (estimate.value, estimate.runs) == (pytest.approx(1028.0 / 16.0), 16)
        assert estimate.high > 100 > estimate.low
