"""Tests of `mptc_gym.evaluate`, of the bounds that come with it, and of the presets' ids."""

import dataclasses
import json
import re

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

from agents import PIController
from benchmarks.bounds import least_possible
from benchmarks.bounds.__main__ import PACKAGED as CASES
from mptc_gym import IDS, PRESETS, Evaluation, MiddlePointEnv, Parameters, evaluate, evaluation
from mptc_gym.evaluation import SEED, VALIDATION_SEED, find_bound
from tests.conftest import ROOT, run

HARD = "MiddlePointHard-v0"


def idle(observations):
    return np.zeros((len(observations), 1), np.float32)


@pytest.mark.parametrize("name", PRESETS)
def test_each_has_an_id_of_its_own(name):
    ids = [
        gymnasium.make(IDS[name]),
        gymnasium.make("MiddlePoint-v0", **PRESETS[name]),
        gymnasium.make(EnvSpec.from_json(gymnasium.make(IDS[name]).spec.to_json())),
    ]
    batch = gymnasium.make_vec(IDS[name], num_envs=1)
    assert {env.unwrapped.parameters for env in ids} == {batch.parameters}
    assert {env.spec.max_episode_steps for env in ids} == {1200}


class TestEvaluate:
    def test_it_is_a_mean_over_the_rewards_of_the_listed_seeds(self):
        found = evaluate(PIController(), HARD, episodes=3)
        assert list(found.seeds) == [SEED, SEED + 1, SEED + 2]
        for i, seed in enumerate(found.seeds):
            infos = run(MiddlePointEnv(**PRESETS["hard"]), [PIController().act] * 1200, seed)
            errors, travel = np.abs(infos["error"][1:]), np.abs(np.diff(infos["applied"]))
            assert found.errors[i] == pytest.approx(errors.mean(), abs=1e-12)
            assert found.travels[i] == pytest.approx(travel.sum(), abs=1e-9)
        assert found.mean_error == pytest.approx(found.errors.mean(), abs=1e-12)

    @pytest.mark.parametrize("name", ["paper", "hard"])
    def test_a_valve_that_is_left_alone_scores_0_and_the_bound_1(self, name):
        found = evaluate(idle, IDS[name], episodes=5)
        assert found.score == pytest.approx(0.0, abs=1e-12)
        assert found.scores == pytest.approx(np.zeros(5), abs=1e-12)
        assert found.travel == 0.0
        # The same line through both, at the error of a better policy.
        better = evaluate(PIController(1.0, 0.05), IDS[name], episodes=5)
        share = (found.mean_error - better.mean_error) / (
            found.mean_error - found.least_possible
        )
        assert better.score == pytest.approx(share)
        assert better.interval[0] <= better.score <= better.interval[1]
        assert better.multiple == pytest.approx(better.mean_error / better.least_possible)

    def test_the_interval_holds_what_more_episodes_say(self):
        few = evaluate(PIController(1.0, 0.05), HARD, episodes=40)
        more = evaluate(PIController(1.0, 0.05), HARD, episodes=120)
        assert few.interval[0] < more.score < few.interval[1]
        # The last of 120, which are more than one batch.
        last = evaluate(PIController(1.0, 0.05), HARD, episodes=20, seed=SEED + 100)
        np.testing.assert_array_equal(last.errors, more.errors[100:])
        np.testing.assert_array_equal(last.scores, more.scores[100:])
        # The normal interval of a quotient of means, by its linear part.
        possible = (more.errors - more.least) / (1.0 - more.scores)
        linear = possible * (more.scores - more.score) / possible.mean()
        width = 2 * 1.96 * linear.std() / 120**0.5
        assert np.ptp(more.interval) == pytest.approx(width, rel=0.1)
        alike = evaluate(PIController(1.0, 0.05), episodes=10)
        assert np.ptp(alike.interval) == pytest.approx(0.0, abs=1e-12)

    def test_other_episodes_and_lengths(self):
        found = evaluate(PIController(), HARD, episodes=5, seed=3)
        assert (found.score, found.interval, found.scores) == (None, None, None)
        assert str(found).endswith(found.note)
        for result, reason in (
            (found, "kept for seeds 7,000,000 to 7,000,119.*, not for 3 to 7: choose"),
            (evaluate(idle, HARD, episodes=121), "not for 7,000,000 to 7,000,120: choose"),
            (evaluate(idle, episodes=2, max_episode_steps=301), "1,200 samples, not of 301"),
            (evaluate(idle, episodes=2, delay=3), "presets alone, .* checkout, python -m ben"),
        ):
            assert result.score is None
            assert re.search(reason, result.note)
        assert found.seeds == range(3, 8)
        short = evaluate(idle, episodes=2, max_episode_steps=301)
        # 300 samples at 5 degC but for k = 0, and at k = 300 the next half period begins.
        assert short.mean_error == 5.0
        assert short.score is None

    def test_a_score_without_travel_says_why(self):
        found = evaluate(idle, "MiddlePointRandomised-v0", episodes=2)
        assert found.score == 0.0
        assert "no action left the dead zone of 3 to 7 t/h: train in mptc_gym.wr" in str(found)
        assert "dead zone of 5 t/h" in str(evaluate(idle, episodes=2))
        assert "the valve never moved" in evaluate(idle, episodes=2, dead_zone=0.0).note
        assert not evaluate(PIController(), episodes=2).note

    def test_help_explains_each_field(self):
        explained = re.findall(r"\n    ([\w, ]+) : ", Evaluation.__doc__)
        fields = {each.name for each in dataclasses.fields(Evaluation)}
        assert {*", ".join(explained).split(", ")} == fields

    def test_its_text_is_one_line(self):
        found = evaluate(PIController(), HARD, episodes=4)
        assert f"{HARD}: mean error {found.mean_error:.3f} degC" in str(found)
        assert f"score {found.score:.3f} (95 % " in str(found)
        assert "\n" not in str(found)
        same = str(evaluate(idle, episodes=2))  # an interval of no width would mean nothing
        assert "score 0.000; valve travel 0 t/h; 2 episodes, all alike" in same


