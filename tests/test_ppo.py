"""Training PPO: validated, seeded, and kept in NumPy."""

import pickle
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch

from benchmarks.controllers.pretrained import ppo_policies, trained
from benchmarks.lib.fan_out import FanOut, TasksFailedError
from benchmarks.loop.rollout import make_plants, rollout
from benchmarks.train import ppo, ppo_training
from benchmarks.train.ppo import PolicyRequest
from mptc_gym import Parameters
from mptc_gym.wrappers.vector import IncrementalAction
from tests.small_training import SMALL


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr(ppo_training, "VALIDATION_INTERVAL", 256)
    monkeypatch.setattr(ppo_training, "PROBE", replace(ppo_training.PROBE, samples=20))
    monkeypatch.setattr(ppo_training, "HELD", ppo_training.HELD[:20])


def members(folder, arguments=SMALL, *, jobs=1, policies=2, **request):
    request = PolicyRequest(FanOut(jobs=jobs), folder, policies=policies, **request)
    return ppo.members(request, arguments)


def train(folder, arguments=SMALL, **request):
    (policy,) = members(folder, arguments, policies=1, **request).values()
    return policy


def weights(network):
    return np.concatenate([array.ravel() for layer in network.layers for array in layer])


def parameters_of(model):
    return torch.cat([p.detach().flatten() for p in model.policy.parameters()])


class TestPPO:
    def test_learning_curve_and_provenance_are_kept(self, tmp_path):
        provenance = train(tmp_path).provenance
        curve = pd.DataFrame(provenance["curve"])
        assert list(curve["steps"]) == [256, 512, 768, 1024]
        assert (curve[["training_mae", "validation_mae", "square_mae"]] > 0).all(axis=None)
        assert curve["seconds"].is_monotonic_increasing
        assert provenance["arguments"]["n_envs"] == SMALL.n_envs
        assert {"python", "torch", "stable_baselines3"} <= set(provenance["versions"])

    def test_starts_differ_in_all_that_is_random(self):
        first, second = (ppo_training.begin(SMALL, start=start) for start in (0, 1))
        assert not torch.equal(parameters_of(first), parameters_of(second))
        seeds = []
        for model in (first, second):
            model.get_env().reset()
            for batch in model.get_env().batches:
                seeds += batch.unwrapped.np_random_seed
        assert len(set(seeds)) == 2 * SMALL.n_envs
        assert min(seeds) >= 1 << 32  # no comparison has any so large

    def test_key_names_all_that_shapes_a_policy(self):
        others = {"seed": 1, "gamma": 0.9, "noise_variance": 0.1, "max_move": 0.3}
        changed = [replace(SMALL, **{name: value}) for name, value in others.items()]
        assert len({ppo.policy_key(each) for each in (SMALL, *changed)}) == 5
        assert ppo.policy_key(SMALL) == ppo.policy_key(replace(SMALL))

    def test_some_of_the_plants_are_calm(self):
        arguments = replace(SMALL, n_envs=8, calm=0.75)
        assert [count for count, _ in arguments.plants] == [2, 6]
        plants = ppo_training.begin(arguments).get_env()
        plants.seed(0)
        plants.reset()
        plants.step(np.zeros((8, 1), np.float32))
        assert [noise != 0.0 for noise in plants.infos["noise"]] == [True] * 2 + [False] * 6
        assert [count for count, _ in replace(SMALL, calm=0.0).plants] == [4]
        assert [count for count, _ in replace(SMALL, calm=1.0).plants] == [4]

    def test_the_action_changes_the_flow_and_the_dead_zone_is_compensated(self):
        plants = ppo_training.begin(replace(SMALL, max_move=0.2)).get_env()
        plants.seed(0)
        plants.reset()
        flows = []
        for action in (1.0, 1.0, -1.0):
            plants.step(np.full((SMALL.n_envs, 1), action, np.float32))
            flows.append(plants.infos["applied"][0])
        # 0.2, 0.4 and 0.2 of the 5 t/h between dead zone and limit.
        assert flows == pytest.approx([6.0, 7.0, 6.0], abs=1e-4)

    def test_set_points_of_validation_are_met_nowhere_else(self):
        flows = np.abs(ppo_training.HELD) * 0.07273 / 0.04964  # t/h, by the steady-state gain
        assert flows.min() > ppo_training.VALIDATION_DEAD_ZONE > Parameters().dead_zone
        assert flows.max() < Parameters().u_max
        assert not {5.0, -5.0} & set(ppo_training.HELD)
        assert ppo_training.VALIDATION_DEAD_ZONE != 7.0

    def test_the_best_in_validation_is_kept(self, tmp_path, monkeypatch):
        seen = []

        def scores(keeper, arguments, runs, samples, seed):
            if seed == ppo_training.VALIDATION_SEED:
                seen.append(ppo_training.exported(keeper.model.policy.state_dict(), SMALL))
                return [1.0, 2.0, 1.0, 2.5][len(seen) - 1]
            if arguments.get("dead_zone") == 6.5:
                return [3.0, 2.0, 1.5, 2.5][len(seen) - 1]
            return [5.0, 0.0, 3.0, 0.5][len(seen) - 1]

        monkeypatch.setattr(ppo_training.Keeper, "_mae", scores)
        kept = weights(train(tmp_path))  # sums are 9, 4, 5.5 and 5.5
        assert len(seen) == 4
        assert np.array_equal(kept, weights(seen[1]))
        assert not np.array_equal(kept, weights(seen[3]))

    def test_exploration_falls_as_set(self, tmp_path, monkeypatch):
        spreads = []
        record = ppo_training.Keeper.record

        def spy(keeper):
            record(keeper)
            spreads.append((keeper.num_timesteps, keeper.model.policy.log_std.item()))

        monkeypatch.setattr(ppo_training.Keeper, "record", spy)
        train(tmp_path, replace(SMALL, log_std=(-1.0, -3.0)))
        # In each start; at the end it is still that of the last rollout, of 128 samples.
        expected = [(256, -2.0), (512, -2.5)] * 2
        assert np.array(spreads) == pytest.approx(np.array(expected), abs=1e-3)

    def test_what_the_networks_see(self):
        parameters = Parameters(error_window=3, action_window=4)
        observation = np.array([5, 5, -4, 2, 1, -1, 0.5, 0.2, 0.1, -0.3])
        assert ppo_training.features(parameters) @ observation == pytest.approx([
            2.0, 1.0, 0.5,  # error, a fifth of the set point, flow
            0.0, 0.9,  # a tenth of the change of the set point
            0.5, 1.0,  # half the change of the error
            0.6, 0.2, 0.8,  # twice the moves
        ])  # fmt: skip

    def test_a_policy_is_as_good_upside_down(self):
        model = ppo_training.begin(SMALL)
        moments = torch.optim.Adam(model.policy.parameters())  # as training changes them
        observations = torch.randn(50, 27, generator=torch.Generator().manual_seed(0))
        loss = model.policy.get_distribution(observations).log_prob(torch.ones(50, 1)).sum()
        loss.backward()
        moments.step()
        up, _ = model.predict(observations.numpy(), deterministic=True)
        down, _ = model.predict(-observations.numpy(), deterministic=True)
        assert np.abs(up).max() > 0.01
        np.testing.assert_allclose(up, -down, atol=1e-6)


