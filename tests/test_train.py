"""Training: through the plant, what is differentiated and chosen; by PPO, what groups share."""

import json
from dataclasses import asdict, replace

import numpy as np
import pandas as pd
import pytest
import torch
from stable_baselines3.common.buffers import RolloutBuffer

from agents import PolicyNetwork, RecurrentNetwork
from agents.networks import PRETRAINED
from benchmarks.controllers.options import chosen
from benchmarks.controllers.roster import ROSTER
from benchmarks.examples import sb3
from benchmarks.loop.rollout import make_plants, rollout
from benchmarks.train import __main__ as program
from benchmarks.train import neural, ppo
from benchmarks.train.neural import (
    Loops,
    Net,
    Training,
    chance_of_change,
    expected_error,
    mean_distance,
)
from benchmarks.train.plants import HOLD_TIMES, Sampler, environment
from mptc_gym import Parameters
from mptc_gym.wrappers.vector import IncrementalAction
from tests.conftest import ROOT

SMALL = Training(steps=2, plants=4, segment=60, nodes=3, hidden=2, validation_episodes=2)
RECIPE = replace(
    ppo.RECIPES["ppo"],
    plants=(
        ppo.TrainingPlants(8, {"setpoint": "random"}),
        ppo.TrainingPlants(16, {"setpoint": "random", "noise_variance": 0.5}),
    ),
    cases={"short": {"max_episode_steps": 20}},
    hidden=(8,),
    memory=40,
    steps=512,
)


@pytest.fixture(autouse=True)
def small(monkeypatch):
    for name, value in {"n_steps": 32, "batch_size": 64}.items():
        monkeypatch.setitem(sb3.SETTINGS, name, value)


class TestExpectedError:
    def test_it_is_the_mean_of_what_happens(self):
        # Of plants like those of `hard`, in which nothing was chosen by the draw.
        batch = Sampler(400, 1.0, seed=1).batch()
        net = Net(nodes=2, hidden=2)
        with torch.no_grad():
            outputs, factors = Loops(environment(400), batch, net, seed=1).run(400)
            expected = expected_error(outputs, batch, factors, 1)
        errors = (batch.setpoints[1:401] - outputs).abs()
        reached = torch.arange(1, 401)[:, None] > batch.numbers["delay"]
        assert expected.item() == pytest.approx(errors[reached].mean().item(), rel=0.03)

    def test_changes_have_the_chance_that_the_environment_gives_them(self):
        lengths = np.arange(HOLD_TIMES[0], HOLD_TIMES[1] + 1)
        for age, samples in ((0, 19), (85, 19), (150, 25), (270, 19), (299, 13)):
            left = lengths[lengths > age]
            share = (left <= age + samples).mean()
            chance = chance_of_change(torch.tensor([float(age)]), torch.tensor([samples]))
            assert chance.item() == pytest.approx(share, abs=1e-6)

    def test_the_distance_is_that_of_a_sample(self):
        noise = torch.randn(200_000, generator=torch.Generator().manual_seed(0))
        for distance, deviation in ((0.0, 1.0), (0.7, 0.5), (-2.0, 0.1)):
            mean = mean_distance(torch.tensor(distance), torch.tensor(deviation))
            sampled = (distance + deviation * noise).abs().mean()
            assert mean.item() == pytest.approx(sampled.item(), rel=0.01)


class TestSampler:
    def test_an_exact_step_test_leaves_one_model(self):
        batch = Sampler(200, 0.0, seed=2).batch()
        prior, delays = batch.prior, batch.numbers["delay"].numpy()
        exact = prior.gain_spread < 0.01
        assert 0.3 < exact.mean() < 0.7
        likely = prior.log_probabilities[:, :, exact] > -100.0
        assert (likely.sum((0, 1)) == 1).all()
        place = likely.any(1).argmax(0)
        np.testing.assert_array_equal(prior.shortest_delays[exact] + place, delays[exact])

    def test_set_points_of_others_are_held_longer_than_any_of_hard(self):
        batch = Sampler(100, 0.0, seed=3).batch()
        changes = (batch.setpoints.diff(dim=0) != 0.0).nonzero()
        for plant in range(100):
            times = changes[changes[:, 1] == plant, 0]
            assert (times.diff() > HOLD_TIMES[1]).all()


def test_a_seed_gives_a_network_that_differs_from_that_of_another():
    first, again, other = (neural.train(SMALL, seed).weights for seed in (0, 0, 1))
    for name, values in first.items():
        np.testing.assert_array_equal(values, again[name])
    assert not np.array_equal(first["output_biases"], other["output_biases"])


def test_those_of_the_project_are_of_the_recipe():
    members = ROSTER["neural-self-tuning"].members()
    files = [member.provenance["file"] for member in members]
    assert files == [f"neural-{seed}.npz" for seed in range(10_000, 10_005)]
    recipe = json.loads(json.dumps(asdict(neural.RECIPES["neural"])))
    for file in files:
        network = RecurrentNetwork.load(PRETRAINED / file)
        assert network.provenance["training"] == recipe
        count = sum(values.size for values in network.weights.values())
        assert f"{count:,} weights" in ROSTER["neural-smith"].searched


