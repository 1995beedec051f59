"""Define the ranges of seeds that training, searches and published results use.

A seed of the environment determines all random numbers of an episode. The ranges of seeds do
not overlap, so no controller is measured in episodes on which the controller was trained or
chosen. Random numbers outside of episodes, such as those of a bootstrap, have seeds from 0 on.
The seeds of commands and networks that are gone stay reserved, as earlier versions used them.
"""

from dataclasses import dataclass

from mptc_gym import evaluation


@dataclass(frozen=True)
class Block:
    """The `count` consecutive seeds from the seed `first` on, and the purpose of the seeds."""

    first: int
    count: int
    purpose: str

    @property
    def seeds(self) -> range:
        """The seeds in rising order."""
        return range(self.first, self.first + self.count)


SEEDS = {
    "studies": Block(0, 10_000, "runs of claims and of commands that are gone"),
    "networks": Block(10_000, 1_000, "initial weights of networks, and their training"),
    "sampler": Block(1_000_000, 100_000, "gains that a search tries"),
    "preparation": Block(
        3_000_000, 500_000, "trials of a search, and runs in which a controller learns before"
    ),
    "finals": Block(4_000_000, 500_000, "runs that choose among the best trials of a search"),
    "validation": Block(
        evaluation.VALIDATION_SEED,
        evaluation.VALIDATION_EPISODES,
        "episodes to choose policies by, with bounds in the package",
    ),
    "trials": Block(
        6_200_000, 301_000, "episodes to try settings of the self-tuning controllers on"
    ),
    "published": Block(evaluation.SEED, 100_000, "episodes of published results"),
    "data sets": Block(9_000_000, 100_000, "episodes that data sets hold"),
    "check": Block(31_000_000, 1_000, "episodes that check the final networks, once"),
    "training": Block(1 << 32, 1 << 32, "episodes of the plants that policies are trained on"),
}
