"""The examples run, with little to learn from, and do what they say."""

import json
import re
import runpy
import sys
from functools import partial

import gymnasium
import matplotlib.pyplot as plt
import torch
from stable_baselines3 import PPO

import mptc_gym.sb3
from benchmarks.examples import recurrent
from mptc_gym import evaluate
from tests.conftest import ROOT


def test_a_recurrent_policy_learns_and_enters_the_comparison(tmp_path, monkeypatch):
    monkeypatch.setattr(recurrent, "FILE", tmp_path / "recurrent.pt")
    monkeypatch.setattr(recurrent, "SEGMENT", 40)
    network = recurrent.train(steps=2, plants=4)
    torch.manual_seed(0)
    untrained = recurrent.Recurrent()
    trained = network.state_dict()
    assert not torch.equal(trained["cell.weight_hh"], untrained.state_dict()["cell.weight_hh"])
    torch.save(trained, recurrent.FILE)
    # It remembers, and forgets at a reset.
    policy, observations = recurrent.make(), torch.randn(3, 6).numpy()
    first, second = policy.act(observations), policy.act(observations)
    policy.reset()
    assert (first != second).all()
    assert (first == policy.act(observations)).all()
    assert evaluate(policy, "MiddlePointHard-v0", episodes=2).mean_error > 0.0


def test_ppo_runs_as_one_file_of_its_own(tmp_path, monkeypatch, capsys):
    for package in ("benchmarks", "agents"):
        monkeypatch.setitem(sys.modules, package, None)  # an import is an error
    monkeypatch.setattr(PPO, "train", lambda _: None)  # it takes most of the time
    for name in ("MiddlePoint-v0", "MiddlePointNoisy-v0"):
        monkeypatch.setattr(gymnasium.spec(name), "max_episode_steps", 60)
    words = ["page", "--steps", "1", "--seed", "3", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", words)
    runpy.run_path(str(ROOT / "benchmarks/examples/sb3.py"), run_name="__main__")
    printed = capsys.readouterr().out
    line = re.search(r"MiddlePointNoisy-v0: mean error ([\d.]+)", printed)
    namespace = runpy.run_path(str(ROOT / "benchmarks/examples/sb3.py"))
    plants = mptc_gym.sb3.make_vec_env("MiddlePoint-v0", 8, **namespace["PLANTS"])
    model = PPO.load(tmp_path / "ppo-3.zip", env=plants, device="cpu")
    noisy = evaluate(model, "MiddlePointNoisy-v0")
    assert f"{noisy.mean_error:.3f}" == line[1]


def test_stable_baselines3_learns_with_the_lines_of_the_page():
    page = (ROOT / "benchmarks/examples/clients.md").read_text(encoding="utf-8")
    lines = re.findall(r"^\| Stable-Baselines3.*?`(.+?)`", page, re.MULTILINE)
    short = partial(PPO, device="cpu", n_steps=8, batch_size=8, n_epochs=1, seed=0)
    names = {"PPO": short, "mptc_gym": mptc_gym, "gymnasium": gymnasium}
    models = [eval(line, names) for line in lines]
    assert [model.n_envs for model in models] == [1, 64]
    for model in models:
        assert model.learn(1).num_timesteps == 8 * model.n_envs


def test_the_notebook_runs_and_shows_what_it_showed(capsys, monkeypatch):
    monkeypatch.setattr(PPO, "train", lambda _: None)
    text = (ROOT / "benchmarks/examples/quickstart.ipynb").read_text(encoding="utf-8")
    cells = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
    names: dict[str, object] = {}
    for cell in cells:
        exec("".join(cell["source"]).replace("80_000", "1"), names)  # one rollout
        printed = capsys.readouterr().out.splitlines()
        stored = [line for output in cell["outputs"] for line in output.get("text", [])]
        assert printed[:4] == "".join(stored).splitlines()[:4]  # the lines before any training
    assert printed[4].startswith("PPO")
    plt.close("all")