@pytest.mark.parametrize(
    ("network", "steps", "files"),
    [("neural", 2, {"neural-10000", "neural-10001"}), ("ppo", 8, {"ppo-10000", "ppo-10001"})],
)
def test_the_command_lists_trainings_by_their_seeds(
    network, steps, files, tmp_path, capsys, monkeypatch
):
    monkeypatch.setitem(neural.RECIPES, "neural", SMALL)
    short = {
        "plants": (ppo.TrainingPlants(64, {}),),
        "cases": {"short": {"max_episode_steps": 20}},
    }
    monkeypatch.setitem(ppo.RECIPES, "ppo", replace(ppo.RECIPES["ppo"], **short))
    arguments = [network, "--networks", "2", "--steps", str(steps), "--jobs", "1"]
    assert program.main([*arguments, "--out", str(tmp_path)]) == 0
    shown = capsys.readouterr().out
    assert {"10000", "10001"} <= set(shown.split())
    folder = tmp_path / network
    assert {file.stem for file in folder.glob("*.npz")} == files


def weights(network):
    return np.concatenate([array.ravel() for layer in network.layers for array in layer])


class TestPPO:
    def test_a_seed_gives_a_policy_that_differs_from_that_of_another(self):
        first, again, other = (ppo.train(RECIPE, seed) for seed in (0, 0, 1))
        assert np.array_equal(weights(first), weights(again))
        assert not np.array_equal(weights(first), weights(other))
        # Without biases and with tanh, what holds at +5 degC holds at -5.
        assert not any(bias.any() for _, bias in first.layers)
        about = first.provenance
        assert about["seed"] == 0
        assert about["steps"] >= RECIPE.steps
        assert about["cpu_seconds"] > 0.0
        assert about["validation"].keys() == {"short"}
        json.dumps(about)

    def test_each_group_has_a_seed_that_no_comparison_has(self):
        plants = ppo.begin(RECIPE, 0).get_env()
        plants.reset()
        seeds = {seed for batch in plants.batches for seed in batch.unwrapped.np_random_seed}
        assert len(seeds) == 3
        assert min(seeds) >= 1 << 32

    def test_what_a_group_has_in_common_is_no_advantage(self):
        model = ppo.begin(RECIPE, 0)
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


class TestExport:
    def test_changes_by_hand(self):
        window = torch.tensor([[8.0, 6.0, 5.0, 1.0, 4.0, 4.0, 0.0]])  # newest first
        # Means of 8, of 6, of 5 and 1, and of the rest.
        assert sb3.changes(window, 2)[0].tolist() == pytest.approx([2.0, 3.0, 3.0 - 8.0 / 3.0])

    @pytest.mark.parametrize(
        ("recipe", "scale"),  # of the action: with limits that matter
        [(RECIPE, 300.0), (replace(RECIPE, levels=True, hidden=(), dead_zone=0.0), 1.0)],
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
def test_those_of_the_project_are_of_the_recipes_and_the_search_is_that_of_its_log(name):
    log = pd.read_csv(ROOT / "benchmarks/published/ppo_trials.csv")
    trials = log[log.policy == name]
    samples, minutes = trials.samples.sum() / 1e6, trials.cpu_seconds.sum() / 60
    said = f"{len(trials)} trials: {samples:.0f} M samples, {minutes:.0f} min"
    assert ROSTER[name].searched.endswith(said)
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


class TestOtherPlants:
    PLANT = {"b": [0.0456, 0.00404], "setpoint_amplitude": 10.0, "dead_zone": 2.0}  # noqa: RUF012

    def test_the_recipe_is_that_of_the_paper_plant_scaled(self):
        recipe, paper = ppo.for_plant(self.PLANT), ppo.for_plant({})
        assert [count for count, _ in recipe.plants] == [152, 360]
        for _, arguments in recipe.plants:
            assert arguments["b"] == self.PLANT["b"]
            assert (arguments["setpoint"], arguments["setpoint_amplitude"]) == ("random", 12.0)
        assert recipe.dead_zone == 2.0
        # Of twice as large temperatures and the same flows, the inputs are the same.
        observation = np.ones(sum(recipe.windows.values()))
        scaled = np.where(np.arange(observation.size) < 4 + recipe.memory, 2.0, 1.0)
        rng = np.random.default_rng(0)
        observation = rng.normal(size=observation.size)
        np.testing.assert_allclose(
            ppo.features(recipe) @ (scaled * observation), ppo.features(paper) @ observation
        )
        assert ppo.for_plant({}).plants == ppo.RECIPES["ppo"].plants

    def test_what_is_trained_is_run_by_compare_on_this_plant(self, tmp_path, monkeypatch):
        short = replace(ppo.RECIPES["ppo"], plants=(ppo.TrainingPlants(8, {}),) * 2)
        monkeypatch.setitem(ppo.RECIPES, "ppo", short)
        given = "ppo --networks 2 --steps 8 --jobs 1 --set b=[0.0456,0.00404] --set u_max=12"
        assert program.main([*given.split(), "--out", str(tmp_path)]) == 0
        files = sorted(tmp_path.glob("ppo-plant/*.npz"))
        assert len(files) == 2
        (spec,) = chosen([], [f"mine={file}" for file in files]).values()
        assert [each.provenance["file"] for each in spec.members()] == [*map(str, files)]
        rising = {"b": [0.0456, 0.00404], "u_max": 12.0}
        assert spec.misfit(Parameters(**rising)) == ""
        assert "positive feedback" in spec.misfit(Parameters())
        run = spec.members()[0].run({**rising, "setpoint": 5.0}, 20, 1, 0)
        assert np.isfinite(run.output).all()
