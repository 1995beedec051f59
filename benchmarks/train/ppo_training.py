"""How PPO of Stable-Baselines3 learns to control the plant, and its checkpoints."""

from __future__ import annotations

import copy
import json
import math
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np
import torch
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv
from torch import nn
from tqdm import tqdm

from agents import Increments, PolicyNetwork
from benchmarks.lib.storage import replacing, versions
from benchmarks.metrics import mean_error
from benchmarks.rollout import make_plants, rollout
from benchmarks.scenarios import SCENARIOS
from benchmarks.train.ppo import PPOArguments
from benchmarks.train.sb3_vec_env import GymnasiumVecEnv
from mptc_gym import Parameters
from mptc_gym.wrappers.vector import IncrementalAction

CHECKPOINT_INTERVAL = 32_768  # samples of experience between checkpoints
VALIDATION_RUNS = 16
VALIDATION_SEED = 2_000_000  # met neither in training nor by any comparison
VALIDATION_DEAD_ZONE = 6.5  # t/h, one that no comparison has
# Set points that no comparison has, and that can be held with either dead zone: smaller ones
# need a flow within it. A policy is often worse at them at the end than it was before.
HELD = [level for level in (4.8, -5.6, 5.3, -4.7, 5.8, -5.1) for _ in range(150)]
PROBE = SCENARIOS["square"]  # shown in the learning curve, without a part in the training
PROBE_SEED = 1_000_000  # met by no comparison
TRAINING_SEEDS = (
    1 << 32
)  # and above: of what the plants meet in training, and nothing else does
_MOMENTS = "step", "exp_avg", "exp_avg_sq"  # what Adam remembers of a parameter


def train(
    arguments: PPOArguments, checkpoint: Path | None = None, *, progress: bool = False
) -> PolicyNetwork:
    """Train a policy, or finish its training.

    Parameters
    ----------
    arguments
        How to train.
    checkpoint
        Where the training is kept as it goes. If the file is there, the training goes on from
        it, and ends in the same policy, to the bit, as one that was not interrupted.
    progress
        Whether to show a progress bar.

    Returns
    -------
    PolicyNetwork
        The policy that did best in validation: on set points that are met neither in training
        nor in a comparison. Its provenance holds the arguments and the learning curve.

    Raises
    ------
    ValueError
        If the checkpoint is damaged; the message names it.
    """
    model = begin(arguments)
    kept = Progress()
    if checkpoint is not None and checkpoint.exists():
        kept = _resume(model, arguments, checkpoint)
    bar = tqdm(
        desc=f"training PPO, seed {arguments.seed}",
        total=arguments.steps,
        initial=model.num_timesteps,
        unit=" samples",
        unit_scale=True,
        disable=not progress,
    )
    with bar:
        keeper = Keeper(arguments, kept, bar, checkpoint)
        left = arguments.steps - model.num_timesteps
        model.learn(left, callback=keeper, reset_num_timesteps=False)
        keeper.finish()
    provenance = {
        "algorithm": "PPO of Stable-Baselines3",
        "arguments": asdict(arguments),
        "versions": versions(),
        "curve": kept.curve,
    }
    return exported(kept.best, arguments, provenance)


def features(parameters: Parameters) -> NDArray[np.float64]:
    """Return what turns an observation into the inputs of the networks.

    They are the error, how set point and error change, the flow and the past moves: what
    holds the flow is that nothing changes. Factors bring each to about 1.

    Parameters
    ----------
    parameters
        Of the environment, for its windows.

    Returns
    -------
    ndarray
        Shape (inputs, observation_size).
    """
    size, (error, _, action) = parameters.observation_size, parameters.heads
    rows: list[NDArray[np.float64]] = []

    def add(factor: float, *elements: int) -> None:
        """Add an element, or the difference of two."""
        rows.append(np.zeros(size))
        rows[-1][list(elements)] = [factor, -factor][: len(elements)]

    add(1.0, error)
    add(0.2, 0)
    add(1.0, action)
    for factor, first, last in ((0.1, 0, error), (0.5, error, action), (2.0, action, size)):
        for newer in range(first, last - 1):
            add(factor, newer, newer + 1)
    return np.array(rows)


