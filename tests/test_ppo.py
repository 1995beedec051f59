"""Training PPO: grouped, odd, seeded, and kept in NumPy."""

import json
from dataclasses import asdict, replace

import numpy as np
import pandas as pd
import pytest
import torch
from stable_baselines3.common.buffers import RolloutBuffer

from agents import PolicyNetwork
from agents.networks import PRETRAINED
from benchmarks.controllers.roster import ROSTER
from benchmarks.examples import sb3
from benchmarks.loop.rollout import make_plants, rollout
from benchmarks.train import ppo
from mptc_gym.wrappers.vector import IncrementalAction
from tests.conftest import ROOT

SMALL = replace(
    ppo.RECIPES["ppo"],
    plants=((8, {"setpoint": "random"}), (16, {"setpoint": "random", "noise_variance": 0.5})),
    cases={"short": {"max_episode_steps": 20}},
    hidden=(8,),
    memory=40,
    steps=1024,
)


@pytest.fixture(autouse=True)
def small(monkeypatch):
    for name, value in {"n_steps": 32, "batch_size": 64}.items():
        monkeypatch.setitem(sb3.SETTINGS, name, value)


def weights(network):
    return np.concatenate([array.ravel() for layer in network.layers for array in layer])


class TestTraining:
    def test_a_seed_gives_a_policy_that_differs_from_that_of_another(self):
        first, again, other = (ppo.train(SMALL, seed) for seed in (0, 0, 1))
        assert np.array_equal(weights(first), weights(again))
        assert not np.array_equal(weights(first), weights(other))
        # Without biases and with tanh, what holds at +5 degC holds at -5.
        assert not any(bias.any() for _, bias in first.layers)
        about = first.provenance
        assert about["seed"] == 0
        assert about["steps"] >= SMALL.steps
        assert about["cpu_seconds"] > 0.0
        assert about["validation"].keys() == {"short"}
        json.dumps(about)

    def test_a_group_meets_the_same_and_no_other_group_does(self):
        plants = ppo.begin(SMALL, 0).get_env()
        plants.reset()
        for _ in range(3):
            plants.step(np.random.default_rng(0).uniform(-1, 1, (24, 1)).astype(np.float32))
        for name in ("setpoint", "noise"):
            groups = plants.infos[name].reshape(-1, ppo.GROUP)
            assert (groups == groups[:, :1]).all()
            assert len(np.unique(groups[:, 0])) == 3
        assert np.ptp(plants.infos["command"].reshape(-1, ppo.GROUP), axis=1).min() > 0.0
        seeds = {seed for batch in plants.batches for seed in batch.unwrapped.np_random_seed}
        assert len(seeds) == 3
        assert min(seeds) >= 1 << 32  # no comparison has any so large

    def test_what_a_group_has_in_common_is_no_advantage(self):
        model = ppo.begin(SMALL, 0)
        spaces = model.observation_space, model.action_space
        buffer, plain = (
            kind(3, *spaces, gamma=0.9, n_envs=16) for kind in (sb3.GroupBuffer, RolloutBuffer)
        )
        rewards = np.random.default_rng(0).normal(size=(3, 16)).astype(np.float32)
        common = np.repeat([[1.0, 5.0]], ppo.GROUP, axis=1).astype(np.float32)
        found = []
        for each, more in ((buffer, 0.0), (buffer, common), (plain, 0.0)):
            each.reset()
            each.rewards[:] = rewards + more
            each.compute_returns_and_advantage(torch.zeros(16), np.zeros(16))
            found.append((each.advantages.copy(), each.returns.copy()))
        np.testing.assert_allclose(found[0][0], found[1][0], atol=1e-5)
        np.testing.assert_array_equal(found[0][1], found[2][1])  # for the value function
        apart = (found[2][0] - found[0][0]).reshape(3, 2, ppo.GROUP)
        assert np.ptp(apart, axis=2).max() < 1e-5


class TestPolicy:
    def test_changes_by_hand(self):
        window = torch.tensor([[8.0, 6.0, 5.0, 1.0, 4.0, 4.0, 0.0]])  # newest first
        # Means of 8, of 6, of 5 and 1, and of the rest.
        assert sb3.changes(window, 2)[0].tolist() == pytest.approx([2.0, 3.0, 3.0 - 8.0 / 3.0])

    @pytest.mark.parametrize(
        ("recipe", "scale"),  # of the action: with limits that matter
        [(SMALL, 300.0), (replace(SMALL, levels=True, hidden=(), dead_zone=0.0), 1.0)],
    )
    def test_without_torch_it_does_what_it_does_in_its_wrapper(self, recipe, scale):
        model = ppo.begin(recipe, 5)
        with torch.no_grad():
            model.policy.action_net.weight.mul_(scale)
        network = ppo.export(model, recipe)
        plants = make_plants(3, 80, setpoint=5.0, noise_variance=0.5, **recipe.windows)
        run = rollout(plants, network, 80, seed=1)
        wrapped = IncrementalAction(
            plants, max_move=ppo.MAX_MOVE, compensate_dead_zone=recipe.dead_zone
        )
        observations, info = wrapped.reset(seed=1)
        moves = []
        for k in range(80):
            np.testing.assert_allclose(run.output[k], info["output"], atol=1e-3)
            seen = observations @ ppo.features(recipe).T
            moves.append(model.predict(seen, deterministic=True)[0])
            observations, *_, info = wrapped.step(moves[-1])
            np.testing.assert_allclose(run.applied[k], info["applied"], atol=1e-3)
        assert np.ptp(run.applied) > 1.0
        assert (np.abs(moves).max() == 1.0) == (scale > 1.0)


@pytest.mark.parametrize("name", ppo.RECIPES)
def test_the_budget_of_the_search_is_that_of_its_log(name):
    log = pd.read_csv(ROOT / "benchmarks/published/ppo_trials.csv")
    trials = log[log.policy == name]
    samples, minutes = trials.samples.sum() / 1e6, trials.cpu_seconds.sum() / 60
    said = f"{len(trials)} trials: {samples:.0f} M samples, {minutes:.0f} min"
    assert ROSTER[name].searched.endswith(said)


class TestMembers:
    @pytest.mark.parametrize("name", ppo.RECIPES)
    def test_those_of_the_project_are_of_the_recipes(self, name):
        recipe = ppo.RECIPES[name]
        asked = json.loads(json.dumps(asdict(recipe)))
        members = ROSTER[name].members()
        assert [each.provenance["file"] for each in members] == [
            f"{name}-{seed}.npz" for seed in range(10_000, 10_005)
        ]
        for each in members:
            network = PolicyNetwork.load(PRETRAINED / each.provenance["file"])
            assert asked.items() <= each.provenance["recipe"].items()
            count = sum(W.size for W, _ in network.layers)
            assert f"{count:,} weights" in each.searched
            assert f": {recipe.steps / 1e6:g} M samples a policy" in each.searched
