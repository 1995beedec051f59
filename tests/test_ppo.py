"""Training PPO: resumed, cached, validated, and seeded."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch

from benchmarks.controllers.roster import Training
from benchmarks.lib.fan_out import FanOut
from benchmarks.train import ppo
from mptc_gym import Parameters
from tests.small_training import SMALL


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr(ppo, "CHECKPOINT_INTERVAL", 256)
    monkeypatch.setattr(ppo, "PROBE", replace(ppo.PROBE, samples=20))
    monkeypatch.setattr(ppo, "VALIDATION_SAMPLES", 20)
    monkeypatch.setattr(ppo, "HELD", ppo.HELD[:20])


def train(folder, arguments=SMALL, *, retrain=False):
    return ppo.trained_policy(arguments, folder, retrain=retrain, progress=False)


def weights(model):
    return torch.cat([p.detach().flatten() for p in model.policy.parameters()])


class TestPPO:
    def test_a_finished_policy_is_loaded(self, tmp_path, monkeypatch):
        trained = train(tmp_path)
        with monkeypatch.context() as patch:
            patch.setattr(ppo.PPO, "learn", None)  # training again would raise
            loaded = train(tmp_path)
        assert torch.equal(weights(loaded), weights(trained))
        stamp = (tmp_path / "policy.zip").stat().st_mtime_ns
        train(tmp_path, retrain=True)
        assert (tmp_path / "policy.zip").stat().st_mtime_ns > stamp

    @pytest.mark.parametrize("name", ["policy.zip", "checkpoint.pkl"])
    def test_a_damaged_file_is_named(self, tmp_path, name):
        (tmp_path / "learning.csv").write_text("")
        (tmp_path / name).write_bytes(b"half of it")
        with pytest.raises(ValueError, match=r"damaged.*--retrain") as error:
            train(tmp_path)
        assert str(tmp_path) in str(error.value)
        train(tmp_path, retrain=True)

    def test_learning_curve_is_kept(self, tmp_path):
        train(tmp_path)
        curve = pd.read_csv(tmp_path / "learning.csv")
        assert list(curve["steps"]) == [256, 512, 768, 1024]
        assert (curve[["training_mae", "validation_mae", "square_mae"]] > 0).all(axis=None)
        assert curve["seconds"].is_monotonic_increasing

    @pytest.mark.parametrize("calls", [65, 100, 140])
    def test_interrupted_training_resumes_to_the_same_policy(
        self, tmp_path, monkeypatch, calls
    ):
        whole = train(tmp_path / "whole")
        keep = ppo.Keeper._on_step
        count = 0

        def interrupt(self):
            nonlocal count
            count += 1
            if count == calls:
                raise KeyboardInterrupt
            return keep(self)

        with monkeypatch.context() as patch:
            patch.setattr(ppo.Keeper, "_on_step", interrupt)
            with pytest.raises(KeyboardInterrupt):
                train(tmp_path / "parts")
        assert [path.name for path in (tmp_path / "parts").iterdir()] == ["checkpoint.pkl"]
        np.random.seed(0)  # noqa: NPY002 (whatever happens between)
        torch.manual_seed(0)
        parts = train(tmp_path / "parts")
        assert torch.equal(weights(parts), weights(whole))
        columns = ["steps", "training_mae", "validation_mae", "square_mae"]
        curves = [
            pd.read_csv(tmp_path / n / "learning.csv")[columns] for n in ("whole", "parts")
        ]
        pd.testing.assert_frame_equal(*curves)
        assert not (tmp_path / "parts" / "checkpoint.pkl").exists()

    def test_seed_is_honoured(self, tmp_path):
        first, again, other = (
            weights(train(tmp_path / name, replace(SMALL, steps=256, seed=seed)))
            for name, seed in (("first", 3), ("again", 3), ("other", 4))
        )
        assert torch.equal(first, again)
        assert not torch.equal(first, other)

    def test_key_names_all_that_shapes_a_policy(self, monkeypatch):
        keys = {
            ppo.policy_key(arguments)
            for arguments in (
                SMALL, replace(SMALL, seed=1), replace(SMALL, gamma=0.9),
                replace(SMALL, noise_variance=0.1),
            )
        }  # fmt: skip
        assert len(keys) == 4
        assert ppo.policy_key(SMALL) == ppo.policy_key(replace(SMALL))
        monkeypatch.setattr(ppo, "versions", lambda: {"torch": "another"})
        assert ppo.policy_key(SMALL) not in keys

    def test_it_is_trained_on_random_set_points_with_past_actions(self):
        parameters = Parameters(**SMALL.training)
        assert parameters.setpoint == "random"
        assert parameters.action_window == parameters.delay + 2
        assert parameters.noise_variance == SMALL.noise_variance

    def test_some_of_the_plants_are_calm(self):
        arguments = replace(SMALL, n_envs=8, calm=0.75)
        assert [count for count, _ in arguments.plants] == [2, 6]
        plants = ppo.begin(arguments).get_env()
        plants.seed(0)
        plants.reset()
        plants.step(np.zeros((8, 1), np.float32))
        assert [noise != 0.0 for noise in plants.infos["noise"]] == [True] * 2 + [False] * 6
        assert [count for count, _ in replace(SMALL, calm=0.0).plants] == [4]
        assert [count for count, _ in replace(SMALL, calm=1.0).plants] == [4]

    def test_a_policy_for_many_plants(self, tmp_path):
        arguments = replace(SMALL, steps=256, **ppo.RANDOMISED)
        train(tmp_path, arguments)
        kept = ppo.Policy(arguments, tmp_path)
        assert kept.observation == arguments.observation
        assert kept.observation["action_window"] == 38
        size = Parameters(**arguments.training).observation_size
        assert kept().act(np.zeros((5, size), np.float32)).shape == (5, 1)
        assert ppo.policy_key(arguments) != ppo.policy_key(replace(SMALL, steps=256))

    def test_set_points_of_validation_are_met_nowhere_else(self):
        flows = np.abs(ppo.HELD) * 0.07273 / 0.04964  # t/h, by the steady-state gain
        assert flows.min() > Parameters().dead_zone
        assert flows.max() < Parameters().u_max
        assert not {5.0, -5.0} & set(ppo.HELD)

    def test_the_best_in_validation_is_kept(self, tmp_path, monkeypatch):
        seen = []

        def scores(keeper, arguments, runs, samples, seed):
            if seed == ppo.VALIDATION_SEED and arguments["noise_variance"]:
                seen.append(weights(keeper.model))
                return [1.0, 2.0, 1.0, 2.5][len(seen) - 1]
            return [5.0, 0.0, 3.0, 0.5][len(seen) - 1]

        monkeypatch.setattr(ppo.Keeper, "_mae", scores)
        kept = weights(train(tmp_path))
        assert len(seen) == 4
        assert torch.equal(kept, seen[1])
        assert not torch.equal(kept, seen[3])

    def test_exploration_falls_as_set(self, tmp_path, monkeypatch):
        spreads = {}
        record = ppo.Keeper.record

        def spy(keeper):
            record(keeper)
            spreads[keeper.num_timesteps] = keeper.model.policy.log_std.item()

        monkeypatch.setattr(ppo.Keeper, "record", spy)
        train(tmp_path, replace(SMALL, log_std=(-1.0, -3.0), log_std_falls=(0.25, 0.75)))
        # Recorded after the value for the coming rollout is set, but for the last.
        assert spreads[256] == pytest.approx(-1.0)
        assert spreads[512] == pytest.approx(-2.0)
        assert spreads[768] == pytest.approx(-3.0)

    def test_inputs_are_scaled_by_fixed_numbers(self):
        model = ppo.begin(SMALL)
        observation = torch.arange(1.0, 29.0)
        scaled = model.policy.features_extractor(observation)
        assert scaled[:8].tolist() == pytest.approx([0.2 * i for i in range(1, 9)])  # degC
        assert scaled[8:].tolist() == list(range(9, 29))  # actions


class TestTrained:
    def members(self, folder, jobs, *, retrain=False):
        training = Training(FanOut(jobs), folder, members=2, retrain=retrain)
        ppo._loaded.cache_clear()
        return ppo.members(training, SMALL)

    def test_side_by_side_is_one_after_the_other(self, tmp_path, monkeypatch):
        monkeypatch.undo()  # other processes would not know of it
        ones = self.members(tmp_path / "one", jobs=1)
        twos = self.members(tmp_path / "two", jobs=2)
        first, second, third, fourth = (weights(policy()._model) for policy in (*ones, *twos))
        assert torch.equal(first, third)
        assert torch.equal(second, fourth)
        assert not torch.equal(first, second)
        assert [policy.provenance["arguments"]["seed"] for policy in ones] == [0, 1]
        assert [len(policy.curve) for policy in ones] == [1, 1]
        assert "0.001024 M a policy" in ones[0].account.samples

    def test_only_what_is_missing_is_trained(self, tmp_path, monkeypatch):
        folders = [policy.folder for policy in self.members(tmp_path, jobs=1)]
        stamps = [(folder / "policy.zip").stat().st_mtime_ns for folder in folders]
        (folders[1] / "policy.zip").unlink()
        self.members(tmp_path, jobs=1)
        again = [(folder / "policy.zip").stat().st_mtime_ns for folder in folders]
        assert again[0] == stamps[0]
        assert again[1] > stamps[1]
        self.members(tmp_path, jobs=1, retrain=True)
        assert (folders[0] / "policy.zip").stat().st_mtime_ns > stamps[0]

    def test_policies_that_were_trained_elsewhere_are_missed(self, tmp_path, monkeypatch):
        monkeypatch.setattr(
            ppo, "_train", lambda *_, **options: None
        )  # as on a machine with folders of its own
        with pytest.raises(FileNotFoundError, match="must share"):
            self.members(tmp_path, jobs=1)
