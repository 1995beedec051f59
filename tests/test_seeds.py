"""Every seed of the project is one of the table, and no two purposes share one."""

import itertools
import json

import pytest

from benchmarks import tune
from benchmarks.claims import __main__ as claims
from benchmarks.lib.seeds import SEEDS
from benchmarks.train import __main__ as train
from mptc_gym import evaluation
from tests.conftest import ROOT


def block_of(seed):
    """Return the name of the block that holds a seed."""
    (name,) = [name for name, block in SEEDS.items() if seed in block]
    return name


def test_no_two_blocks_share_a_seed():
    blocks = sorted(SEEDS.values(), key=lambda block: block.start)
    for block, later in itertools.pairwise(blocks):
        assert block.stop <= later.start, (block, later)


def test_every_command_stays_in_its_block():
    trials = [tune.FIRST_RUN + i * 100_000 for i in range(len(tune.cases({})))]
    finals = [seed - tune.FIRST_RUN + tune.FINAL_FIRST_RUN for seed in trials]
    for name, seeds in {
        "claims": [claims.SEED, claims.SEED + claims.RUNS * claims.Options().draws - 1],
        "networks": [train.SEED, train.SEED + 5 - 1],
        "sampler": [tune.SEED, tune.SEED + 800 - 1],
        "preparation": [*trials, trials[-1] + 100 - 1],
        "finals": [*finals, finals[-1] + tune.FINAL_RUNS - 1],
        "validation": [evaluation.VALIDATION_SEED],
        "published": [evaluation.SEED, evaluation.SEED + 1000 - 1],
    }.items():
        assert {block_of(seed) for seed in seeds} == {name}


def test_policies_are_chosen_and_trained_where_nothing_is_published():
    ppo = pytest.importorskip("benchmarks.train.ppo", reason="PPO needs an extra")
    assert block_of(ppo.VALIDATION_SEED + evaluation.EPISODES - 1) == "validation"
    assert block_of(ppo.TRAINING_SEEDS + (1 << 32) - 1) == "training"


def test_published_files_have_the_seeds_of_the_table():
    read = lambda path: json.loads((ROOT / path).read_text("utf-8"))  # noqa: E731
    seeds = read("benchmarks/published/provenance.json")["seeds"]
    assert {block_of(seed) for seed in seeds} == {"published"}
    bounds = read("mptc_gym/bounds.json")
    assert block_of(bounds["seed"] + bounds["episodes"] - 1) == "published"
