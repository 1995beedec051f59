"""Training by PPO: what groups of plants share, and what a file of a policy holds."""

import json
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
import torch
from stable_baselines3.common.buffers import RolloutBuffer

from agents import PolicyNetwork
from agents.networks import PRETRAINED
from benchmarks.controllers.own import own_controllers
from benchmarks.controllers.roster import ROSTER
from benchmarks.loop.runs import make_plants
from benchmarks.train import __main__ as program
from benchmarks.train import learning, ppo, recipe
from tests.conftest import ROOT

RECIPE = replace(
    recipe.RECIPES["ppo"],
    plants=(
        recipe.TrainingPlants(8, {"setpoint": "random"}),
        recipe.TrainingPlants(16, {"setpoint": "random", "noise_variance": 0.5}),
    ),
    cases={"short": {"max_episode_steps": 20}},
    scored_on={"max_episode_steps": 20},
    hidden=(8,),
    memory=40,
    steps=512,
)


@pytest.fixture(autouse=True)
def small(monkeypatch):
    for name, value in {"n_steps": 32, "batch_size": 64}.items():
        monkeypatch.setitem(ppo.SETTINGS, name, value)


def test_the_command_trains_what_is_missing_for_a_plant_on_which_compare_runs_it(
    tmp_path, capsys, monkeypatch, refused
):
    few = replace(recipe.RECIPES["ppo"], plants=(recipe.TrainingPlants(8, {}),) * 2)
    monkeypatch.setitem(recipe.RECIPES, "ppo", few)
    monkeypatch.setattr(learning, "EPISODES", 2)
    monkeypatch.setattr(learning, "COMPARED", {"pi-simc": "-", "nn": ":"})
    words = f"ppo --steps 8 --jobs 1 --set b=[0.0456,0.00404] --set u_max=12 --out {tmp_path}"
    files = [tmp_path / f"ppo-plant-{seed}.npz" for seed in (10_000, 10_001)]
    assert program.main([*words.split(), "--networks", "1"]) == 0
    first_provenance = (tmp_path / "provenance.json").read_text()
    written = files[0].stat().st_mtime_ns
    assert program.main([*words.split(), "--networks", "2"]) == 0
    assert files[0].stat().st_mtime_ns == written
    assert (tmp_path / "provenance.json").read_text() == first_provenance
    assert {"10000", "10001"} <= set(capsys.readouterr().out.split())
    # Networks of other plants or lengths need another folder, which stays as it is.
    for other, text in [("--set u_max=11", "with plant {"), ("--steps 9", "with steps 8 and")]:
        assert text in refused(program.main, [*words.split(), *other.split()])
    assert (tmp_path / "provenance.json").read_text() == first_provenance
    (spec,) = own_controllers([f"mine={file}" for file in files]).values()
    assert spec.direction == 1
    rising = {"b": [0.0456, 0.00404], "u_max": 12.0}
    first, second = (member.run(rising, 20, 1, 0).command for member in spec.members())
    assert (first != second).any()
    table = pd.read_csv(tmp_path / "learning.csv").set_index("policy")
    assert [*table.index] == ["seed 10000"] * 2 + ["seed 10001"] * 2 + ["pi-simc", "nn"]
    assert [*table["samples"].fillna(-1)] == [0, 512] * 2 + [-1, -1]
    assert table["score"].isna().all()  # as the reference error is unknown
    network = PolicyNetwork.load(files[1], u_max=12.0)
    arguments = {**network.interface, **recipe.for_plant(rising).scored_on}
    result = learning.score(network, arguments)
    assert table["mean_error"].iloc[3] == result["mean_error"]
    assert plt.imread(tmp_path / "learning.png").std() > 0.0


def weights(network):
    return np.concatenate([array.ravel() for layer in network.layers for array in layer])


class TestPPO:
    def test_a_seed_gives_a_policy_that_differs_from_that_of_another(self):
        first, again, other = (ppo.train(RECIPE, seed) for seed in (0, 0, 1))
        assert np.array_equal(weights(first), weights(again))
        assert not np.array_equal(weights(first), weights(other))
        # Without biases and with tanh, what holds at +5 degC holds at -5.
        assert not any(bias.any() for _, bias in first.layers)
        assert first.provenance["seed"] == 0
        assert first.provenance["validation"].keys() == {"short"}

    def test_each_group_has_a_seed_that_no_comparison_has(self):
        plants = ppo.begin(RECIPE, 0).get_env()
        seeds = plants.seed(0)
        assert [seeds.count(seed) for seed in sorted(set(seeds))] == [ppo.GROUP] * 3
        assert min(seeds) >= 1 << 32
        # So the plants of a group do the same until their actions differ.
        plants.reset()
        rewards = plants.step(np.zeros((24, 1)))[1].reshape(3, ppo.GROUP)
        assert (rewards == rewards[:, :1]).all()
        assert len(set(rewards[:, 0])) == 3

    def test_plants_of_both_kinds_are_stepped_as_in_batches_of_their_own(self):
        noisy = {"max_episode_steps": 2, "noise_variance": 0.5}
        ending = [recipe.TrainingPlants(n, noisy) for n in (8, 16)]
        plants, alone = (ppo.TrainingVecEnv(replace(RECIPE, plants=ending)) for _ in range(2))
        actions = np.linspace(-1.0, 1.0, 24)[:, np.newaxis]
        seeds = plants.seed(3)
        plants.reset()
        plants.step(actions)
        inputs, rewards, _, infos = plants.step(actions)
        for batch, rows in zip(alone.batch.batches, (slice(8), slice(8, 24)), strict=True):
            batch.reset(seed=seeds[rows])
            batch.step(actions[rows])
            observations, rewards_alone, _, _, infos_alone = batch.step(actions[rows])
            last = np.array([info["terminal_observation"] for info in infos[rows]])
            last_alone = np.stack(infos_alone["final_obs"])
            np.testing.assert_allclose(rewards[rows], rewards_alone, rtol=1e-6)
            matrix = recipe.inputs(RECIPE).T
            np.testing.assert_allclose(inputs[rows], observations @ matrix, atol=1e-5)
            np.testing.assert_allclose(last, last_alone @ matrix, atol=1e-5)

    def test_what_a_group_has_in_common_is_no_advantage(self):
        model = ppo.begin(RECIPE, 0)
        spaces = model.observation_space, model.action_space
        buffer, plain = (
            kind(3, *spaces, gamma=0.9, n_envs=16) for kind in (ppo.GroupBuffer, RolloutBuffer)
        )
        rewards = np.random.default_rng(0).normal(size=(3, 16)).astype(np.float32)
        common = np.repeat([[1.0, 5.0]], ppo.GROUP, axis=1).astype(np.float32)
        advantages = []
        for kind, more in ((buffer, 0.0), (buffer, common), (plain, 0.0)):
            kind.reset()
            kind.rewards[:] = rewards + more
            kind.compute_returns_and_advantage(torch.zeros(16), np.zeros(16))
            advantages.append(kind.advantages.copy())
        np.testing.assert_allclose(advantages[0], advantages[1], atol=1e-5)
        apart = (advantages[2] - advantages[0]).reshape(3, 2, ppo.GROUP)
        assert np.ptp(apart, axis=2).max() < 1e-5