class TestBounds:
    @pytest.mark.parametrize("name", [*CASES][::3])
    def test_they_are_those_of_the_limits(self, name):
        plant = Parameters(**CASES[name])
        kept = find_bound(plant, 1200, range(SEED, SEED + 120)).least
        drawn = bool(plant.ranges) or plant.setpoint == "random"
        assert len(set(kept.tolist())) == (120 if drawn else 1)
        i = 118 if drawn else 0
        least = least_possible(samples=1200, episodes=1, seed=SEED + i, **CASES[name])
        assert kept[i] == pytest.approx(least.value, abs=2e-6)

    def test_a_second_set_of_seeds_has_its_own(self, monkeypatch, tmp_path):
        kept = json.loads((ROOT / "mptc_gym/bounds.json").read_text(encoding="utf-8"))
        kept["cases"]["hard"]["validation_least"] = [0.5 + i for i in range(200)]
        (tmp_path / "bounds.json").write_text(json.dumps(kept), encoding="utf-8")
        monkeypatch.setattr(evaluation.resources, "files", lambda _: tmp_path)
        evaluation._read_bounds.cache_clear()
        hard = Parameters(**PRESETS["hard"])
        try:
            seeds = range(VALIDATION_SEED + 198, VALIDATION_SEED + 200)
            assert [*find_bound(hard, 1200, seeds).least] == [198.5, 199.5]
            beyond = find_bound(hard, 1200, range(VALIDATION_SEED, VALIDATION_SEED + 201))
            assert beyond.least is None
            assert "to 7,000,119 and 5,000,000 to 5,000,199, not" in beyond.why_not
        finally:
            evaluation._read_bounds.cache_clear()

    def test_they_say_how_they_were_made(self):
        kept = json.loads((ROOT / "mptc_gym/bounds.json").read_text(encoding="utf-8"))
        assert {name: case["arguments"] for name, case in kept["cases"].items()} == CASES
        assert (kept["samples"], kept["seed"], kept["episodes"]) == (1200, SEED, 120)
        assert set(kept) >= {"command", "commit", "versions", "unit"}

    def test_what_an_agent_sees_and_is_paid_changes_no_bound(self):
        seen = evaluate(idle, episodes=2, action_window=9, reward="absolute", move_weight=0.1)
        assert seen.least_possible == evaluate(idle, episodes=2).least_possible
        # A case is known by its arguments, not by its name.
        noisy = evaluate(idle, episodes=2, noise_variance=0.5)
        assert noisy.score is not None
        assert evaluate(idle, episodes=2, noise_variance=0.6).score is None
