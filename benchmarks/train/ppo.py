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
from functools import cache, partial
from pathlib import Path
from typing import Any, cast

from agents import Increments, PolicyNetwork
from agents.policy_network import PRETRAINED
from benchmarks.controllers.records import Account, Training
from benchmarks.designs import SPANS
from benchmarks.lib.fingerprint import fingerprint
from benchmarks.lib.storage import replacing
from mptc_gym import Parameters

POLICIES = 5  # are trained and compared, from seeds in sequence
TUNING_SEED, FINAL_SEED = 1000, 2000  # of policies in a search, others than a comparison uses
POLICY, CHECKPOINT = "policy.npz", "checkpoint.npz"
DELAY, DEAD_ZONE = 18, 5.0  # of the paper's plant, samples and t/h


@dataclass(frozen=True)
class PPOArguments:
    """Everything that shapes a policy, except versions and code."""

    seed: int = 10_000
    """Of the initial policy, the exploration, and what the plants meet in training."""
    steps: int = 1_196_032
    """Samples of experience, all plants together."""
    starts: int = 4
    """How often to begin anew, with other initial weights and an equal share of the samples.
    Validation chooses the best of all: many a training ends with an offset, and more samples do
    not mend that."""
    max_move: float = 1.0
    """How far an action of 1 moves the flow, as a share of half its range."""
    undo_dead_zone: float = DEAD_ZONE
    """The dead zone that is undone on the way from the policy to the plant, t/h. A comparison
    takes that of the plant that is run."""
    noise_variance: float = 0.5
    """R of the plants trained on, degC^2. A policy trained with noise steers less nervously,
    and does better with another dead zone than one trained on that plant."""
    calm: float = 0.75
    """Share of the plants that have no noise. In noise, small offsets hardly cost anything."""
    plant: dict[str, Any] = field(default_factory=dict)
    """Arguments of the environment trained on, where it is not the nominal plant."""
    setpoint_amplitude: float = 6.0
    """Random set points are uniform within this, degC."""
    reward: str = "absolute"
    """The environment's; "absolute" is what the comparison measures."""
    error_scale: float = 50.0
    """The environment's, degC. It makes returns about 1 in size, which a value function learns
    much sooner than large ones."""
    error_window: int = 3
    """Errors in the observation."""
    action_window: int = DELAY + 3
    """Past actions in the observation, the differences of which are the past moves; with
    delay + 2 moves the noise-free problem is Markov."""
    n_envs: int = 64
    """Plants that are stepped at once."""
    n_steps: int = 64
    """Samples of each plant between two updates."""
    batch_size: int = 1024
    """Samples of a gradient step."""
    n_epochs: int = 5
    """How often an update goes through its samples."""
    learning_rate: float = 2e-3
    """At the start; it falls linearly, to a twentieth."""
    gamma: float = 0.95
    """Discount a sample."""
    gae_lambda: float = 1.0
    """Below 1, advantages lean on the value function, also for what the delay still hides."""
    clip_range: float = 0.2
    """How far an update may move the probability of an action."""
    log_std: tuple[float, float] = (-1.0, -3.0)
    """Logarithm of the standard deviation of the action, at first and at last. Left to itself
    it stays high, and a mean that is right with the exploration is wrong without it."""
    hidden: tuple[int, ...] = (64, 64)
    """Nodes of the hidden layers, of policy and value function alike."""

    @property
    def observation(self) -> dict[str, Any]:
        """Arguments of the environment that give the policy its observation."""
        return {"error_window": self.error_window, "action_window": self.action_window}

    @property
    def training(self) -> dict[str, Any]:
        """Arguments of the environment trained on."""
        return {
            **self.observation,
            **self.plant,
            "noise_variance": self.noise_variance,
            "reward": self.reward,
            "error_scale": self.error_scale,
            "setpoint": "random",
            "setpoint_amplitude": self.setpoint_amplitude,
        }

    @property
    def plants(self) -> list[tuple[int, dict[str, Any]]]:
        """How many plants to train on, and their arguments: the noisy ones, then the calm."""
        calm = round(self.calm * self.n_envs)
        groups = [
            (self.n_envs - calm, self.training),
            (calm, {**self.training, "noise_variance": 0.0}),
        ]
        return [(count, arguments) for count, arguments in groups if count]


# What makes a policy one for many plants, those of a random design.
RANDOMISED: dict[str, Any] = {
    "plant": {name: list(span) for name, span in SPANS.items() if name != "noise_variance"},
    "action_window": 39,
}


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
