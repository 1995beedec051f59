"""Gymnasium's own wrappers around both environments, over the ends of episodes."""

import gymnasium
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import vector

import mptc_gym  # noqa: F401 (registers the environment)

LIMIT, STEPS, PLANTS = 50, 260, 3
ARGUMENTS = {"noise_variance": 0.5, "setpoint": "random", "setpoint_period": 60}
# float32, as Gymnasium warns of a loss of precision with others
ONE, TONNES = np.float32(1.0), np.float32(10.0)
MODES = [mode.value for mode in AutoresetMode]


def make():
    return gymnasium.make("MiddlePoint-v0", max_episode_steps=LIMIT, **ARGUMENTS)


def side_by_side(wrapped, rng, low=-ONE, high=ONE):
    """Step a wrapped plant and one without, and yield the actions and what both returned.

    Where an episode begins, the actions are None, and there is no reward.
    """
    plain = make()
    for seed in range(STEPS // LIMIT + 1):
        yield None, plain.reset(seed=seed), wrapped.reset(seed=seed)
        ended = False
        while not ended:
            shares = rng.random(1)
            action = (2.0 * shares - 1.0).astype(np.float32)
            given = (low + shares * (high - low)).astype(np.float32)
            ours, theirs = plain.step(action), wrapped.step(given)
            assert ours[2:4] == theirs[2:4]
            ended = ours[3]
            yield given, ours, theirs


def batches_side_by_side(mode, wrap, rng, low=-ONE, high=ONE):
    """Step a wrapped batch and one without, and yield the actions and what both returned."""
    plain, wrapped = (
        each(
            gymnasium.make_vec(
                "MiddlePoint-v0", PLANTS, max_episode_steps=LIMIT, autoreset_mode=mode,
                **ARGUMENTS,
            )
        )
        for each in (lambda batch: batch, wrap)
    )  # fmt: skip
    for batch in (plain, wrapped):
        batch.reset(seed=0)
    for k in range(STEPS):
        shares = rng.random((PLANTS, 1))
        actions = (2.0 * shares - 1.0).astype(np.float32)
        given = (low + shares * (high - low)).astype(np.float32)
        ours, theirs = plain.step(actions), wrapped.step(given)
        np.testing.assert_array_equal(ours[3], theirs[3])
        yield given, ours, theirs
        reset = ours[3] if mode == "Disabled" else np.zeros(PLANTS, np.bool_)
        if k == 19:  # from now on the episodes end at different times
            reset = np.arange(PLANTS) == 1
        if reset.any():
            for batch in (plain, wrapped):
                batch.reset(options={"reset_mask": reset.copy()})


def running_episodes(mode, steps):
    """Yield what a step returned, and which of its rewards belong to an episode."""
    ended = np.zeros(PLANTS, np.bool_)
    for step in steps:
        yield step, ~ended if mode == "NextStep" else np.ones(PLANTS, np.bool_)
        ended = step[1][3]


class TestOnePlant:
    def test_episode_statistics_are_the_sum_of_the_rewards(self, rng):
        total, length, episodes = 0.0, 0, 0
        for action, ours, theirs in side_by_side(wrappers.RecordEpisodeStatistics(make()), rng):
            if action is None:
                total, length = 0.0, 0
                continue
            total, length = total + ours[1], length + 1
            assert ("episode" in theirs[4]) == ours[3]
            if ours[3]:
                episodes += 1
                assert theirs[4]["episode"]["r"] == pytest.approx(total)
                assert theirs[4]["episode"]["l"] == length == LIMIT
        assert episodes == 6

    def test_rescaled_actions_can_be_in_tonnes_an_hour(self, rng):
        wrapped = wrappers.RescaleAction(make(), -TONNES, TONNES)
        for action, ours, theirs in side_by_side(wrapped, rng, -TONNES, TONNES):
            if action is not None:
                assert theirs[4]["command"] == pytest.approx(action[0], abs=1e-5)
                assert theirs[4]["output"] == pytest.approx(ours[4]["output"], abs=1e-4)

    def test_rewards_are_divided_by_their_spread(self, rng):
        rewards = []
        wrapped = wrappers.NormalizeReward(make(), gamma=0.0)
        for action, ours, theirs in side_by_side(wrapped, rng):
            if action is not None:
                rewards.append(ours[1])
                if len(rewards) > 10:
                    assert ours[1] / theirs[1] == pytest.approx(np.std(rewards), rel=1e-2)

    def test_stacked_observations_are_the_last_ones(self, rng):
        frames = []
        for action, ours, theirs in side_by_side(
            wrappers.FrameStackObservation(make(), 4), rng
        ):
            frames = [ours[0].copy()] * 4 if action is None else [*frames[1:], ours[0].copy()]
            np.testing.assert_array_equal(theirs[0], frames)

    def test_time_is_shown_and_begins_again(self, rng):
        samples = 0
        wrapped = wrappers.TimeAwareObservation(make())
        for action, ours, theirs in side_by_side(wrapped, rng):
            samples = 0 if action is None else samples + 1
            np.testing.assert_array_equal(theirs[0], [*ours[0], samples])
            assert wrapped.observation_space.contains(theirs[0])

    def test_rescaled_observations_stay_within_one(self, rng):
        wrapped = wrappers.RescaleObservation(make(), -ONE, ONE)
        spans = [50.0] * 3 + [100.0] * 3
        for _, ours, theirs in side_by_side(wrapped, rng):
            np.testing.assert_allclose(theirs[0], ours[0] / spans, atol=1e-6)
            assert wrapped.observation_space.contains(theirs[0])

    def test_a_time_limit_of_its_own_ends_episodes(self):
        endless = gymnasium.make("MiddlePoint-v0", max_episode_steps=-1)
        limited = wrappers.TimeLimit(endless, 30)
        for _ in range(3):
            limited.reset(seed=0)
            ends = [limited.step(np.zeros(1, np.float32))[2:4] for _ in range(30)]
            assert ends == [(False, False)] * 29 + [(False, True)]


@pytest.mark.parametrize("mode", MODES)
class TestManyPlants:
    def test_episode_statistics_are_the_sum_of_the_rewards(self, rng, mode):
        totals, lengths, episodes = np.zeros(PLANTS), np.zeros(PLANTS, int), 0
        steps = batches_side_by_side(mode, vector.RecordEpisodeStatistics, rng)
        for k, ((_, ours, theirs), running) in enumerate(running_episodes(mode, steps)):
            totals[running] += ours[1][running]
            lengths += running
            ended = ours[3]
            assert ("episode" in theirs[4]) == ended.any()
            if ended.any():
                episodes += ended.sum()
                episode = theirs[4]["episode"]
                np.testing.assert_array_equal(theirs[4]["_episode"], ended)
                np.testing.assert_allclose(episode["r"][ended], totals[ended])
                np.testing.assert_array_equal(episode["l"][ended], lengths[ended])
                assert set(lengths[ended]) == {LIMIT}
            again = ended | (np.arange(PLANTS) == 1) if k == 19 else ended
            totals[again], lengths[again] = 0.0, 0
        assert episodes >= 4 * PLANTS

    def test_rescaled_actions_can_be_in_tonnes_an_hour(self, rng, mode):
        def wrap(batch):
            return vector.RescaleAction(batch, -TONNES, TONNES)

        steps = batches_side_by_side(mode, wrap, rng, -TONNES, TONNES)
        for (actions, ours, theirs), running in running_episodes(mode, steps):
            np.testing.assert_allclose(ours[4]["output"], theirs[4]["output"], atol=1e-4)
            # Where a step ends an episode and begins the next, the infos are those of the next.
            going_on = running & ~ours[3] if mode == "SameStep" else running
            np.testing.assert_allclose(
                theirs[4]["command"][going_on], actions[going_on, 0], atol=1e-5
            )
            if mode == "SameStep" and ours[3].any():
                final = theirs[4]["final_info"]["command"][ours[3]]
                np.testing.assert_allclose(final, actions[ours[3], 0], atol=1e-5)

    def test_rewards_are_divided_by_their_spread(self, rng, mode):
        def wrap(batch):
            return vector.NormalizeReward(batch, gamma=0.0)

        rewards = []
        for (_, ours, theirs), running in running_episodes(
            mode, batches_side_by_side(mode, wrap, rng)
        ):
            rewards += ours[1][running].tolist()
            if len(rewards) > 10:
                np.testing.assert_allclose(
                    theirs[1] * np.std(rewards), ours[1], rtol=1e-2, atol=1e-12
                )


# Gymnasium refuses to wrap the observations of "SameStep".
@pytest.mark.parametrize("mode", ["NextStep", "Disabled"])
def test_rescaled_observations_of_many_stay_within_one(rng, mode):
    def wrap(batch):
        return vector.RescaleObservation(batch, -ONE, ONE)

    spans = [50.0] * 3 + [100.0] * 3
    for _, ours, theirs in batches_side_by_side(mode, wrap, rng):
        np.testing.assert_allclose(theirs[0], ours[0] / spans, atol=1e-6)
