"""Train policies by PPO of Stable-Baselines3 on many plants, and export the policies to NumPy.

Four choices make the training of PPO fast:

- **Groups.** The eight plants of a group have the same noise and set points, and differ only in
  the random part of their actions. From the advantage of each plant, the mean advantage of the
  plant's group is subtracted, which makes the variance of the advantages much smaller.

- **Changes as inputs.** The policy's inputs are the error, and the changes of set point,
  temperature and flow, but, on the paper's plant, not the values of set point, temperature and
  flow. The policy network has no biases, so the policy keeps the flow constant only if the
  error is 0: there is no steady-state error. A policy without the temperature as an input
  behaves in the same way at temperatures of -5 degC and +5 degC.

- **Less and less exploration.** The standard deviation of the actions falls by a schedule,
  because a standard deviation that PPO learns remains too high.

- **Changes of the flow as actions.** With `action="change"`, an action is a change of the flow,
  and the commands skip the dead zone of the valve.
"""

import time
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, cast

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from torch import Tensor, nn

from agents import PolicyNetwork
from benchmarks.controllers.known_plant import KnownPlant
from benchmarks.lib.outputs import versions
from benchmarks.lib.seeds import SEEDS
from benchmarks.train.learning import score
from benchmarks.train.recipe import Recipe, inputs
from mptc_gym import evaluate
from mptc_gym.evaluation import VALIDATION_SEED
from mptc_gym.sb3 import GymnasiumVecEnv

TRAINING_SEEDS = SEEDS["training"].start  # least seed of the training plants
GROUP = 8  # number of plants that have the same noise and set points
SCORES = 20  # number of scores during a training run, after that of the untrained policy
# Arguments of the class `PPO`.
SETTINGS: dict[str, Any] = {
    "n_steps": 64,  # samples per plant between two updates of the policy
    "batch_size": 4096,
    "n_epochs": 5,
    "gamma": 0.96,  # discount factor per sample
    # With a lambda below 1, advantages would depend on how well the value function predicts the
    # rewards after the delay.
    "gae_lambda": 1.0,
}


def train(recipe: Recipe, seed: int) -> PolicyNetwork:
    """Train a policy, and return it with validation results in the attribute `provenance`.

    Parameters
    ----------
    recipe
        Settings of the training.
    seed
        Seed of the initial weights, the exploration and the plants.
    """
    began = time.process_time()
    model = begin(recipe, seed)
    curve = LearningCurve(recipe)
    model.learn(recipe.steps, callback=[Exploration(*recipe.log_std), curve])
    # With the time of the learning curve, but not that of the validation.
    seconds = time.process_time() - began
    policy = export(model, recipe)
    validation = {}  # mean errors, degC
    for name, case in recipe.cases.items():
        result = evaluate(policy, seed=VALIDATION_SEED, **{**policy.interface, **case})
        validation[name] = result.mean_error
    policy.provenance = {
        "algorithm": "PPO of Stable-Baselines3",
        **settings_of(recipe),
        "seed": seed,
        "steps": model.num_timesteps,
        "cpu_seconds": round(seconds, 1),
        "validation": validation,
        "learning": curve.points,
        "versions": versions(),
    }
    return policy


def settings_of(recipe: Recipe) -> dict[str, Any]:
    """Return the plant and the settings of a training run, as the network file has them."""
    settings = asdict(recipe)
    plant = settings.pop("plant")
    del settings["scored_on"]  # which has no effect on the policy
    return {"plant": plant, "recipe": settings | SETTINGS}


def begin(recipe: Recipe, seed: int) -> PPO:
    """Return an untrained PPO model of Stable-Baselines3 with the settings in `recipe`.

    The policy network has no biases. `seed` is the seed of the initial weights, the exploration
    and the plants.
    """
    torch.set_num_threads(1)  # the networks are too small for more threads
    model = PPO(
        "MlpPolicy",
        TrainingVecEnv(recipe),
        # The learning rate falls with the share of the training that remains. At the last
        # update, this share is 0 or below, and the limit 0.05 keeps the learning rate above 0.
        learning_rate=lambda remaining: 2e-3 * max(remaining, 0.05),
        rollout_buffer_class=GroupBuffer,
        policy_kwargs={"net_arch": {"pi": list(recipe.hidden), "vf": [64, 64]}},
        seed=seed,
        device="cpu",
        **SETTINGS,
    )
    for layer in (*model.policy.mlp_extractor.policy_net, model.policy.action_net):
        if isinstance(layer, nn.Linear):
            nn.init.zeros_(layer.bias)
            layer.bias.requires_grad_(False)
    return model


