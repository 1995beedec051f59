"""Offline data sets: what was logged can be replayed, and scored on an absolute scale."""

import hashlib
import json

import numpy as np
import pytest

from benchmarks import datasets
from benchmarks.datasets import main, record
from mptc_gym import evaluate
from tests.conftest import run


@pytest.fixture
def minari(monkeypatch, tmp_path):
    """Minari, with a folder of its own."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    return pytest.importorskip("minari", reason="Minari needs Python 3.11")


def test_a_set_is_replayed_and_scores_a_learner(minari, capsys):
    name = "middlepoint/fouling/mixed-v1"
    assert main([name, "--episodes", "4"]) == 0
    assert name in capsys.readouterr().out
    dataset = minari.load_dataset(name)
    assert (dataset.total_episodes, dataset.total_steps) == (4, 4800)
    env = dataset.recover_environment()
    metadata = list(dataset.storage.get_episode_metadata(range(4)))
    controllers = [record["controller"] for record in metadata]
    assert controllers == ["pi", "pi-simc", "smith", "nn"]
    for episode, record_of_episode in zip(dataset, metadata, strict=True):
        seed = record_of_episode["seed"]
        again = run(env, episode.actions[:-1], seed)  # the last action ends the episode
        assert np.array_equal(again["observation"], episode.observations[:-1])
        assert np.array_equal(again["reward"], episode.rewards[:-1])
        assert (episode.terminations.sum(), episode.truncations.sum()) == (0, 1)
        assert np.abs(episode.actions).max() <= 1.0
    # The score of a policy is one number, whoever computes it; and each episode has its own.
    of_set = dataset.storage.metadata
    assert of_set["behaviour_error"] == -np.mean([episode.rewards for episode in dataset])
    evaluation = evaluate(lambda seen: -0.2 * seen[:, 3:4], dataset.env_spec, episodes=50)
    assert list(evaluation.seeds) == of_set["evaluation_seeds"]
    assert not {record["seed"] for record in metadata} & set(evaluation.seeds)
    scored = minari.get_normalized_score(dataset, -1200.0 * evaluation.errors.mean())
    assert scored == pytest.approx(evaluation.score, abs=1e-12)
    assert dataset.recover_environment(eval_env=True).spec == dataset.env_spec


def sha256(plant, episodes):
    metadata = [
        datasets.arguments_of(plant),
        [episode.controller for episode in episodes],
        [episode.seed for episode in episodes],
    ]
    digest = hashlib.sha256(json.dumps(metadata, sort_keys=True).encode())
    for name in ("observations", "actions", "rewards"):
        array = np.stack([getattr(episode, name) for episode in episodes])
        little = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
        digest.update(repr(array.shape).encode() + little.tobytes())
    return digest.hexdigest()


HASHES = {
    "paper": ("7507286da83b5d32", "46c2b5abc18730ed", "19f71d592767e520"),
    "disturbed": ("dffa6addaa52cdfa", "b387d788d0219825", "1a5c4558413b9511"),
    "fouling": ("a2239e92cdda32cc", "5e3828a9d903655f", "8bf844218407529a"),
}


@pytest.mark.parametrize("plant", HASHES)
def test_a_published_set_is_recorded_again_bit_for_bit(plant):
    # If one of these changes, so does the published list, and the set needs a new version.
    sets = (record(plant, behaviour, episodes=4) for behaviour in ("pi", "smith", "mixed"))
    assert tuple(sha256(plant, episodes)[:16] for episodes in sets) == HASHES[plant]


def test_a_set_that_exists_is_not_replaced(minari, refused):
    name = "middlepoint/paper/mixed-v1"
    assert main([name, "--episodes", "1"]) == 0  # fewer than there are controllers
    assert f"data sets exist; to remove them: minari delete {name}" in refused(main, [name])
    assert minari.load_dataset(name).total_episodes == 1
