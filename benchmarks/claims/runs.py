"""Run batches of the NN and the PI controller, and judge the numbers found by them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from math import inf, isfinite
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents import DirectNNController, PIController
from benchmarks.lib.statistics import Estimate, quantile, share
from benchmarks.loop.rollout import Agent, Trajectory, make_plants, rollout

Array = NDArray[np.floating]
Finding = dict[str, Any]  # a row of the table of numbers

OFTEN = 0.9  # "works", "converges": in at least this share of the draws


@dataclass(frozen=True)
class Batch:
    """A batch of runs; run i has the initial weights and noise of seed `seed + i`."""

    runs: int
    seed: int = 0

    def networks(
        self, *, nodes: int = 3, length: int = 3, slower: bool = False, direction: int = -1
    ) -> DirectNNController:
        """Return a network for each run, by default the paper's.

        A network has `nodes` hidden nodes, and sees `length` set points and errors. A sum moves
        faster the more terms it has, if the weights of all terms learn with the same gain;
        `slower` scales the gains down to compensate.
        """
        of_nodes, of_inputs = (3 / nodes, 3 / length) if slower else (1.0, 1.0)
        paper = DirectNNController()
        return DirectNNController(
            n_inputs=2 * length,
            n_hidden=nodes,
            eta=of_nodes * of_inputs * paper.eta,
            eta_1=of_nodes * paper.eta_1,
            eta_theta=of_nodes * paper.eta_theta,
            direction=direction,
            error_index=length,
            seed=self.seed,
            num_envs=self.runs,
        )

    def run(
        self, agent: Agent, samples: int, before: Any = None, **arguments: Any
    ) -> Trajectory:
        """Run a controller on plants with these arguments; for `before` see `rollout`."""
        plants = make_plants(self.runs, samples, **arguments)
        return rollout(plants, agent, samples, self.seed, before)

    def run_nn(self, samples: int, **arguments: Any) -> Trajectory:
        """Run the paper's networks."""
        return self.run(self.networks(), samples, **arguments)

    def run_pi(self, kp: float, ki: float, samples: int, **arguments: Any) -> Trajectory:
        """Run a PI controller, only once if there is no noise."""
        batch = self if "noise_variance" in arguments else Batch(1, self.seed)
        return batch.run(PIController(kp, ki), samples, **arguments)


def judge(
    quantity: str, found: Any, unit: str = "", *, at_least: float = -inf, at_most: float = inf
) -> Finding:
    """Judge a number: an estimate, the median of one value per run, or an exact value.

    A bound makes the number part of the verdict. It is shown if the whole interval keeps the
    bound, and not shown if no part of the interval does.
    """
    if not isinstance(found, Estimate):
        one = float(np.ravel(found)[0])
        found = quantile(found, 0.5) if np.ndim(found) else Estimate(one, one, one, 1)
    bounds = {"at least": at_least, "at most": at_most}
    asked = [f"{name} {bound:g}" for name, bound in bounds.items() if isfinite(bound)]
    shown = "undecided" if asked else ""
    if asked and at_least <= found.low and found.high <= at_most:
        shown = "yes"
    elif found.high < at_least or found.low > at_most:
        shown = "no"
    criterion = {"criterion": " and ".join(asked), "shown": shown}
    return {"quantity": quantity, "unit": unit, **vars(found), **criterion}


def judge_share(quantity: str, found: NDArray[np.bool_], *, often: bool = False) -> Finding:
    """Judge the share of runs in which `found` is true; `often` requires `OFTEN`."""
    at_least = 100 * OFTEN if often else -inf
    return judge(quantity, share(found).scaled(100), "% of runs", at_least=at_least)


def judge_time(quantity: str, samples: ArrayLike) -> Iterator[Finding]:
    """Find the 10th, 50th and 90th percentiles of a time; infinite means never."""
    for p in (0.1, 0.5, 0.9):
        yield judge(f"{quantity}, {p:.0%} of runs", quantile(samples, p), "samples")


def verdict(findings: Iterable[Finding]) -> str:
    """Return the verdict in words; an undecided finding counts as not shown."""
    shown = [row["shown"] == "yes" for row in findings if row["shown"]]
    if not shown:
        return "cannot be tested from the text"
    if all(shown):
        return "holds"
    return "holds in part" if any(shown) else "does not hold"
