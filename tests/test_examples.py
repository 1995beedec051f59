"""The examples run, with little to learn from, and do what they say."""

import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from stable_baselines3 import PPO

from agents import PIController
from benchmarks.examples import cleanrl_style, sb3

ROOT = Path(__file__).parent.parent


def run(*words):
    return subprocess.run(
        [sys.executable, *words], cwd=ROOT, capture_output=True, text=True, timeout=300
    )


def weights(network):
    return torch.cat([p.detach().flatten() for p in network.parameters()])


class TestSB3:
    @pytest.fixture(autouse=True)
    def small(self, monkeypatch):
        quick = partial(PPO, n_steps=32, batch_size=32, n_epochs=1)
        monkeypatch.setitem(sb3.ALGORITHMS, "ppo", quick)
        monkeypatch.setattr(sb3, "SAMPLES", 30)

    def test_curves_are_shown_kept_and_drawn(self, tmp_path, capsys):
        command = ["--steps", "64", "--interval", "32", "--out", str(tmp_path)]
        sb3.main([*command, "--seed", "3", "--seeds", "2"])
        assert capsys.readouterr().out.count("mae") == 4
        sb3.main([*command, "--seed", "4"])  # in place of the same curve
        sb3.main([*command, "--seed", "4", "--env", "error_scale=50", "setpoint=random"])
        curves = pd.read_csv(tmp_path / "default_sb3.csv")
        assert curves.groupby("arguments")["seed"].apply(list).to_dict() == {
            "{}": [3, 3, 4, 4],
            '{"error_scale": 50, "setpoint": "random"}': [4, 4],
        }
        assert list(curves["steps"]) == [32, 64] * 3
        picture = tmp_path / "default_sb3.png"
        assert picture.stat().st_size > 10_000
        picture.unlink()
        sb3.main([*command, "--plot"])
        assert picture.exists()
        pd.testing.assert_frame_equal(curves, pd.read_csv(tmp_path / "default_sb3.csv"))

    def test_sac_learns_from_it_too(self, capsys):
        sb3.main(["--algorithm", "sac", "--steps", "110", "--interval", "55"])
        assert [line.split()[7] for line in capsys.readouterr().out.splitlines()] == [
            "55",
            "110",
        ]

    def test_arguments_reach_the_plant(self):
        with pytest.raises(ValueError, match="error_scale must be"):
            sb3.main(["--steps", "32", "--env", "error_scale=-1"])

    def test_nothing_is_drawn_from_nowhere(self, capsys):
        with pytest.raises(SystemExit):
            sb3.main(["--plot"])
        assert "--plot needs --out" in capsys.readouterr().err

    def test_looking_does_not_disturb_the_training(self, monkeypatch):
        models, quick = [], sb3.ALGORITHMS["ppo"]

        def remember(*arguments, **options):
            models.append(quick(*arguments, **options))
            return models[-1]

        monkeypatch.setitem(sb3.ALGORITHMS, "ppo", remember)
        for interval in (7, 1000):
            sb3.train("ppo", 64, seed=0, interval=interval, arguments={})
        assert torch.equal(*(weights(model.policy) for model in models))


def test_what_policies_are_compared_with():
    class Idle:
        def reset(self):
            pass

        def act(self, observation):
            return np.zeros((1, 1))

    assert sb3.square_error(Idle()) == sb3.DOING_NOTHING
    runs = pd.read_csv(ROOT / "benchmarks/published/estimates.csv")
    runs = runs[runs["scenario"] == "square"].set_index("agent")
    assert sb3.square_error(PIController()) == pytest.approx(runs["mean"]["pi"])
    assert pytest.approx(runs["limit"]["pi"], abs=5e-4) == sb3.POSSIBLE


