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
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, cast

from agents import Increments, PolicyNetwork
from agents.policy_network import PRETRAINED
from benchmarks.controllers.records import Account, Training
from benchmarks.lib.fingerprint import fingerprint
from benchmarks.lib.storage import replacing
from benchmarks.train.ppo_arguments import RANDOMISED, PPOArguments
from mptc_gym import Parameters

POLICIES = 5  # are trained and compared, from seeds in sequence
TUNING_SEED, FINAL_SEED = 1000, 2000  # of policies in a search, others than a comparison uses
POLICY, CHECKPOINT = "policy.npz", "checkpoint.npz"


@dataclass(frozen=True)
class Policy:
    """Makes controllers of one trained policy, which a file keeps.

    Attributes
    ----------
    arguments
        How it was trained.
    file
        Where it is.
    """

    arguments: PPOArguments
    file: Path

    @property
    def network(self) -> PolicyNetwork:
        """The policy.

        Raises
        ------
        ValueError
            If the file is damaged; the message names it.
        """
        return _loaded(self.file)

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


def _load(file: Path) -> PolicyNetwork:
    try:
        return PolicyNetwork.load(file)
    except ValueError as error:
        raise ValueError(f"{error}: remove it, or --retrain") from error


_loaded = cache(_load)


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
    policies = []
    for each in (replace(arguments, seed=seed) for seed in seeds):
        # Absolute, as workers may have been started elsewhere.
        policy = Policy(each, (training.folder / policy_key(each) / POLICY).absolute())
        if shipped and not (training.retrain or policy.file.exists()):
            comes = Policy(each, pretrained(each))
            policy = comes if is_trained_as(comes) else policy
        policies.append(policy)
    # A bar for each training; those of other machines do not come here.
    bars = training.fan_out.backend == "loky"
    cells = {
        f"PPO, seed {policy.arguments.seed}": partial(
            _train,
            policy.arguments,
            policy.file.parent,
            retrain=training.retrain,
            progress=bars,
        )
        for policy in policies
        if training.retrain or not policy.file.exists()
    }
    training.fan_out.run(cells, title="training PPO", progress=bool(cells) and not bars)
    _loaded.cache_clear()  # what is in the files may be new
    for policy in policies:
        if not policy.file.exists():
            raise FileNotFoundError(
                f"trained, but not here: the machines of a cluster must share {policy.file}"
            )
    return policies


def _train(arguments: PPOArguments, folder: Path, *, retrain: bool, progress: bool) -> None:
    """Train a policy, which lies in its folder then."""
    trained_policy(arguments, folder, retrain=retrain, progress=progress)


def randomised_members(training: Training) -> list[Policy]:
    """Return policies for many plants, as `members` does."""
    return members(training, replace(PPOArguments(), **RANDOMISED))


def tuned(*, final: bool, member: int, **gains: Any) -> Policy:
    """Train a policy with other settings, of a seed that no comparison has."""
    first = FINAL_SEED if final else TUNING_SEED
    arguments = PPOArguments(seed=first + member, **gains)
    with tempfile.TemporaryDirectory() as folder:
        _train(arguments, Path(folder), retrain=False, progress=False)
        policy = Policy(arguments, Path(folder) / POLICY)
        assert policy.network  # is loaded while the folder is there
        return policy


def pretrained(arguments: PPOArguments) -> Path:
    """Return where the policy of this seed is, among those that come with the project."""
    return PRETRAINED / f"ppo-{arguments.seed}.npz"


def is_trained_as(policy: Policy) -> bool:
    """Say whether a policy's file exists and holds one that was trained with its arguments."""
    if not policy.file.exists():
        return False
    asked = json.loads(json.dumps(asdict(policy.arguments)))
    return bool(policy.network.provenance.get("arguments") == asked)


def publish(policies: Sequence[Policy], folder: Path = PRETRAINED) -> None:
    """Copy trained policies to where those are that come with the project."""
    for policy in policies:
        with replacing(folder / pretrained(policy.arguments).name) as file:
            shutil.copyfile(policy.file, file)


def policy_key(arguments: PPOArguments) -> str:
    """Return a name made of everything that shapes a policy."""
    return fingerprint(__name__, arguments=asdict(arguments))


def trained_policy(
    arguments: PPOArguments, folder: Path, *, retrain: bool, progress: bool
) -> PolicyNetwork:
    """Load the policy that a folder holds, or finish or begin its training.

    Parameters
    ----------
    arguments
        How to train.
    folder
        Where the policy is kept: `policy.npz` when it is finished, `checkpoint.npz` until
        then. Both are archives of arrays and JSON, with checksums; reading them runs nothing
        that they hold.
    retrain
        Whether to forget what the folder holds.
    progress
        Whether to show a progress bar.

    Returns
    -------
    PolicyNetwork
        The policy. Training that was interrupted and resumed ends in the same policy, to the
        bit, as training that was not.

    Raises
    ------
    ValueError
        If a file is damaged; the message names it, and what to do.
    """
    policy, checkpoint = folder / POLICY, folder / CHECKPOINT
    if retrain:
        policy.unlink(missing_ok=True)
        checkpoint.unlink(missing_ok=True)
    if policy.exists():
        return _load(policy)
    from benchmarks.train import ppo_training  # here: torch takes seconds to load

    network = ppo_training.train(arguments, checkpoint, progress=progress)
    with replacing(policy) as file:
        network.save(file)
    checkpoint.unlink(missing_ok=True)
    return network