class TestExport:
    def test_changes_by_hand(self):
        window = [8.0, 6.0, 5.0, 1.0, 4.0, 4.0, 0.0]  # newest first
        # Means of 8, of 6, of 5 and 1, and of the rest.
        changes = recipe.changes(7, short_stretches=2) @ window
        assert changes.tolist() == pytest.approx([2.0, 3.0, 3.0 - 8.0 / 3.0])

    @pytest.mark.parametrize(
        ("trained", "scale"),  # of the action: with limits that matter
        [(RECIPE, 300.0), (replace(RECIPE, levels=True, hidden=(), dead_zone=0.0), 1.0)],
    )
    def test_without_torch_it_acts_as_in_training(self, trained, scale):
        model = ppo.begin(trained, 5)
        with torch.no_grad():
            model.policy.action_net.weight.mul_(scale)
        network = ppo.export(model, trained)
        plants = make_plants(3, 80, setpoint=5.0, noise_variance=0.5, **network.interface)
        observations, _ = plants.reset(seed=1)
        moves = []
        for _ in range(80):
            inputs = observations @ recipe.inputs(trained).T
            moves.append(model.predict(inputs, deterministic=True)[0])
            np.testing.assert_allclose(network.act(observations), moves[-1], atol=1e-3)
            observations, *_ = plants.step(moves[-1])
        assert (np.abs(moves).max() == 1.0) == (scale > 1.0)


@pytest.mark.parametrize("name", recipe.RECIPES)
def test_those_of_the_project_are_of_the_recipes_and_the_search_is_that_of_its_log(name):
    log = pd.read_csv(ROOT / "benchmarks/published/ppo_trials.csv")
    trials = log[log.policy == name]
    samples, minutes = trials.samples.sum() / 1e6, trials.cpu_seconds.sum() / 60
    said = f"{len(trials)} trials: {samples:.0f} M samples, {minutes:.0f} min"
    assert ROSTER[name].searched.endswith(said)
    of_name = recipe.RECIPES[name]
    settings = json.loads(json.dumps(program.flattened(ppo.settings_of(of_name))))
    files = {seed: f"{name}-{seed}.npz" for seed in range(program.SEED, program.SEED + 5)}
    assert ROSTER[name].trainings == [*files.values()]
    for seed, file in files.items():
        network = PolicyNetwork.load(PRETRAINED / file)
        assert network.provenance["seed"] == seed
        written = program.flattened(network.provenance)
        for key in settings.keys() - ppo.SETTINGS.keys():  # which this module makes smaller
            assert settings[key] == written[key]
        count = sum(W.size for W, _ in network.layers)
        assert f"{count:,} weights" in ROSTER[name].searched
        assert f": {of_name.steps / 1e6:g} M samples per policy" in ROSTER[name].searched


def test_the_recipe_for_another_plant_is_that_of_the_paper_plant_scaled():
    plant = {"b": [0.0456, 0.00404], "setpoint_amplitude": 10.0, "dead_zone": 2.0}
    scaled, paper = recipe.for_plant(plant), recipe.for_plant({})
    assert [count for count, _ in scaled.plants] == [152, 360]
    for _, arguments in scaled.plants:
        assert arguments["b"] == plant["b"]
        assert (arguments["setpoint"], arguments["setpoint_amplitude"]) == ("random", 12.0)
    assert scaled.dead_zone == 2.0
    # Of twice as large temperatures and the same flows, the inputs are the same.
    observation = np.random.default_rng(0).normal(size=sum(paper.windows.values()))
    factors = np.where(np.arange(observation.size) < 4 + paper.memory, 2.0, 1.0)
    np.testing.assert_allclose(
        recipe.inputs(scaled) @ (factors * observation), recipe.inputs(paper) @ observation
    )
    assert paper.plants == recipe.RECIPES["ppo"].plants
