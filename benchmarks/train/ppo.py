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


@dataclass(frozen=True)
class Policy:
    """A trained policy: how it was trained, where it is kept, and what it is."""

    arguments: PPOArguments
    file: Path
    network: PolicyNetwork

    @property
    def curve(self) -> list[dict[str, float]]:
        """The learning curve, a row a point."""
        curve: list[dict[str, float]] = self.network.provenance.get("curve", [])
        return curve


def members(
    request: PolicyRequest, arguments: PPOArguments | None = None, *, shipped: bool = True
) -> list[Policy]:
    """Return policies that differ in their seeds, and train those that are missing.

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
    arguments = arguments or PPOArguments()
    if request.steps is not None:
        arguments = replace(arguments, steps=request.steps)
    seeds = range(arguments.seed, arguments.seed + (request.policies or POLICIES))
    files: dict[Path, PPOArguments] = {}
    missing = {}
    for each in (replace(arguments, seed=seed) for seed in seeds):
        own = request.folder / policy_key(each) / "policy.npz"
        if shipped and not (request.retrain or own.exists()) and _comes(each):
            files[PRETRAINED / file_name(each)] = each
        else:
            files[own] = each
            missing[own] = partial(train, each)
    kept.train(missing, request.fan_out, retrain=request.retrain)
    return [Policy(each, file, _load(file)) for file, each in files.items()]


def train(arguments: PPOArguments) -> PolicyNetwork:
    """Train a policy, and return the one that did best in validation."""
    from benchmarks.train import ppo_training  # here: torch takes seconds to load

    return ppo_training.train(arguments)


def file_name(arguments: PPOArguments) -> str:
    """Return the name of the policy of this seed, among those that come with the project."""
    return f"ppo-{arguments.seed}.npz"


def policy_key(arguments: PPOArguments) -> str:
    """Return a name made of everything that shapes a policy."""
    return fingerprint(__name__, arguments=asdict(arguments))


def _comes(arguments: PPOArguments) -> bool:
    """Say whether a policy that was trained like this comes with the project."""
    file = PRETRAINED / file_name(arguments)
    asked = json.loads(json.dumps(asdict(arguments)))
    return file.exists() and bool(_load(file).provenance.get("arguments") == asked)


def _load(file: Path) -> PolicyNetwork:
    try:
        return PolicyNetwork.load(file)
    except ValueError as error:
        raise ValueError(f"{error}: remove it, or --retrain") from error
