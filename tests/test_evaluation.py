"""Tests of `mptc_gym.evaluate`, of the stored reference errors, and of the presets' ids."""

import json
import re

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

from agents import PIController
from benchmarks.bounds import reference_error
from benchmarks.bounds.__main__ import PACKAGED as CASES
from mptc_gym import IDS, PRESETS, Parameters, evaluate
from mptc_gym.evaluation import SEED, VALIDATION_EPISODES, VALIDATION_SEED, find_reference
from tests.conftest import ROOT

HARD = "MiddlePointHard-v0"


def idle(observations):
    return np.zeros((len(observations), 1), np.float32)


@pytest.mark.parametrize("name", PRESETS)
def test_each_preset_has_an_id(name):
    environments = [
        gymnasium.make(IDS[name]),
        gymnasium.make("MiddlePoint-v0", **PRESETS[name]),
        gymnasium.make(EnvSpec.from_json(gymnasium.make(IDS[name]).spec.to_json())),
    ]
    batch = gymnasium.make_vec(IDS[name], num_envs=1)
    assert {env.unwrapped.parameters for env in environments} == {batch.parameters}
    assert {env.spec.max_episode_steps for env in environments} == {1200}


class TestEvaluate:
    @pytest.mark.parametrize("name", ["paper", "hard"])
    def test_an_idle_valve_scores_0_and_the_reference_1(self, name):
        result = evaluate(idle, IDS[name], episodes=5)
        assert result.score == pytest.approx(0.0, abs=1e-12)
        assert result.scores == pytest.approx(np.zeros(5), abs=1e-12)
        assert result.travel == 0.0
        # The score of another policy lies on the line through both points.
        better = evaluate(PIController(1.0, 0.05), IDS[name], episodes=5)
        gained = result.mean_error - better.mean_error
        possible = result.mean_error - result.reference
        assert better.score == pytest.approx(gained / possible)
        assert better.interval[0] <= better.score <= better.interval[1]
        assert better.ratio == pytest.approx(better.mean_error / better.reference)

    def test_the_interval_is_as_wide_as_chance(self):
        more = evaluate(PIController(1.0, 0.05), HARD, episodes=120)
        # An episode does not depend on the episodes before it.
        last = evaluate(PIController(1.0, 0.05), HARD, episodes=20, seed=SEED + 100)
        np.testing.assert_array_equal(last.errors, more.errors[100:])
        np.testing.assert_array_equal(last.scores, more.scores[100:])
        # The interval of a quotient of two means, by the delta method.
        possible = (more.errors - more.references) / (1.0 - more.scores)
        linear = possible * (more.scores - more.score) / possible.mean()
        width = 2 * 1.96 * linear.std() / 120**0.5
        assert np.ptp(more.interval) == pytest.approx(width, rel=0.1)
        alike = evaluate(PIController(1.0, 0.05), episodes=10)
        assert np.ptp(alike.interval) == pytest.approx(0.0, abs=1e-12)

    def test_without_a_reference_the_note_says_why(self):
        other_seeds = evaluate(PIController(), HARD, episodes=5, seed=3)
        assert str(other_seeds).endswith(other_seeds.note)
        short = evaluate(idle, episodes=2, max_episode_steps=301)
        assert short.mean_error == 5.0  # of the square wave at all samples but k = 0
        for unscored, reason in (
            (other_seeds, "kept for seeds 7,000,000 to 7,000,119.*, not for 3 to 7: choose"),
            (evaluate(idle, HARD, episodes=121), "not for 7,000,000 to 7,000,120: choose"),
            (short, "1,200 samples, not of 301"),
            (evaluate(idle, episodes=2, delay=3), "presets alone, .* checkout, python -m ben"),
        ):
            assert (unscored.score, unscored.interval, unscored.scores) == (None, None, None)
            assert (unscored.reference, unscored.ratio, unscored.is_bound) == (
                None,
                None,
                False,
            )
            assert re.search(reason, unscored.note)

    def test_a_score_without_travel_says_why(self):
        result = evaluate(idle, episodes=2)
        assert (result.score, result.travel) == (0.0, 0.0)
        assert str(result).endswith(result.note)
        assert "leave the dead zone" in result.note
        assert not evaluate(PIController(), episodes=2).note

    def test_its_text_is_one_line(self):
        result = evaluate(PIController(), HARD, episodes=4)
        assert f"{HARD}: mean error {result.mean_error:.3f} degC" in str(result)
        assert f"degC, {result.ratio:.2f} times the reference; score" in str(result)
        assert f"score {result.score:.3f} (95 % " in str(result)
        assert "\n" not in str(result)
        same = str(evaluate(idle, episodes=2))  # an interval of no width would mean nothing
        assert "score 0.000; valve travel 0 t/h; 2 episodes, all alike" in same


class TestReferences:
    @pytest.mark.parametrize("name", [*CASES][::3])
    def test_they_are_the_computed_errors(self, name):
        plant = Parameters(**CASES[name])
        found = find_reference(plant, 1200, range(SEED, SEED + 120))
        stored = found.errors
        differs = bool(plant.ranges) or plant.setpoint == "random"
        assert len(set(stored.tolist())) == (120 if differs else 1)
        i = 118 if differs else 0
        reference = reference_error(samples=1200, episodes=1, seed=SEED + i, **CASES[name])
        assert stored[i] == pytest.approx(reference.value, abs=2e-6)
        assert found.is_bound == reference.is_bound

    def test_validation_seeds_have_errors_of_their_own(self):
        hard = Parameters(**PRESETS["hard"])
        last = VALIDATION_SEED + VALIDATION_EPISODES - 1
        (stored,) = find_reference(hard, 1200, range(last, last + 1)).errors
        arguments = {"samples": 1200, "episodes": 1, "seed": last}
        assert stored == pytest.approx(reference_error(**arguments, **PRESETS["hard"]).value)
        beyond = find_reference(hard, 1200, range(last, last + 2))
        assert beyond.errors is None
        assert f"to 7,000,119 and 5,000,000 to {last:,}, not" in beyond.why_not

    def test_they_are_those_of_the_cases_of_the_command(self):
        stored = json.loads((ROOT / "mptc_gym/bounds.json").read_text(encoding="utf-8"))
        assert {name: case["arguments"] for name, case in stored["cases"].items()} == CASES

    def test_windows_rewards_and_action_forms_change_nothing_but_another_plant_does(self):
        others = {"action_window": 9, "reward": "absolute", "move_weight": 0.1}
        form = {"action": "change", "max_move": 1.0, "compensated_dead_zone": 3.0}
        other = evaluate(idle, episodes=2, **others, **form)
        assert other.reference == evaluate(idle, episodes=2).reference
        assert evaluate(idle, episodes=2, noise_variance=0.5).score is not None
        assert evaluate(idle, episodes=2, noise_variance=0.6).score is None