class TrainingBatch(VectorEnv[Any, Any, Any]):
    """The training plants of a recipe side by side, whose observations are a policy's inputs.

    Plants of different kinds, such as calm and noisy plants, are in separate batches. All
    episodes have the same length and begin at the same time.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(self, recipe: Recipe) -> None:
        self.batches = [
            gymnasium.make_vec(
                "MiddlePoint-v0",
                plants.number,
                autoreset_mode="SameStep",
                **recipe.interface,
                **plants.arguments,
            )
            for plants in recipe.plants
        ]
        self.num_envs = sum(batch.num_envs for batch in self.batches)
        # Number of the first plant of each batch but the first one.
        self._firsts = np.cumsum([batch.num_envs for batch in self.batches[:-1]])
        # Shape (length of an observation, number of inputs). The order in memory decides the
        # last bits of the products of one row at the end of an episode, so it is fixed.
        self._inputs = inputs(recipe).T.astype(np.float32, order="C")
        self.single_observation_space = Box(-np.inf, np.inf, self._inputs.shape[1:])
        self.single_action_space = self.batches[0].single_action_space

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[NDArray[Any], Any]:
        """Reset all plants with a list of seeds, and return inputs, shape (plants, inputs)."""
        seeds = np.split(np.array(seed), self._firsts)  # a part for each batch
        returned = [
            batch.reset(seed=part.tolist())
            for batch, part in zip(self.batches, seeds, strict=True)
        ]
        return np.concatenate([observations for observations, _ in returned]) @ self._inputs, {}

    def step(self, actions: NDArray[Any]) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step all plants, as a vector environment of Gymnasium does.

        The infos are empty, but for the last inputs of the episodes when they end.
        """
        parts = np.split(actions, self._firsts)
        returned = [batch.step(part) for batch, part in zip(self.batches, parts, strict=True)]
        *arrays, infos = zip(*returned, strict=True)
        observations, rewards, terminated, truncated = map(np.concatenate, arrays)
        infos_of_all: dict[str, Any] = {}
        if truncated.any():  # then all episodes end
            last = [row for infos_of_batch in infos for row in infos_of_batch["final_obs"]]
            infos_of_all = {"final_obs": [row @ self._inputs for row in last], "final_info": {}}
        return observations @ self._inputs, rewards, terminated, truncated, infos_of_all


class TrainingVecEnv(GymnasiumVecEnv):
    """The training plants of a recipe for Stable-Baselines3, in groups of `GROUP` plants.

    The plants of a group have the same seed, and so the same parameter values, noise and set
    points.
    """

    def __init__(self, recipe: Recipe) -> None:
        super().__init__(TrainingBatch(recipe), group=GROUP)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Set and return the seeds of the plants for the next reset.

        The seeds of the plants are computed from `seed`, in a range of seeds that no comparison
        of controllers uses.
        """
        offset = int(np.random.SeedSequence(seed).generate_state(1)[0])  # below 2**32
        return super().seed(TRAINING_SEEDS + offset)


class GroupBuffer(RolloutBuffer):
    """A rollout buffer that subtracts from each advantage the mean advantage of a group."""

    def compute_returns_and_advantage(self, last_values: Tensor, dones: Any) -> None:
        """Compute returns, and advantages minus the mean advantage of a group of plants."""
        super().compute_returns_and_advantage(last_values, dones)
        # `groups` is a view of `self.advantages`, shape (samples, plants), and changes it.
        groups = self.advantages.reshape(self.buffer_size, -1, GROUP)
        groups -= groups.mean(axis=2, keepdims=True)


class Exploration(BaseCallback):
    """A callback that lowers the standard deviation of the actions during the training.

    The natural logarithm of the standard deviation of the actions changes linearly with the
    number of training steps so far.

    Parameters
    ----------
    first, last
        Natural logarithm of the standard deviation at the start and at the end of the training.
    """

    def __init__(self, first: float, last: float) -> None:
        super().__init__()
        self._first = first
        self._last = last

    def _on_step(self) -> bool:
        return True  # go on with the training

    def _on_rollout_start(self) -> None:
        """Set the standard deviation for the samples up to the next update of the policy."""
        progress = self.num_timesteps / self.locals["total_timesteps"]
        log_std = cast("nn.Parameter", self.model.policy.log_std)
        log_std.data.fill_(self._first + progress * (self._last - self._first))


class LearningCurve(BaseCallback):
    """A callback that scores the policy, without exploration, during the training.

    The training is equal, bit for bit, to one without this callback.

    Attributes
    ----------
    points : list of dict
        For each score, "samples" (the number of training samples so far), "mean_error" (degC)
        and "score" (None if the reference error is unknown).
    """

    def __init__(self, recipe: Recipe) -> None:
        super().__init__()
        self._recipe = recipe
        self.points: list[dict[str, float | None]] = []

    def _on_step(self) -> bool:
        return True  # go on with the training

    def _on_rollout_start(self) -> None:
        """Score the policy if a score is due."""
        if self.num_timesteps >= len(self.points) * self._recipe.steps / SCORES:
            self._score()

    def _on_training_end(self) -> None:
        """Score the policy that the training ends with."""
        self._score()

    def _score(self) -> None:
        """Add the score of the present policy, as a network in NumPy, to `points`."""
        network = export(cast("PPO", self.model), self._recipe)
        result = score(network, {**network.interface, **self._recipe.scored_on})
        self.points.append({"samples": self.num_timesteps, **result})


def export(model: PPO, recipe: Recipe) -> PolicyNetwork:
    """Return a trained policy, without exploration, as a network in NumPy.

    The matrix that converts an observation to inputs of the policy becomes part of the
    network's first layer, so the input of the network is an observation of `MiddlePoint-v0`.
    `model` was trained with `recipe`.
    """
    layers = []
    for layer in (*model.policy.mlp_extractor.policy_net, model.policy.action_net):
        if isinstance(layer, nn.Linear):  # The other layers are activation functions.
            weights = layer.weight.detach().double().numpy()
            layers.append((weights, layer.bias.detach().double().numpy()))
    first_weights, first_biases = layers[0]
    layers[0] = (first_weights @ inputs(recipe), first_biases)
    return PolicyNetwork(
        layers,
        observation=recipe.windows,
        action=recipe.interface["action"],
        max_move=recipe.interface["max_move"],
        compensated_dead_zone=recipe.dead_zone,
        **KnownPlant(recipe.plant).limits,
    )
