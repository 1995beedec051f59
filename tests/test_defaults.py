"""The study of Stable-Baselines3 with its defaults, with little to learn from."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from stable_baselines3 import PPO

from agents import PIController
from benchmarks.loop.rollout import make_plants
from benchmarks.train.defaults import command as defaults
from benchmarks.train.defaults.__main__ import main

ROOT = Path(__file__).parent.parent


@pytest.fixture(autouse=True)
def small(monkeypatch):
    quick = partial(PPO, n_steps=32, batch_size=32, n_epochs=1)
    for name in ("ppo", "ppo-velocity"):
        case = replace(defaults.CASES[name], algorithm=quick)
        monkeypatch.setitem(defaults.CASES, name, case)
    monkeypatch.setattr(defaults, "SAMPLES", 30)


def weights(model):
    return torch.cat([p.detach().flatten() for p in model.policy.parameters()])


def test_curves_are_shown_kept_and_drawn(tmp_path, capsys):
    command = ["--steps", "64", "--interval", "32", "--out", str(tmp_path)]
    assert main([*command, "--seed", "3", "--seeds", "2"]) == 0
    assert capsys.readouterr().out.count("mae") == 4
    assert main([*command, "--seed", "4", "--seeds", "1", "--case", "ppo"]) == 0
    curves = pd.read_csv(tmp_path / "sb3_defaults.csv")
    seeds = curves.groupby("case")["seed"].apply(list).to_dict()
    assert seeds == {"ppo": [4, 4], "ppo-velocity": [3, 3, 4, 4]}
    assert list(curves["steps"]) == [32, 64] * 3
    picture = tmp_path / "sb3_defaults.png"
    assert picture.stat().st_size > 10_000
    picture.unlink()
    main([*command, "--plot"])
    assert picture.exists()
    pd.testing.assert_frame_equal(curves, pd.read_csv(tmp_path / "sb3_defaults.csv"))


def test_an_interrupted_study_goes_on(tmp_path, monkeypatch, capsys):
    command = ["--steps", "64", "--interval", "32", "--out", str(tmp_path), "--seeds", "2"]
    train = defaults.train

    def interrupted(name, steps, seed, interval, out):
        train(name, 32 if seed else steps, seed, interval, out)
        if seed:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(defaults, "train", interrupted)
        assert main(command) == 130
    capsys.readouterr()
    assert main(command) == 0
    shown = capsys.readouterr().out
    assert shown.count("seed 0") == 0
    assert shown.count("seed 1") == 2
    assert len(pd.read_csv(tmp_path / "sb3_defaults.csv")) == 4


def test_sac_learns_from_it_too(capsys):
    main(["--case", "sac", "--seeds", "1", "--steps", "110", "--interval", "55"])
    assert [line.split()[5] for line in capsys.readouterr().out.splitlines()[:2]] == [
        "55",
        "110",
    ]


def test_nothing_is_drawn_from_nowhere(capsys):
    with pytest.raises(SystemExit):
        main(["--plot"])
    assert "--plot needs --out" in capsys.readouterr().err


def test_a_folder_without_curves_or_no_folder_is_named(tmp_path, capsys):
    (tmp_path / "file").touch()
    for arguments, complaint in (
        (["--plot", "--out", str(tmp_path)], "sb3_defaults.csv is missing"),
        (["--out", str(tmp_path / "file")], "cannot be written to: it is no folder"),
    ):
        with pytest.raises(SystemExit):
            main(arguments)
        assert f"--out: {tmp_path}" in (shown := capsys.readouterr().err)
        assert complaint in shown


def test_a_training_too_short_for_a_test_says_so(tmp_path, capsys):
    arguments = ["--seeds", "1", "--steps", "64", "--interval", "5000", "--out", str(tmp_path)]
    assert main(arguments) == 0
    assert "Nothing was kept" in capsys.readouterr().out


def test_looking_does_not_disturb_the_training():
    models = [defaults.train("ppo-velocity", 64, 0, interval, None) for interval in (7, 1000)]
    assert torch.equal(*map(weights, models))


def test_the_policy_is_tested_with_its_wrapper():
    class Opening:
        def reset(self):
            pass

        def act(self, observation):
            return np.full((1, 1), -0.5)

    errors = {
        name: defaults.square_error(Opening(), case.test_on())
        for name, case in defaults.CASES.items()
    }
    # In velocity form the flow falls to its limit; otherwise -5 t/h is on the dead zone's edge.
    assert errors["ppo-velocity"] < errors["ppo"] == errors["sac"]


def test_what_policies_are_compared_with(monkeypatch):
    class Idle:
        def reset(self):
            pass

        def act(self, observation):
            return np.zeros((1, 1))

    monkeypatch.setattr(defaults, "SAMPLES", 1200)
    idle = defaults.square_error(Idle(), make_plants(1, 1200))
    assert idle == defaults.DOING_NOTHING
    runs = pd.read_csv(ROOT / "benchmarks/published/estimates.csv")
    runs = runs[runs["scenario"] == "square"].set_index("agent")
    pi = defaults.square_error(PIController(), make_plants(1, 1200))
    assert pi == pytest.approx(runs["mean"]["pi"])
    assert pytest.approx(runs["limit"]["pi"], abs=5e-4) == defaults.POSSIBLE