@pytest.mark.parametrize("scale", [1.0, 300.0])  # of the action: with limits that matter
def test_without_torch_a_policy_does_what_it_does_in_its_wrapper(scale):
    model = ppo_training.begin(replace(SMALL, seed=5))
    with torch.no_grad():
        model.policy.action_net.weight.mul_(scale)
    network = ppo_training.exported(model.policy.state_dict(), SMALL)
    plants = make_plants(3, 80, setpoint=5.0, noise_variance=0.5, **SMALL.observation)
    run = rollout(plants, network, 80, seed=1)
    wrapped = IncrementalAction(plants, max_move=SMALL.max_move, compensate_dead_zone=5.0)
    observations, info = wrapped.reset(seed=1)
    moves = []
    for k in range(80):
        np.testing.assert_allclose(run.output[k], info["output"], atol=1e-3)
        moves.append(model.predict(observations, deterministic=True)[0])
        observations, *_, info = wrapped.step(moves[-1])
        np.testing.assert_allclose(run.applied[k], info["applied"], atol=1e-3)
    assert np.ptp(run.applied) > 1.0
    assert (np.abs(moves).max() == 1.0) == (scale > 1.0)
    assert np.mean(np.abs(moves)) < 0.9


def test_a_damaged_policy_is_named(tmp_path):
    file = tmp_path / ppo.policy_key(SMALL) / "policy.npz"
    file.parent.mkdir()
    for content in (b"", b"half of it", pickle.dumps(SMALL)):
        file.write_bytes(content)
        with pytest.raises(ValueError, match=r"damaged.*remove it, or --retrain") as error:
            train(tmp_path)
        assert str(file) in str(error.value)
    train(tmp_path, retrain=True)


