"""PPO of Stable-Baselines3: how it is trained, and where its policies are kept.

The policy controls in velocity form: its action changes the flow, and so it can hold it. When
it is trained it is a `PolicyNetwork`, which needs NumPy alone: PyTorch is imported for training
only.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path

from agents import PolicyNetwork
from agents.archive import PRETRAINED
from benchmarks.lib.fan_out import FanOut
from benchmarks.lib.fingerprint import fingerprint
from benchmarks.train import kept
from benchmarks.train.ppo_arguments import PPOArguments

KEPT = Path("results/policies")
POLICIES = 5  # are trained and compared, from seeds in sequence
TUNING_SEED, FINAL_SEED = 1000, 2000  # of policies in a search, others than a comparison uses


@dataclass(frozen=True)
class PolicyRequest:
    """Which trained policies are wanted, and how those that are missing are to be trained."""

    fan_out: FanOut = field(default_factory=lambda: FanOut(1))
    """Runs the trainings."""
    folder: Path = KEPT
    """Where trained policies are kept."""
    steps: int | None = None
    """Samples of experience; None for as many as the training has by default."""
    policies: int | None = None
    """How many policies, which differ in their seeds; None for the default."""
    retrain: bool = False
    """Whether to train even where a finished policy is at hand."""


def members(
    request: PolicyRequest, arguments: PPOArguments | None = None, *, shipped: bool = True
) -> dict[Path, PolicyNetwork]:
    """Return policies that differ in their seeds, by file, and train those that are missing.

    Policies that were trained here are taken first, then those that come with the project.

    Parameters
    ----------
    request
        Where they are kept, how many there are, and what trains them.
    arguments
        How to train the first; the seeds of the others follow.
    shipped
        Whether those that come with the project will do.

    Raises
    ------
    ValueError
        If a file is damaged; the message names it, and what to do.
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
    """Return the name of the policy of this seed, among those that come with the project."""
    return f"ppo-{seed}.npz"


def policy_key(arguments: PPOArguments) -> str:
    """Return a name made of everything that shapes a policy."""
    return fingerprint(__name__, arguments=asdict(arguments))


def _comes(arguments: PPOArguments) -> bool:
    """Say whether a policy that was trained like this comes with the project."""
    file = PRETRAINED / file_name(arguments.seed)
    asked = json.loads(json.dumps(asdict(arguments)))
    return file.exists() and bool(PolicyNetwork.load(file).provenance["arguments"] == asked)
