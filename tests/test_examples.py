"""The examples run, with little to learn from, and do what they say."""

import json
import re
import runpy
import sys

import gymnasium
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
import torch
from PIL import Image, ImageSequence
from scipy import signal
from stable_baselines3 import PPO

import mptc_gym.sb3
from agents import PolicyNetwork
from agents.networks import PRETRAINED
from benchmarks.examples import film, fit_plant, recurrent
from benchmarks.lib.seeds import SEEDS
from mptc_gym import FOR_LEARNING, MiddlePointEnv, evaluate
from tests.conftest import ROOT, run


def test_a_recurrent_policy_learns_and_enters_the_comparison(tmp_path, monkeypatch):
    monkeypatch.setattr(recurrent, "FILE", tmp_path / "recurrent.pt")
    monkeypatch.setattr(recurrent, "SEGMENT", 40)
    untrained, trained = (recurrent.train(n, plants=4).state_dict() for n in (0, 2))
    assert not torch.equal(trained["cell.weight_hh"], untrained["cell.weight_hh"])
    torch.save(trained, recurrent.FILE)
    policy, observations = recurrent.make(), torch.randn(3, 6).numpy()
    first = policy.act(observations)
    assert (first != policy.act(observations)).all()  # It remembers, ...
    policy.reset()
    assert (first == policy.act(observations)).all()  # ... and forgets at a reset.
    assert evaluate(policy, "MiddlePointHard-v0", episodes=2).mean_error > 0.0


def test_the_film_ends_with_the_picture_that_it_begins_with(tmp_path, monkeypatch):
    monkeypatch.setattr(film, "ACTS", {0: "from the start", 60: "later"})
    monkeypatch.setattr(film, "SAMPLES", 40)
    monkeypatch.chdir(tmp_path)
    film.main()
    with Image.open("film.gif") as moving:
        pictures = [np.array(frame.convert("RGB")) for frame in ImageSequence.Iterator(moving)]
    finished, start, end_of_act, _, end = pictures
    assert len(pictures) == 1 + 2 * 2
    assert (finished == end).all()
    left, right = np.s_[:, :470], np.s_[:, 480:]
    assert (end_of_act[left] == finished[left]).all()
    assert (start[left] != finished[left]).any()
    assert (end_of_act[right] != finished[right]).any()


def test_ppo_runs_as_one_file_of_its_own(tmp_path, monkeypatch, capsys):
    for package in ("benchmarks", "agents"):
        monkeypatch.setitem(sys.modules, package, None)  # an import is an error
    monkeypatch.setattr(PPO, "train", lambda _: None)  # it takes most of the time
    for name in ("MiddlePoint-v0", "MiddlePointNoisy-v0"):
        monkeypatch.setattr(gymnasium.spec(name), "max_episode_steps", 60)
    monkeypatch.setattr(sys, "argv", ["page", "--steps", "1"])
    monkeypatch.chdir(tmp_path)
    example = str(ROOT / "benchmarks/examples/sb3.py")
    runpy.run_path(example, run_name="__main__")
    *_, paper, noisy = capsys.readouterr().out.splitlines()
    plants = mptc_gym.sb3.make_vec_env("MiddlePoint-v0", 8, **FOR_LEARNING, max_move=1.0)
    model = PPO.load("best/best_model.zip", env=plants, device="cpu")
    assert paper == str(evaluate(model))
    assert noisy == str(evaluate(model, "MiddlePointNoisy-v0"))


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


def test_a_data_set_is_replayed_and_scores_a_policy(tmp_path, monkeypatch, capsys):
    minari = pytest.importorskip("minari", reason="Minari needs Python 3.11")
    from benchmarks.examples import offline

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    offline.main("ppo-hard", "fouling", episodes=2)  # whose actions change the flow
    dataset = minari.load_dataset("middlepoint/fouling/ppo-hard-v0")
    assert (dataset.total_episodes, dataset.total_steps) == (2, 2400)
    env = dataset.recover_environment()
    metadata = dataset.storage.get_episode_metadata(range(2))
    for episode, of_episode in zip(dataset, metadata, strict=True):
        assert of_episode["seed"] in SEEDS["data sets"]
        again = run(env, episode.actions[:-1], of_episode["seed"])  # the last ends the episode
        assert np.array_equal(again["observation"], episode.observations[:-1])
        assert np.array_equal(again["reward"], episode.rewards[:-1])
        assert np.array_equal(again["applied"], episode.infos["applied"][:-1])
        assert (episode.terminations.sum(), *episode.truncations.nonzero()[0]) == (0, 1199)
    error = -np.mean([episode.rewards for episode in dataset])
    assert f"mean error {error:.3f} (reference 1.1" in capsys.readouterr().out
    # Minari and `evaluate` give a policy the same score.
    network = PolicyNetwork.load(PRETRAINED / "ppo-hard-10000.npz")
    evaluation = evaluate(network, dataset.env_spec)
    score = minari.get_normalized_score(dataset, -1200.0 * evaluation.mean_error)
    assert score == pytest.approx(evaluation.score, abs=1e-12)
    assert not {*SEEDS["data sets"]} & {*evaluation.seeds}


def bump_test(flow_before=0.0):
    """Return the log of a plant that SciPy simulates, from rest with the flow `flow_before`."""
    times = 4.0 * np.arange(400)
    flow = np.repeat([8.0, 1.4, -6.0, 40.0, 8.0], 80)
    applied = np.where(np.abs(flow) < 1.5, 0.0, np.minimum(flow, 30.0))
    delayed = np.r_[flow_before, flow_before, applied[:-2]]  # by 8 s
    lag = signal.lti([0.4], [50.0, 1.0])
    rise = signal.lsim(lag, delayed - flow_before, times, interp=False)[1]
    temperature = 60.0 + 0.4 * flow_before + rise
    temperature += np.random.default_rng(5).normal(0.0, 0.05, 400)
    return pd.DataFrame({"time": 100.0 + times, "flow": flow, "temperature": temperature})


