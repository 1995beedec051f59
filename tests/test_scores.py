"""The arithmetic of errors and scores, by hand."""

import numpy as np
import pytest

from mptc_gym.scores import (
    mean_absolute_error,
    score,
    score_interval,
    scores,
    valve_travel,
)


def test_errors_count_by_their_size_and_flows_by_their_moves_from_0():
    signals = np.array([[3.0, 0.0], [-1.0, 0.0], [2.0, 6.0]])
    assert mean_absolute_error(signals).tolist() == [2.0, 2.0]
    assert valve_travel(signals).tolist() == [3.0 + 4.0 + 3.0, 6.0]


def test_an_episode_without_much_to_gain_counts_little_in_a_score():
    idle = np.array([5.0, 1.1])
    references = np.array([1.0, 1.0])
    errors = np.array([2.0, 1.0 + 0.2])
    assert scores(errors, idle, references) == pytest.approx([0.75, -1.0])
    assert score(errors, idle, references) == pytest.approx((3.0 - 0.1) / (4.0 + 0.1))
    low, high = score_interval(errors, idle, references)
    assert (low, high) == pytest.approx((-1.0, 0.75))  # where one episode is drawn twice
