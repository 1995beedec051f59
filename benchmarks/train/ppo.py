"""PPO of Stable-Baselines3: how it is trained, and where its policies are kept.

The policy controls in velocity form: its action changes the flow, and so it can hold it. When
it is trained it is a `PolicyNetwork`, which needs NumPy alone: PyTorch is imported for training
only.
"""

from __future__ import annotations

import copy
import json
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

from agents import Increments, PolicyNetwork
from agents.policy_network import PRETRAINED
from benchmarks.controllers.records import Account, Training
from benchmarks.lib.fingerprint import fingerprint
from benchmarks.lib.storage import replacing
from benchmarks.train import kept
from benchmarks.train.ppo_arguments import RANDOMISED, PPOArguments
from mptc_gym import Parameters

POLICIES = 5  # are trained and compared, from seeds in sequence
TUNING_SEED, FINAL_SEED = 1000, 2000  # of policies in a search, others than a comparison uses


@dataclass(frozen=True)
class Policy:
    """Makes controllers of one trained policy, which a file keeps.

    Attributes
    ----------
    arguments
        How it was trained.
    file
        Where it is.
    network
        What the file holds. It goes along to machines where the file is not.

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
    def observation(self) -> dict[str, Any]:
        """Arguments of the environment that give the policy its observation."""
        return self.arguments.observation

    @property
    def account(self) -> Account:
        """What it costs before it runs."""
        weights = sum(W.size + b.size for W, b in self.network.layers)
        return Account(
            "dead zone; delay, by the past actions it sees",
            f"{weights:,} weights a policy",
            f"{self.arguments.steps / 1e6:g} M a policy",
        )

    @property
    def curve(self) -> list[dict[str, float]]:
        """The learning curve, a row a point."""
        return cast("list[dict[str, float]]", self.network.provenance["curve"])

    @property
    def provenance(self) -> dict[str, Any]:
        """Where it comes from."""
        kept = self.network.provenance
        return {"file": self.file.name, **{k: v for k, v in kept.items() if k != "curve"}}

    def __call__(self, parameters: Parameters | None = None) -> PolicyNetwork:
        """Return a controller; it is told the plant's dead zone, if that is a number."""
        network = copy.deepcopy(self.network)
        if parameters is not None and not isinstance(parameters.dead_zone, Sequence):
            network.increments = Increments(self.arguments.max_move, parameters.dead_zone)
        return network


def members(
    training: Training, arguments: PPOArguments | None = None, *, shipped: bool = True
) -> list[Policy]:
    """Return policies that differ in their seeds, and train those that are missing.

    Policies that were trained here are taken first, then those that come with the project.

    Parameters
    ----------
    training
        Where they are kept, how many there are, and what trains them.
    arguments
        How to train the first; the seeds of the others follow.
    shipped
        Whether those that come with the project will do.
    """
    arguments = arguments or PPOArguments()
    if training.steps is not None:
        arguments = replace(arguments, steps=training.steps)
    seeds = range(arguments.seed, arguments.seed + (training.members or POLICIES))
    wanted = [replace(arguments, seed=seed) for seed in seeds]
    files: dict[Path, PPOArguments] = {}
    missing = {}
    for each in wanted:
        own = training.folder / policy_key(each) / "policy.npz"
        if shipped and not (training.retrain or own.exists()) and _comes(each):
            files[pretrained(each)] = each
        else:
            files[own] = each
            missing[own] = partial(train, each)
    kept.train(missing, training.fan_out, retrain=training.retrain)
    return [Policy(each, file) for file, each in files.items()]


def train(arguments: PPOArguments) -> PolicyNetwork:
    """Train a policy, and return the one that did best in validation."""
    from benchmarks.train import ppo_training  # here: torch takes seconds to load

    return ppo_training.train(arguments)


def randomised_members(training: Training) -> list[Policy]:
    """Return policies for many plants, as `members` does."""
    return members(training, replace(PPOArguments(), **RANDOMISED))


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
