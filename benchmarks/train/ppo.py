"""PPO of Stable-Baselines3: how it is trained, and where its policies are kept.

The policy controls in velocity form: its action changes the flow, and so it can hold it. When
it is trained it is a `PolicyNetwork`, which needs NumPy alone: PyTorch is imported for training
only.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

from agents import PolicyNetwork
from agents.policy_network import PRETRAINED
from benchmarks.lib.fan_out import FanOut
from benchmarks.lib.fingerprint import fingerprint
from benchmarks.lib.storage import replacing
from benchmarks.train import kept
from benchmarks.train.ppo_arguments import PPOArguments

KEPT = Path("results/policies")
POLICIES = 5  # are trained and compared, from seeds in sequence
TUNING_SEED, FINAL_SEED = 1000, 2000  # of policies in a search, others than a comparison uses


@dataclass(frozen=True)
class PolicyRequest:
    """Which trained policies are wanted, and how those that are missing are to be trained.

    Attributes
    ----------
    fan_out
        Runs the trainings.
    folder
        Where trained policies are kept.
    steps
        Samples of experience; None for as many as the training has by default.
    policies
        How many policies, which differ in their seeds; None for the default.
    retrain
        Whether to train even where a finished policy is at hand.
    """

    fan_out: FanOut = field(default_factory=lambda: FanOut(1))
    folder: Path = KEPT
    steps: int | None = None
    policies: int | None = None
    retrain: bool = False


@dataclass(frozen=True)
class Policy:
    """A trained policy, which a file keeps.

    Attributes
    ----------
    arguments
        How it was trained.
    file
        Where it is.
    network
        What the file holds.

    Raises
    ------
    ValueError
        If the file is damaged; the message names it, and what to do.
    """

    arguments: PPOArguments
    file: Path
    network: PolicyNetwork = field(init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        try:
            network = PolicyNetwork.load(self.file)
        except ValueError as error:
            raise ValueError(f"{error}: remove it, or --retrain") from error
        object.__setattr__(self, "network", network)

    @property
    def curve(self) -> list[dict[str, float]]:
        """The learning curve, a row a point."""
        return cast("list[dict[str, float]]", self.network.provenance.get("curve", []))


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
    """
    arguments = arguments or PPOArguments()
    if request.steps is not None:
        arguments = replace(arguments, steps=request.steps)
    seeds = range(arguments.seed, arguments.seed + (request.policies or POLICIES))
    wanted = [replace(arguments, seed=seed) for seed in seeds]
    files: dict[Path, PPOArguments] = {}
    missing = {}
    for each in wanted:
        own = request.folder / policy_key(each) / "policy.npz"
        if shipped and not (request.retrain or own.exists()) and _comes(each):
            files[pretrained(each)] = each
        else:
            files[own] = each
            missing[own] = partial(train, each)
    kept.train(missing, request.fan_out, retrain=request.retrain)
    return [Policy(each, file) for file, each in files.items()]


def train(arguments: PPOArguments) -> PolicyNetwork:
    """Train a policy, and return the one that did best in validation."""
    from benchmarks.train import ppo_training  # here: torch takes seconds to load

    return ppo_training.train(arguments)


def tuned(*, final: bool, member: int, **gains: Any) -> Policy:
    """Train a policy with other settings, of a seed that no comparison has."""
    first = FINAL_SEED if final else TUNING_SEED
    arguments = PPOArguments(seed=first + member, **gains)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "policy.npz"
        train(arguments).save(file)
        return Policy(arguments, file)


def pretrained(arguments: PPOArguments) -> Path:
    """Return where the policy of this seed is, among those that come with the project."""
    return PRETRAINED / f"ppo-{arguments.seed}.npz"


def _comes(arguments: PPOArguments) -> bool:
    """Say whether a policy that was trained like this comes with the project."""
    file = pretrained(arguments)
    if not file.exists():
        return False
    asked = json.loads(json.dumps(asdict(arguments)))
    return bool(Policy(arguments, file).network.provenance.get("arguments") == asked)


def publish(policies: Sequence[Policy], folder: Path = PRETRAINED) -> None:
    """Copy trained policies to where those are that come with the project."""
    for policy in policies:
        with replacing(folder / pretrained(policy.arguments).name) as file:
            shutil.copyfile(policy.file, file)


def policy_key(arguments: PPOArguments) -> str:
    """Return a name made of everything that shapes a policy."""
    return fingerprint(__name__, arguments=asdict(arguments))