class TestOnOnePage:
    SMALL = cleanrl_style.Arguments(
        steps=512, num_envs=8, num_steps=16, epochs=2, minibatches=2, evaluations=2
    )

    def test_it_runs(self, capsys):
        cleanrl_style.main(["--steps", "1024", "--num-envs", "8", "--evaluations", "2"])
        assert capsys.readouterr().out.count("mean |e|") == 2

    def test_the_seed_is_all_that_differs(self):
        first, again, other = (
            weights(cleanrl_style.train(replace(self.SMALL, seed=seed))) for seed in (1, 1, 2)
        )
        assert torch.equal(first, again)
        assert not torch.equal(first, other)

    def test_an_episode_that_is_cut_off_is_worth_its_future(self):
        # gamma = lambda = 1/2. Backwards: 3 + 8/2 - 2 = 5, which ends an episode, so that what
        # is found after it does not count; then 2 + 4/2 - 2 = 2, plus 5/4; 1 + 2/2 - 4 = -2,
        # plus 3.25/4. The last, of the next episode: 1 + 6/2 - 0 = 4.
        rewards, values = torch.tensor([1.0, 2.0, 3.0, 1.0]), torch.tensor([4.0, 2.0, 2.0, 0.0])
        following, ends = torch.tensor([2.0, 4.0, 8.0, 6.0]), torch.tensor([0.0, 0.0, 1.0, 0.0])
        arguments = cleanrl_style.Arguments(gamma=0.5, gae_lambda=0.5)
        found = cleanrl_style.estimate(
            *(x[:, None] for x in (rewards, values, following, ends)), arguments
        )
        assert found[:, 0].tolist() == [-1.1875, 3.25, 5.0, 4.0]

    def test_values_at_an_end_are_those_of_the_last_observation(self, monkeypatch):
        monkeypatch.setitem(cleanrl_style.TRAINING, "max_episode_steps", 5)
        forward, estimate, kept = cleanrl_style.Agent.forward, cleanrl_style.estimate, []

        def error_for_a_value(agent, observations):
            return forward(agent, observations)[0], observations[:, 3]

        def spy(rewards, values, next_values, ends, arguments):
            kept.append([x.clone() for x in (rewards, values, next_values, ends)])
            return estimate(rewards, values, next_values, ends, arguments)

        monkeypatch.setattr(cleanrl_style.Agent, "forward", error_for_a_value)
        monkeypatch.setattr(cleanrl_style, "estimate", spy)
        cleanrl_style.train(self.SMALL)
        for rewards, values, next_values, ends in kept:
            # The reward is that of the error that a step leads to, also at an end.
            torch.testing.assert_close(next_values.abs(), -50.0 * rewards)
            went_on = ends[:-1] == 0.0
            assert torch.equal(next_values[:-1][went_on], values[1:][went_on])
            assert not torch.equal(next_values[:-1][~went_on], values[1:][~went_on])
        assert torch.stack([ends for *_, ends in kept]).mean() == pytest.approx(0.2, abs=0.02)


def test_controllers_need_neither_torch_nor_sb3():
    program = """
import runpy, sys
for name in ("torch", "stable_baselines3", "scipy", "pandas", "matplotlib"):
    sys.modules[name] = None  # an import is an error from now on
sys.argv = ["torch_free", "--steps", "600", "--seed", "2"]
runpy.run_module("benchmarks.examples.torch_free", run_name="__main__")
"""
    done = run("-c", program)
    assert done.returncode == 0, done.stderr
    errors = {line.split(":")[0]: float(line.split()[-2]) for line in done.stdout.splitlines()}
    assert 0.9 < errors["NN"] < errors["PI"] < 5.0


def test_rllib_trains_on_it():
    found = run("-c", "import ray.rllib")
    if found.returncode:
        why = found.stderr.strip().splitlines()[-1]
        pytest.skip(f"RLlib is not installed (pip install -e '.[bench,rllib]'): {why}")
    done = run("-m", "benchmarks.examples.rllib", "--steps", "500", "--batch", "250")
    assert done.returncode == 0, done.stderr
    shown = [line for line in done.stdout.splitlines() if "mean |e|" in line]
    assert [line.split()[0] for line in shown] == ["250", "500"]
