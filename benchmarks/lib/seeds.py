"""Define the ranges of seeds that training, searches and published results use.

A seed of the environment determines all random numbers of an episode. The ranges of seeds do
not overlap, so no controller is measured in episodes on which the controller was trained or
chosen. Random numbers outside of episodes, such as those of a bootstrap, have seeds from 0 on.
The seeds of commands and networks that are gone stay reserved, as earlier versions used them.
"""

from mptc_gym import evaluation

SEEDS = {
    # Runs of commands that are gone.
    "studies": range(10_000),
    # Initial weights of networks, and their training.
    "networks": range(10_000, 11_000),
    # Gains that a search tries.
    "sampler": range(1_000_000, 1_100_000),
    # Trials of a search.
    "preparation": range(3_000_000, 3_500_000),
    # Random settings of the paper's network, and runs of claims.
    "claims": range(3_500_000, 4_000_000),
    # Runs that choose among the best trials of a search.
    "finals": range(4_000_000, 4_500_000),
    # Episodes to choose policies by, with bounds in the package.
    "validation": range(
        evaluation.VALIDATION_SEED, evaluation.VALIDATION_SEED + evaluation.VALIDATION_EPISODES
    ),
    # Episodes to try settings of the self-tuning controllers on.
    "trials": range(6_200_000, 6_501_000),
    # Episodes of published results.
    "published": range(evaluation.SEED, evaluation.SEED + 100_000),
    # Episodes that data sets hold.
    "data sets": range(9_000_000, 9_100_000),
    # Episodes that check the final networks, once.
    "check": range(31_000_000, 31_001_000),
    # Episodes of the plants that policies are trained on.
    "training": range(1 << 32, 1 << 33),
}
