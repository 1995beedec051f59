"""Offline data sets: what was logged can be replayed, and scored on an absolute scale."""

from unittest.mock import Mock

import numpy as np
import pytest

from agents import PIController
from benchmarks.datasets import command as datasets
from benchmarks.datasets.__main__ import main
from mptc_gym import evaluate


@pytest.fixture
def minari(monkeypatch, tmp_path):
    """Minari, with a folder of its own."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    return pytest.importorskip("minari", reason="Minari needs Python 3.11")


@pytest.mark.parametrize("name", ["middlepoint/paper/pi-v0", "middlepoint/fouling/mixed-v0"])
def test_the_recorded_actions_give_the_recorded_observations(name, minari, tmp_path, capsys):
    assert main([name, "--episodes", "5"]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["middlepoint"]  # nothing is left over
    assert name in capsys.readouterr().out
    dataset = minari.load_dataset(name)
    assert (dataset.total_episodes, dataset.total_steps) == (5, 6000)
    env = dataset.recover_environment()
    metadata = list(dataset.storage.get_episode_metadata(range(5)))
    assert len({each["seed"] for each in metadata}) == 5
    for episode, about in zip(dataset, metadata, strict=True):
        observation, _ = env.reset(seed=about["seed"])
        assert np.array_equal(observation, episode.observations[0])
        for k, action in enumerate(episode.actions):
            assert env.action_space.contains(action)
            observation, reward, *ended, _ = env.step(action)
            assert np.array_equal(observation, episode.observations[k + 1])
            assert reward == episode.rewards[k]
            assert ended == [episode.terminations[k], episode.truncations[k]]
        assert ended == [False, True]


def test_the_pi_of_the_set_is_the_paper_s():
    # That the environment answers so to these actions is tested above.
    logged, controller = datasets.record("paper", "pi", episodes=2, seed=3), PIController()
    actions = [controller.act(observation) for observation in logged.observations[1, :-1]]
    np.testing.assert_array_equal(logged.actions[1], np.clip(actions, -1.0, 1.0))
    errors = np.abs(logged.observations[1, 1:, 3])
    np.testing.assert_allclose(-logged.rewards[1], errors, atol=1e-6)


def test_a_mixed_set_has_all_controllers_and_no_seed_twice():
    logged = datasets.record("disturbed", "mixed", episodes=6, seed=50)
    assert logged.controllers == ["pi", "pi-simc", "smith", "nn", "pi", "pi-simc"]
    assert logged.seeds == list(range(50, 56))
    assert len(np.unique(logged.actions, axis=0)) == 6
    again = datasets.record("disturbed", "pi", episodes=6, seed=50)
    assert np.array_equal(again.observations[[0, 4]], logged.observations[[0, 4]])


@pytest.mark.parametrize(
    ("name", "sha256"),
    [
        ("paper/pi", "7507286da83b5d32"),
        ("paper/smith", "5f26ac5d91f00b6e"),
        ("paper/mixed", "59527635d8b103fc"),
        ("disturbed/pi", "dffa6addaa52cdfa"),
        ("disturbed/smith", "2d3305dd10409894"),
        ("disturbed/mixed", "1465adbc556e8977"),
        ("fouling/pi", "a2239e92cdda32cc"),
        ("fouling/smith", "a11133192ae47718"),
        ("fouling/mixed", "5b2583c36644d7b8"),
    ],
)
def test_a_published_set_is_recorded_again_bit_for_bit(name, sha256):
    # If one of these changes, so do the figures on the page, and the set needs a new version.
    logged = datasets.record(*name.split("/"), episodes=4)
    assert logged.sha256.startswith(sha256)
    logged.actions[2, 700, 0] += 1e-6
    assert not logged.sha256.startswith(sha256)


def test_the_scale_is_of_the_episodes_it_names():
    judged_by = datasets.scale("paper", episodes=2)
    smith = datasets.record("paper", "smith", 2, judged_by.seeds[0])
    assert 0.0 < judged_by.least_possible < smith.error < judged_by.mean_error
    assert not set(judged_by.seeds) & set(range(datasets.SEED, datasets.SEED + 10_000))


def test_the_metadata_scores_a_learner(minari):
    name = "middlepoint/paper/smith-v0"
    main([name, "--episodes", "2"])
    dataset = minari.load_dataset(name)
    about = dataset.storage.metadata
    assert about["sha256"] == datasets.record("paper", "smith", 2).sha256
    assert about["behaviour_error"] == -np.mean([episode.rewards for episode in dataset])
    # The score of a policy is one number, whoever computes it; and each episode has its own.
    found = evaluate(lambda seen: -0.2 * seen[:, 3:4], dataset.env_spec, episodes=50)
    assert list(found.seeds) == about["evaluation_seeds"]
    returns = -1200.0 * found.errors
    scored = minari.get_normalized_score(dataset, returns.mean())
    assert scored == pytest.approx(found.score, abs=1e-12)
    least, idle = (np.array(about[n]) for n in ("least_possible_errors", "idle_errors"))
    np.testing.assert_allclose(found.scores, (idle - found.errors) / (idle - least), atol=1e-12)
    assert 0.2 < found.score < 1.0
    assert dataset.recover_environment(eval_env=True).spec == dataset.env_spec


def test_writing_again_replaces_and_a_failure_changes_nothing(minari, monkeypatch, tmp_path):
    name = "middlepoint/paper/pi-v0"
    for episodes in ("2", "3"):
        assert main([name, "--episodes", episodes]) == 0
    assert minari.load_dataset(name).total_episodes == 3

    stopped = Mock(side_effect=KeyboardInterrupt)
    monkeypatch.setattr(minari, "create_dataset_from_buffers", stopped)
    assert main([name, "--episodes", "2"]) == 130
    assert minari.load_dataset(name).total_episodes == 3
    assert [path.name for path in tmp_path.iterdir()] == ["middlepoint"]


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (
            ["middlepoint/paper/ppo-v0"],
            '"middlepoint/paper/ppo-v0" for IDS. Choose from: "middle',
        ),
        (["middlepoint/paper/mixed-v0", "--episodes", "3"], "--episodes: must be at least 4"),
    ],
)
def test_bad_options_are_named(arguments, named, minari, refused):
    assert named in refused(main, arguments)