@pytest.mark.parametrize("flow_before", [0.0, 8.0])
def test_a_bump_test_gives_the_plant_that_made_it(flow_before, tmp_path, capsys):
    log, file = tmp_path / "log.csv", tmp_path / "plant.json"
    bump_test(flow_before).to_csv(log)
    numbers = {"dead_zone": 1.5, "u_min": -20.0, "u_max": 30.0}
    fit_plant.main(log, file, **numbers)
    plant = json.loads(file.read_text(encoding="utf-8"))
    assert plant["delay"] == 2
    assert {**numbers, "sampling_interval": 4.0}.items() <= plant.items()
    # A step response of the environment with these arguments.
    env = MiddlePointEnv(**{**plant, "delay": 0, "dead_zone": 0.0})
    env.reset()
    outputs = [env.step(np.float32([1.0]))[4]["output"] for _ in range(200)]
    assert outputs[-1] == pytest.approx(0.4 * 30.0, rel=0.01)
    assert outputs[9] == pytest.approx(0.4 * 30.0 * (1.0 - np.exp(-0.8)), rel=0.02)
    printed = capsys.readouterr().out
    assert re.search(r"flow 0 (59\.9\d|60(\.0\d?)?) degC", printed)
    # The model explains all but the noise, whose standard deviation is 0.05 degC.
    assert re.search(r"explains (99\.\d|100\.0)% .* rest is 0\.0(4[89]|5|5[12]) degC", printed)
    assert plt.imread(tmp_path / "plant.png").std() > 0.0
    plt.close("all")


@pytest.mark.parametrize(
    ("change", "dead_zone", "message"),
    [
        (lambda log: log.rename(columns={"flow": "valve"}), 1.5, "columns.*not found.*'flow'"),
        (lambda log: log.replace({"time": {140.0: "noon"}}), 1.5, "could not convert.*noon"),
        (lambda log: log.replace({"flow": {1.4: np.nan}}), 1.5, "a number in each row"),
        (lambda log: log.drop(10), 1.5, "from 4 s to 8 s apart, the latter after 136 s"),
        (lambda log: log[::-1], 1.5, "times must ascend"),
        (lambda log: log.assign(flow=log.flow.clip(-1, 1)), 1.5, "outside the dead zone"),
        (lambda log: log.assign(flow=9.0 * (log.time > 400)), 1.5, "move twice or more"),
        (lambda log: log, -1.5, "dead_zone must be"),
    ],
)
def test_a_log_that_cannot_be_fitted_is_refused(change, dead_zone, message, tmp_path):
    log = tmp_path / "log.csv"
    change(bump_test()).to_csv(log)
    with pytest.raises(SystemExit, match=message):
        fit_plant.main(
            log, tmp_path / "plant.json", dead_zone=dead_zone, u_min=-20.0, u_max=30.0
        )


def test_a_log_with_decimal_commas_is_refused(tmp_path):
    log = tmp_path / "log.csv"
    log.write_text("time,flow,temperature\n0,1,5,20,1\n8,1,5,20,2\n")
    with pytest.raises(SystemExit, match="row 2 has more columns than the headings"):
        fit_plant.main(log, tmp_path / "plant.json", dead_zone=0.0, u_min=-1.0, u_max=1.0)


# Plants that SciPy simulates: with an offset, with a second lag, sampled each second, in kg/h.
@pytest.mark.parametrize(
    ("gain", "time_constant", "delay", "interval", "offset", "move", "lag"),
    [
        (2.0, 50.0, 10, 5.0, 0.0, 1.0, 0.0),
        (-0.5, 300.0, 25, 8.0, 480.0, 10.0, 0.0),
        (1.5, 20.0, 6, 1.0, 300.0, 2.0, 2.0),
        (-4e-4, 120.0, 12, 4.0, 753.0, 5000.0, 5.0),  # K per kg/h
        (0.8, 90.0, 0, 2.0, -20.0, 3.0, 0.0),
    ],
)
def test_logs_of_plants_by_scipy(
    gain, time_constant, delay, interval, offset, move, lag, tmp_path, monkeypatch
):
    monkeypatch.setattr(pd.DataFrame, "plot", lambda *_, **__: [plt.figure().add_subplot()])
    flow = move * np.repeat([0.5, 1.0, -0.5, 0.3], 200)
    times = interval * np.arange(len(flow))
    delayed = np.r_[np.full(delay, flow[0]), flow][: len(flow)] - flow[0]
    plant = signal.lti([gain], np.polymul([time_constant, 1.0], [lag, 1.0]))
    rise = signal.lsim(plant, delayed, times, interp=False)[1]
    noise = np.random.default_rng(1).normal(0.0, 0.003 * abs(gain) * move, len(flow))
    log, file = tmp_path / "log.csv", tmp_path / "plant.json"
    table = {"time": times, "flow": flow, "temperature": offset + rise + noise}
    pd.DataFrame(table).to_csv(log, index=False)
    fit_plant.main(log, file, dead_zone=0.0, u_min=-2.0 * move, u_max=2.0 * move)
    plt.close("all")
    found = json.loads(file.read_text())
    pole = -found["a"][1]
    assert found["b"][0] / (1.0 - pole) == pytest.approx(gain, rel=0.05)
    assert -interval / np.log(pole) == pytest.approx(time_constant, rel=0.15)
    # A second lag acts as a delay.
    assert found["delay"] * interval == pytest.approx(
        delay * interval + lag, abs=1.5 * interval
    )
    assert found["temperature_span"] >= 2.0 * abs(gain) * move
