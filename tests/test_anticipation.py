"""Who moves before a square wave changes is marked, and scored where changes surprise."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from agents import PIController
from benchmarks.bounds.least import least_possible
from benchmarks.compare.anticipation import (
    anticipation,
    movement_before_changes,
    surprising_setpoint,
)
from benchmarks.compare.comparison import estimate, ranked, run_case, scale_of
from benchmarks.compare.report import anticipation_table, ratio_table
from benchmarks.controllers.roster import ROSTER
from benchmarks.controllers.spec import LIMITS, ControllerSpec
from benchmarks.loop.linear import nominal
from benchmarks.loop.rollout import held, make_plants, mean_error, rollout
from benchmarks.loop.scenarios import SCENARIOS, Scenario
from mptc_gym import Parameters
from mptc_gym.evaluation import SEED
from mptc_gym.plant.dynamics import action_from_command
from tests.test_compare import a_comparison

EARLY = 270  # age of a level, samples, from which `Early` expects the next one


class Early:
    """Apply the flow that holds the set point, or the opposite one late in the half period."""

    def __init__(self, u_min, u_max):
        self.limits, self.gain = (u_min, u_max), nominal(Parameters()).gain

    def reset(self):
        self.level, self.age = None, 0

    def act(self, observation):
        level = np.asarray(observation, np.float64)[:, :1]
        same = self.level is not None and np.array_equal(level, self.level)
        self.age = self.age + 1 if same else 0
        self.level = level
        direction = -1.0 if self.age >= EARLY else 1.0
        return action_from_command(direction * level / self.gain, *self.limits)


early = ControllerSpec(
    name="early", label="early", look=("#123456", "o"), build=Early, prior_knowledge=LIMITS
)


def test_until_d_samples_after_a_change_the_output_is_that_of_a_set_point_that_holds_on():
    # So what has moved by then was no response: nothing had happened.
    outputs = []
    for setpoint in ("square", 5.0):
        plants = make_plants(2, 400, noise_variance=0.5, setpoint=setpoint)
        outputs.append(rollout(plants, PIController(1.0, 0.05), 400, SEED).output)
    square, constant = outputs
    np.testing.assert_array_equal(square[:319], constant[:319])
    assert np.all(square[319:330] != constant[319:330])


@pytest.mark.parametrize("name", ["mpc", "pi", "smith", "ppo-hard"])
def test_who_expects_no_change_is_not_marked(name):
    scenario = SCENARIOS["square-noise"]
    member, *_ = ROSTER[name].members()
    trajectory = member.run(scenario.arguments, scenario.samples, 4, SEED)
    assert anticipation(scenario, [member], [trajectory], 4, SEED) is None


def test_who_moves_early_is_marked_and_scored_where_that_is_too_early():
    scenario = SCENARIOS["square"]
    trajectory = early.run(scenario.arguments, scenario.samples, 1, SEED)
    found = anticipation(scenario, [early], [trajectory], 4, SEED)
    # Of the flows from 270 on, the outputs from 289 on: half of the way, and more, until 318.
    assert 0.5 < found.movement.value < 1.0
    assert found.errors.shape == (1, 4)
    published = mean_error(trajectory).mean()
    least = least_possible(samples=1200).value
    assert published / least < found.ratio - 0.1
    assert 0.0 < found.scores.mean() < 1.0
    # A case that never changes, or does so at random, shows nothing of the kind.
    for setpoint in (5.0, "random"):
        other = Scenario("other", "other", 1200, {"setpoint": setpoint})
        assert anticipation(other, [early], [trajectory], 4, SEED) is None


def test_a_set_point_that_changes_all_the_time_shows_nothing():
    scenario = Scenario("short", "short", 400, {"setpoint_period": 40})
    trajectory = early.run(scenario.arguments, scenario.samples, 1, SEED)
    assert movement_before_changes(scenario, [trajectory]) is None


def test_surprising_set_points_hold_as_long_on_average_and_their_age_tells_nothing():
    scenario = Scenario("long", "long", 60_000, {"setpoint_amplitude": 3.0})
    setpoint = np.array(surprising_setpoint(scenario, 1))
    assert len(setpoint) == 60_001
    holds = held(setpoint)[:-1]
    lengths = np.array([stop - start for start, stop in holds])
    assert lengths.min() > 150
    assert lengths.mean() == pytest.approx(300, rel=0.1)
    # Of those that last 200 samples and more, the rest is as long as of those that last 150.
    assert lengths[lengths > 250].mean() == pytest.approx(250 + 150, rel=0.1)
    assert [setpoint[start] for start, _ in holds[:3]] == [3.0, -3.0, 3.0]
    assert surprising_setpoint(scenario, 2) != setpoint.tolist()


def test_a_comparison_ranks_by_the_surprise_and_shows_the_mark():
    scenario = SCENARIOS["square"]
    cases = [run_case(scenario, controller, 2, SEED) for controller in (early, ROSTER["smith"])]
    anticipations = {
        (case.scenario, case.agent): case.anticipation for case in cases if case.anticipation
    }
    assert [*anticipations] == [("square", "early")]
    runs = pd.concat([case.runs for case in cases], ignore_index=True)
    scales = {"square": scale_of(scenario, 2, SEED)}
    estimates = estimate(runs, scales, anticipations)
    scores = ranked(estimates, {})
    assert [*scores] == ["smith", "early"]
    assert [*ranked(estimate(runs, scales, {}), {})] == ["early", "smith"]
    compared = a_comparison(
        scales=scales, estimates=estimates, anticipations=anticipations, scores=scores
    )
    rows = ratio_table(compared).set_index("controller")
    assert rows.loc["early", "square"].endswith("‡")
    assert not rows.loc["Smith", "square"].endswith("‡")
    (row,) = anticipation_table(compared).to_dict("records")
    assert (row["case"], row["controller"]) == ("square", "early")
    assert row["error ratio without foresight"] > row["error ratio"]


def test_a_loop_that_runs_away_does_not_anticipate():
    # Outputs that happen to move before the changes, with errors as of an unstable loop.
    square = SCENARIOS["square"]
    runs = early.run(square.arguments, square.samples, 1, SEED)
    assert anticipation(square, [early], [runs], 1, SEED) is not None
    unstable = replace(runs, next_error=10.0 * runs.next_error)
    assert anticipation(square, [early], [unstable], 1, SEED) is None