class TestMembers:
    def test_a_controller_is_told_the_dead_zone_of_its_plant(self, tmp_path):
        network = train(tmp_path)
        observation = np.random.default_rng(0).normal(size=network.n_obs)
        for given, edge in ((7.0, 0.7), (5.0, 0.5), ([3.0, 7.0], 0.5)):
            controller = trained(network, Parameters(dead_zone=given), 1, 0)
            assert controller.increments.dead_zone == 10.0 * edge
            # At its first move the policy is just beyond the edge of the dead zone.
            position = (abs(controller.act(observation)[0]) - edge) / (1.0 - edge)
            assert 0.0 < position < 0.2
        assert network.increments.dead_zone == 5.0  # is not changed by it

    def test_another_process_trains_the_same_policy(self, tmp_path, monkeypatch):
        monkeypatch.undo()  # other processes would not know of it
        first, second = members(tmp_path / "one").values()
        (again,) = members(tmp_path / "two", jobs=2, policies=1).values()
        assert np.array_equal(weights(first), weights(again))
        assert not np.array_equal(weights(first), weights(second))
        assert [each.provenance["arguments"]["seed"] for each in (first, second)] == [0, 1]
        assert [each.provenance["curve"][-1]["steps"] for each in (first, second)] == [1024] * 2

    def test_only_what_is_missing_is_trained(self, tmp_path):
        files = [*members(tmp_path)]
        stamps = [file.stat().st_mtime_ns for file in files]
        files[1].unlink()
        members(tmp_path)
        again = [file.stat().st_mtime_ns for file in files]
        assert again[0] == stamps[0]
        assert again[1] > stamps[1]
        members(tmp_path, retrain=True)
        assert files[0].stat().st_mtime_ns > stamps[0]

    def test_one_that_fails_does_not_stop_the_others(self, tmp_path, monkeypatch):
        whole = ppo_training.train

        def faulty(arguments):
            if arguments.seed == 0:
                raise RuntimeError("out of memory")
            return whole(arguments)

        monkeypatch.setattr(ppo_training, "train", faulty)
        with pytest.raises(TasksFailedError, match=r"1 of 2 tasks failed(.|\n)*out of memory"):
            members(tmp_path)
        assert len(list(tmp_path.glob("*/policy.npz"))) == 1

    def test_a_policy_goes_along_to_where_its_file_is_not(self, tmp_path, monkeypatch):
        monkeypatch.setattr(ppo, "PPOArguments", lambda: SMALL)
        request = PolicyRequest(folder=tmp_path, policies=1)
        (factory,) = ppo_policies(request)
        packed = pickle.dumps(factory)
        ((file, policy),) = ppo.members(request).items()
        file.unlink()
        made = pickle.loads(packed)({}, 1, 0)
        assert np.array_equal(weights(made), weights(policy))

    def test_published_policies_are_taken_if_they_were_trained_like_this(
        self, tmp_path, monkeypatch
    ):
        monkeypatch.setattr(ppo, "PRETRAINED", tmp_path / "shipped")
        own = members(tmp_path / "kept")
        (tmp_path / "shipped").mkdir()
        for seed, policy in enumerate(own.values()):
            policy.save(tmp_path / "shipped" / ppo.file_name(seed))
        shipped = members(tmp_path / "none")
        assert [file.name for file in shipped] == ["ppo-0.npz", "ppo-1.npz"]
        for one, other in zip(own.values(), shipped.values(), strict=True):
            assert np.array_equal(weights(one), weights(other))
        # Those that were trained here come first, and others are trained where asked for.
        assert members(tmp_path / "kept").keys() == own.keys()
        for anew in (
            members(tmp_path / "anew", policies=1, retrain=True),
            members(tmp_path / "anew", policies=1, steps=256),
        ):
            assert [file.parent.parent for file in anew] == [tmp_path / "anew"]

    def test_the_policies_of_the_project_are_those_of_the_defaults(self):
        for file, policy in ppo.members(PolicyRequest()).items():
            assert file.parent.name == "pretrained"
            assert policy.provenance["curve"][-1]["steps"] >= 1_196_032
        factories = ppo_policies(PolicyRequest())
        assert [each.provenance["arguments"]["seed"] for each in factories] == [
            *range(10_000, 10_005)
        ]
        assert {each.cost.samples for each in factories} == {"1.19603 M a policy"}
