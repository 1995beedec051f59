"""Train PPO of Stable-Baselines3, or load the policies that are trained already.

The policy controls in velocity form: its action changes the flow, so it can also hold it. A
trained policy is a `PolicyNetwork`, which needs NumPy alone; PyTorch is imported only for
training.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path

from agents import PolicyNetwork
from agents.archive import PRETRAINED
from benchmarks.lib.fan_out import FanOut
from benchmarks.lib.storage import key
from benchmarks.train import kept
from benchmarks.train.ppo_arguments import PPOArguments

KEPT = Path("results/policies")
POLICIES = 5  # that are trained and compared, from consecutive seeds
TUNING_SEED, FINAL_SEED = 1000, 2000  # of policies in a search; no comparison uses them


@dataclass(frozen=True)
class PolicyRequest:
    """A request for trained policies, and how to train those that are missing."""

    fan_out: FanOut = field(default_factory=lambda: FanOut(jobs=1))
    """Runs the trainings."""
    folder: Path = KEPT
    """Folder of the trained policies."""
    steps: int | None = None
    """Samples of experience; None for the default of the training."""
    policies: int | None = None
    """Number of policies, which differ in their seeds; None for the default."""
    retrain: bool = False
    """Whether to train finished policies again."""


def members(
    request: PolicyRequest, arguments: PPOArguments | None = None, *, shipped: bool = True
) -> dict[Path, PolicyNetwork]:
    """Return policies that differ in their seeds, by file, and train those that are missing.

    Policies in the request's folder take precedence over those that come with the project.

    Parameters
    ----------
    request
        Number of policies, their folder, and what trains them.
    arguments
        Arguments of the first policy; the others take the seeds that follow.
    shipped
        Whether to accept policies that come with the project.

    Raises
    ------
    ValueError
        If a file is damaged; the message names it and says what to do.
    """
    first = arguments or PPOArguments()
    first = replace(first, steps=request.steps or first.steps)
    seeds = range(first.seed, first.seed + (request.policies or POLICIES))
    trainings = {}
    for each in (replace(first, seed=seed) for seed in seeds):
        file = request.folder / policy_key(each) / "policy.npz"
        if shipped and not (request.retrain or file.exists()) and _comes(each):
            file = PRETRAINED / file_name(each.seed)
        trainings[file] = partial(train, each)
    return kept.trained(trainings, PolicyNetwork.load, request.fan_out, retrain=request.retrain)


def train(arguments: PPOArguments) -> PolicyNetwork:
    """Train a policy, and return the one that did best in validation."""
    from benchmarks.train import ppo_training  # here: torch takes seconds to load

    return ppo_training.train(arguments)


def file_name(seed: int) -> str:
    """Return the file name of a seed's policy among those that come with the project."""
    return f"ppo-{seed}.npz"


def policy_key(arguments: PPOArguments) -> str:
    """Return a fingerprint of everything that shapes a policy."""
    return str(key(asdict(arguments)))


def _comes(arguments: PPOArguments) -> bool:
    """Return whether a policy trained with these arguments comes with the project."""
    file = PRETRAINED / file_name(arguments.seed)
    asked = json.loads(json.dumps(asdict(arguments)))
    return file.exists() and bool(PolicyNetwork.load(file).provenance["arguments"] == asked)