class FixedFeatures(BaseFeaturesExtractor):
    """Multiplies observations with a fixed matrix: the same in training and in use.

    Parameters
    ----------
    observation_space
        Of the environment.
    matrix
        Shape (inputs, observation_size), as lists.
    """

    matrix: torch.Tensor

    def __init__(
        self, observation_space: gymnasium.spaces.Box, matrix: list[list[float]]
    ) -> None:
        super().__init__(observation_space, features_dim=len(matrix))
        self.register_buffer("matrix", torch.tensor(matrix))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Return the inputs of the networks."""
        return observations @ self.matrix.T


class OddPolicy(ActorCriticPolicy):
    """A policy whose mean is an odd function: the plant is the same upside down.

    It has no biases. So where error, flow and set point have the other sign, the mean has it,
    too, and what is learnt at +5 degC is known at -5 degC.
    """

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        for layer in (*self.mlp_extractor.policy_net, self.action_net):
            if isinstance(layer, nn.Linear):
                nn.init.zeros_(layer.bias)
                layer.bias.requires_grad_(False)


def begin(arguments: PPOArguments, plants: VecEnv | None = None) -> PPO:
    """Make a model that has learnt nothing yet.

    Parameters
    ----------
    arguments
        How it is to be trained.
    plants
        What to train on, if not a batch of plants that are stepped at once. Its action is one
        of `IncrementalAction`.

    Returns
    -------
    PPO
        The model.
    """
    torch.set_num_threads(1)  # the networks are too small for more
    if plants is None:
        plants = GymnasiumVecEnv(
            *(
                _incremental(
                    gymnasium.make_vec(
                        "MiddlePoint-v0", count, autoreset_mode="SameStep", **given
                    ),
                    arguments,
                )
                for count, given in arguments.plants
            )
        )
    matrix = features(Parameters(**arguments.training))
    return PPO(
        OddPolicy,
        plants,
        # The last update comes when no progress remains; it is not to be in vain.
        learning_rate=lambda remaining: arguments.learning_rate * max(remaining, 0.05),
        n_steps=arguments.n_steps,
        batch_size=arguments.batch_size,
        n_epochs=arguments.n_epochs,
        gamma=arguments.gamma,
        gae_lambda=arguments.gae_lambda,
        clip_range=arguments.clip_range,
        policy_kwargs={
            "features_extractor_class": FixedFeatures,
            "features_extractor_kwargs": {"matrix": matrix.tolist()},
            "net_arch": list(arguments.hidden),
        },
        seed=arguments.seed,
        device="cpu",
    )


def _incremental(plants: VectorEnv[Any, Any, Any], arguments: PPOArguments) -> VectorEnv:
    return IncrementalAction(
        plants, max_move=arguments.max_move, undo_dead_zone=arguments.undo_dead_zone
    )


def exported(
    state: Mapping[str, torch.Tensor],
    arguments: PPOArguments,
    provenance: dict[str, Any] | None = None,
) -> PolicyNetwork:
    """Return the mean of a policy as a controller that needs NumPy alone.

    Parameters
    ----------
    state
        The policy's parameters, by their names in PyTorch.
    arguments
        How it was made.
    provenance
        Where its weights come from.
    """
    # Stable-Baselines3 has an activation after each hidden layer, which counts as one, too.
    names = [f"mlp_extractor.policy_net.{2 * i}" for i in range(len(arguments.hidden))]
    (first, bias), *others = [
        (state[f"{name}.weight"].double().numpy(), state[f"{name}.bias"].double().numpy())
        for name in (*names, "action_net")
    ]
    parameters = Parameters(**arguments.training)
    windows = "setpoint_window", "error_window", "output_window", "action_window"
    return PolicyNetwork(
        [(first @ features(parameters), bias), *others],
        observation=dict(zip(windows, parameters.windows, strict=True)),
        input_scale=np.ones(parameters.observation_size),
        activation="tanh",
        increments=Increments(arguments.max_move, arguments.undo_dead_zone),
        provenance=provenance,
    )


State = dict[str, torch.Tensor]


@dataclass
class Progress:
    """How far a training got, apart from its model.

    Attributes
    ----------
    curve
        The learning curve, a row a point.
    average
        The moving average of the policy's parameters.
    best
        What that was when it did best in validation.
    """

    curve: list[dict[str, float]] = field(default_factory=list)
    average: State = field(default_factory=dict)
    best: State = field(default_factory=dict)


class Keeper(BaseCallback):
    """Makes a training one of stretches, and between two of them records how far it got.

    Each stretch begins with plants at rest and with random numbers of its own. So a training
    that goes on after one is the same, to the bit, as one that was not interrupted, and all
    that has to be kept is what was learnt.

    Parameters
    ----------
    arguments
        How the policy is trained.
    progress
        How far the training got; it is carried on.
    bar
        Shows it.
    checkpoint
        Where to keep the training after each stretch, if anywhere.
    """

    def __init__(
        self,
        arguments: PPOArguments,
        progress: Progress,
        bar: tqdm[Any],
        checkpoint: Path | None,
    ) -> None:
        super().__init__()
        self.progress = progress
        self._bar = bar
        self.arguments = arguments
        self._checkpoint = checkpoint
        self._errors: list[float] = []
        spent = progress.curve[-1]["seconds"] if progress.curve else 0.0
        self._began = time.process_time() - spent

    @property
    def _plants(self) -> GymnasiumVecEnv:
        return cast("GymnasiumVecEnv", self.training_env)

    def _on_step(self) -> bool:
        errors = self._plants.infos["error"]
        self._errors.append(float(np.mean(np.abs(errors))))
        self._bar.update(self._plants.num_envs)
        return True

    def _on_rollout_start(self) -> None:
        self._average()
        done = self.num_timesteps / self.arguments.steps
        with torch.no_grad():
            log_std = np.interp(done, (0.0, 1.0), self.arguments.log_std)
            cast("torch.Tensor", self.model.policy.log_std).fill_(float(log_std))
        curve = self.progress.curve
        before = curve[-1]["steps"] if curve else 0
        if self.num_timesteps - before >= CHECKPOINT_INTERVAL:
            self.record()
            if self._checkpoint is not None:
                _save(self, self._checkpoint)
            self._begin_stretch()
        elif not self._errors:
            self._begin_stretch()

    def _average(self) -> None:
        """Take an update into the moving average."""
        keeps, state = self.arguments.averaging, self.model.policy.state_dict()
        average = self.progress.average or copy.deepcopy(state)
        self.progress.average = {
            name: value.lerp(state[name], 1.0 - keeps) for name, value in average.items()
        }

    def _begin_stretch(self) -> None:
        """Bring the plants to rest, and start all random numbers anew."""
        seeds = np.random.SeedSequence([self.arguments.seed, len(self.progress.curve)])
        plants, numbers = seeds.generate_state(2).tolist()
        set_random_seed(numbers)
        self._plants.seed(TRAINING_SEEDS + plants)
        self.model._last_obs = self._plants.reset()
        self.model._last_episode_starts = np.ones(self._plants.num_envs, np.bool_)

    def finish(self) -> None:
        """Take in and record what the last update brought."""
        self._average()
        self.record()

    def record(self) -> None:
        """Add a point to the learning curve, and keep the policy if it is the best so far."""
        held = {**self.arguments.observation, "setpoint": HELD}
        noisy = {**self.arguments.training, "setpoint": HELD}
        validation = np.mean(
            [
                self._mae(noisy, VALIDATION_RUNS, len(HELD), VALIDATION_SEED),
                self._mae(held, 1, len(HELD), 0),
                self._mae({**held, "dead_zone": VALIDATION_DEAD_ZONE}, 1, len(HELD), 0),
            ]
        )
        curve = self.progress.curve
        if not curve or validation < min(point["validation_mae"] for point in curve):
            self.progress.best = self.progress.average
        square = {**self.arguments.observation, **PROBE.arguments}
        curve.append(
            {
                "steps": self.num_timesteps,
                "seconds": time.process_time() - self._began,  # of the processor
                "training_mae": float(np.mean(self._errors)) if self._errors else math.nan,
                "validation_mae": float(validation),
                "square_mae": self._mae(square, 1, PROBE.samples, PROBE_SEED),
            }
        )
        self._errors.clear()
        self._bar.set_postfix_str(f"mean |e| {validation:.3f}")

    def _mae(self, arguments: dict[str, Any], runs: int, samples: int, seed: int) -> float:
        plants = make_plants(runs, samples, **arguments)
        agent = exported(self.progress.average, self.arguments)
        return float(mean_error(rollout(plants, agent, samples, seed)).mean())


def _save(keeper: Keeper, path: Path) -> None:
    """Write all that a training needs to go on after a stretch."""
    arrays: dict[str, NDArray[Any]] = {}
    progress = keeper.progress
    states = {
        "policy": keeper.model.policy.state_dict(),
        "average": progress.average,
        "best": progress.best,
    }
    for kind, state in states.items():
        arrays |= {f"{kind} {name}": value.numpy() for name, value in state.items()}
    moments = keeper.model.policy.optimizer.state_dict()["state"]
    for i, moment in moments.items():
        arrays |= {f"moment {i} {name}": moment[name].numpy() for name in _MOMENTS}
    about = {
        "arguments": asdict(keeper.arguments),
        "steps": keeper.num_timesteps,
        "moments": sorted(moments),
        "curve": progress.curve,
    }
    with replacing(path) as file:
        np.savez(file, about=np.array(json.dumps(about)), **arrays)  # type: ignore[arg-type]


def _resume(model: PPO, arguments: PPOArguments, path: Path) -> Progress:
    """Bring a new model to where a checkpoint was kept."""
    try:
        # All of it is read, as that is when the checksums are looked at.
        with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            arrays = {
                name: torch.from_numpy(file[name]) for name in file.files if name != "about"
            }
            about = json.loads(str(file["about"]))
        if about["arguments"] != json.loads(json.dumps(asdict(arguments))):
            raise ValueError("it is of another training")
        policy, average, best = (
            {name: arrays[f"{kind} {name}"] for name in model.policy.state_dict()}
            for kind in ("policy", "average", "best")
        )
        moments = {
            i: {name: arrays[f"moment {i} {name}"] for name in _MOMENTS}
            for i in about["moments"]
        }
        groups = model.policy.optimizer.state_dict()["param_groups"]
        model.policy.load_state_dict(policy)
        model.policy.optimizer.load_state_dict({"state": moments, "param_groups": groups})
        model.num_timesteps = int(about["steps"])
        progress = Progress([dict(point) for point in about["curve"]], average, best)
    except Exception as error:  # damage shows in zip, zlib, NumPy, JSON or the shapes
        raise ValueError(
            f"{path} is no checkpoint of this training, or is damaged: {error}: "
            "remove it, or --retrain"
        ) from error
    return progress
