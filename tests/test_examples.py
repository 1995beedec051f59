"""The examples run, with little to learn from, and do what they say."""

import json
import re
import runpy
import sys
from functools import partial
from types import SimpleNamespace

import gymnasium
import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch
from stable_baselines3 import PPO

import mptc_gym.sb3
from benchmarks.datasets import arguments_of, record
from benchmarks.examples import offline, through_plant
from mptc_gym import evaluate
from mptc_gym.sb3 import load, spec_of
from tests.conftest import ROOT


def test_ppo_runs_as_one_file_of_its_own(tmp_path, monkeypatch, capsys):
    for package in ("benchmarks", "agents"):
        monkeypatch.setitem(sys.modules, package, None)  # an import is an error
    given = ["page", "--steps", "1", "--seed", "3", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", given)
    runpy.run_path(str(ROOT / "benchmarks/examples/sb3.py"), run_name="__main__")
    shown = capsys.readouterr().out
    found = re.search(r"MiddlePointNoisy-v0: mean error ([\d.]+)", shown)
    kept = load(tmp_path / "ppo-3.zip", device="cpu")
    noisy = evaluate(kept, spec_of(kept, "MiddlePointNoisy-v0"))
    assert f"{noisy.mean_error:.3f}" == found[1]


def test_stable_baselines3_learns_with_the_lines_of_the_page():
    page = (ROOT / "benchmarks/examples/clients.md").read_text(encoding="utf-8")
    lines = re.findall(r"^\| Stable-Baselines3.*?`(.+?)`", page, re.MULTILINE)
    short = partial(PPO, device="cpu", n_steps=8, batch_size=8, n_epochs=1, seed=0)
    names = {"PPO": short, "mptc_gym": mptc_gym, "gymnasium": gymnasium}
    models = [eval(line, names) for line in lines]
    assert [model.n_envs for model in models] == [1, 64]
    for model in models:
        assert model.learn(1).num_timesteps == 8 * model.n_envs


def test_offline_transitions_follow_one_another_within_an_episode():
    episodes = (SimpleNamespace(**episode) for episode in record("paper", "smith", 2))
    observations, actions, rewards, following = offline.transitions_of(episodes).tensors
    assert observations.shape == following.shape == (2400, 26)
    assert torch.equal(following[:1199], observations[1:1200])
    assert not torch.equal(following[1199], observations[1200])
    # The reward is minus the error that the step leads to, and the action is seen after it.
    torch.testing.assert_close(rewards[:, 0], -following[:, 3].abs())
    assert torch.equal(following[:, offline.LAST_ACTION], actions[:, 0])


def test_an_offline_actor_that_changes_nothing_leaves_the_valve_alone():
    actor = offline.Actor(np.repeat([50.0, 100.0, 1.0], [3, 3, 20]).astype(np.float32))
    torch.nn.init.zeros_(actor.layers[-1].weight)
    torch.nn.init.zeros_(actor.layers[-1].bias)
    # 5 degC, and nothing done: the square wave's error is 5 all the time.
    arguments = {**arguments_of("paper"), "setpoint": "square"}
    found = evaluate(offline.policy_of(actor), episodes=2, **arguments)
    assert found.mean_error == pytest.approx(5.0)


def test_the_notebook_runs_and_shows_what_it_showed(capsys):
    text = (ROOT / "benchmarks/examples/quickstart.ipynb").read_text(encoding="utf-8")
    cells = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
    names: dict[str, object] = {}
    for cell in cells:
        exec("".join(cell["source"]).replace("80_000", "1"), names)  # one rollout
        shown = capsys.readouterr().out.splitlines()
        kept = [line for each in cell["outputs"] for line in each.get("text", [])]
        assert shown[:4] == "".join(kept).splitlines()[:4]  # what needs no training
    assert shown[4].startswith("PPO")
    plt.close("all")


def test_one_trained_through_the_plant_learns_in_a_few_steps():
    assert through_plant.main(6, 16, 200).mean_error < 1.5  # the paper's PI controller has 2.26
