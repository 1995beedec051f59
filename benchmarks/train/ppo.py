"""Train policies by PPO of Stable-Baselines3 on many plants, and export the policies to NumPy.

The dict `RECIPES` has a recipe `ppo` for the paper's plant, and a recipe `ppo-hard` for plants
that differ between episodes. The module `benchmarks/examples/sb3.py` has the code of the
training, and explains why the training is fast.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, NamedTuple, NoReturn, cast

import numpy as np
import torch
from gymnasium.spaces import Box
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn
from torch import nn

from agents import PolicyNetwork
from benchmarks.controllers.known_plant import PAPER, KnownPlant
from benchmarks.examples.sb3 import GROUP, SETTINGS, Exploration, inputs, make_ppo
from benchmarks.lib.outputs import versions
from benchmarks.lib.seeds import SEEDS
from mptc_gym import PRESETS, Parameters, evaluate
from mptc_gym.evaluation import VALIDATION_SEED
from mptc_gym.sb3 import make_vec_env

Array = NDArray[np.float64]

TRAINING_SEEDS = SEEDS["training"].start  # least seed of the training plants
# Change of the flow per sample at an action of 1, as a share of half the actuator's range: with
# 2.0, the flow can cross the entire range in a sample.
MAX_MOVE = 2.0
SETPOINT_SCALE = 0.2  # from degC to an input of order 1


class TrainingPlants(NamedTuple):
    """Training plants of one kind."""

    number: int  # number of plants
    arguments: Mapping[str, Any]  # arguments of the environment for these plants


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Settings for the training of a policy by PPO."""

    plants: tuple[TrainingPlants, ...]  # the kinds of training plants
    # Arguments of the environment for each case of the validation, by name. No published result
    # uses these cases.
    cases: Mapping[str, Mapping[str, Any]]
    # The environment's argument `compensated_dead_zone`, t/h. Unless it is 0, a comparison
    # replaces it by the half width of the plant's dead zone, if that is not a range.
    dead_zone: float
    # Whether the policy's inputs include the set point and the flow, in addition to the error
    # and to changes of set point, temperature and flow.
    levels: bool
    hidden: tuple[int, ...]  # nodes of the policy's hidden layers; () for a linear policy
    memory: int  # number of past temperatures, and of past flows, in the observation
    steps: int  # samples of experience, summed over all plants
    # Natural logarithm of the standard deviation of the action, at the start and at the end of
    # the training.
    log_std: tuple[float, float] = (-1.2, -3.5)
    # Arguments of the environment for the plant to which `for_plant` has adapted the recipe.
    plant: Mapping[str, Any] = field(default_factory=dict)

    @property
    def windows(self) -> dict[str, Any]:
        """The arguments of the environment that determine the policy's observation."""
        return {
            "setpoint_window": 3,
            "error_window": 1,
            "output_window": self.memory,
            "action_window": self.memory,
        }

    @property
    def temperature_scale(self) -> float:
        """The plant's temperatures as a multiple of those of the paper's plant."""
        amplitude: float = Parameters(**self.plant).setpoint_amplitude
        return amplitude / PAPER.parameters.setpoint_amplitude


# An error of `error_scale`, degC, has the reward -1. With this scale, returns are of order 1,
# so that the value function is learnt quickly.
_COST: dict[str, Any] = {"reward": "absolute", "error_scale": 50.0}
_RANDOM: dict[str, Any] = {**_COST, "setpoint": "random", "setpoint_amplitude": 6.0}
_NOISE = 0.6  # noise variance of most training plants of the recipe `ppo`, degC^2
# The square wave of the validation differs from that of the published results.
_VALIDATION: dict[str, Any] = {"setpoint_amplitude": 5.4, "setpoint_period": 500}

RECIPES = {
    "ppo": Recipe(
        plants=(
            TrainingPlants(152, _RANDOM),
            TrainingPlants(360, {**_RANDOM, "noise_variance": _NOISE}),
        ),
        cases={"calm": _VALIDATION, "noise": {**_VALIDATION, "noise_variance": 0.4}},
        dead_zone=5.0,
        levels=False,
        hidden=(),
        memory=192,
        steps=5_000_000,
        log_std=(-1.2, -4.0),
    ),
    "ppo-hard": Recipe(
        plants=(TrainingPlants(512, {**PRESETS["hard"], **_COST, "setpoint_amplitude": 5.5}),),
        cases={"hard": {**PRESETS["hard"], "setpoint_amplitude": 5.5, "setpoint_period": 560}},
        dead_zone=0.0,
        levels=True,
        hidden=(64, 64),
        memory=64,
        steps=4_000_000,
    ),
}


def for_plant(plant: Mapping[str, Any]) -> Recipe:
    """Return the recipe `ppo`, adapted to a plant that differs from the paper's plant.

    In the adapted recipe, set points, errors and temperatures are scaled in proportion to the
    plant's argument `setpoint_amplitude`. If the plant has no noise, most training plants get
    noise, whose standard deviation is in proportion to the steady temperature change by half
    the flow range.

    Parameters
    ----------
    plant
        Arguments of the environment for the plant.
    """
    recipe = replace(RECIPES["ppo"], plant=plant)
    scale = recipe.temperature_scale
    known = KnownPlant(plant)
    calm, noisy = recipe.plants
    training = {
        **plant,
        **_RANDOM,
        "error_scale": _COST["error_scale"] * scale,
        "setpoint_amplitude": _RANDOM["setpoint_amplitude"] * scale,
    }
    noise = {}
    if known.parameters.range_of("noise_variance")[1] == 0.0:
        ratio = known.temperature_range / PAPER.temperature_range
        noise["noise_variance"] = _NOISE * ratio**2
    # A period of 500 samples for the paper's 600, and always an even number of samples.
    half_period = max(1, round(known.parameters.setpoint_period * 500 / 1200))
    validation = {
        **plant,
        "setpoint": "square",
        "setpoint_amplitude": _VALIDATION["setpoint_amplitude"] * scale,
        "setpoint_period": 2 * half_period,
    }
    return replace(
        recipe,
        plants=(calm._replace(arguments=training), noisy._replace(arguments=training | noise)),
        cases={"plant": validation},
        dead_zone=known.dead_zone,
    )


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
    model.learn(recipe.steps, callback=Exploration(*recipe.log_std))
    seconds = time.process_time() - began
    policy = export(model, recipe)
    validation = {}  # mean errors, degC
    for name, case in recipe.cases.items():
        result = evaluate(policy, seed=VALIDATION_SEED, **{**policy.interface, **case})
        validation[name] = result.mean_error
    settings = asdict(recipe)
    policy.provenance = {
        "algorithm": "PPO of Stable-Baselines3",
        "plant": settings.pop("plant"),
        "recipe": settings | SETTINGS,
        "seed": seed,
        "steps": model.num_timesteps,
        "cpu_seconds": round(seconds, 1),
        "validation": validation,
        "versions": versions(),
    }
    return policy


def begin(recipe: Recipe, seed: int) -> PPO:
    """Return an untrained PPO model of Stable-Baselines3 with the settings in `recipe`.

    `seed` is the seed of the initial weights, the exploration and the plants.
    """
    torch.set_num_threads(1)  # the networks are too small for more threads
    layers = {"pi": list(recipe.hidden), "vf": [64, 64]}
    return make_ppo(Plants(recipe), seed, net_arch=layers)


class Plants(VecEnv):
    """The training plants of `recipe`, as a vector environment of Stable-Baselines3.

    Plants of different kinds, such as calm and noisy plants, are in separate batches. Each
    group of `GROUP` successive plants has one seed, so all plants of the group have the same
    parameter values, noise and set points. An observation of `Plants` has the inputs of the
    policy: an observation of `MiddlePoint-v0`, multiplied by the matrix that `features`
    returns.

    Parameters
    ----------
    recipe
        Settings of the training, with the arguments of the plants.
    """

    def __init__(self, recipe: Recipe) -> None:
        self.batches = [
            make_vec_env(
                "MiddlePoint-v0",
                plants.number,
                group=GROUP,
                action="change",
                max_move=MAX_MOVE,
                compensated_dead_zone=recipe.dead_zone,
                **recipe.windows,
                **plants.arguments,
            )
            for plants in recipe.plants
        ]
        # Shape (length of an observation, number of inputs of the policy).
        self._features = features(recipe).T.astype(np.float32)
        observation_space = Box(-np.inf, np.inf, self._features.shape[1:])
        num_envs = sum(batch.num_envs for batch in self.batches)
        super().__init__(num_envs, observation_space, self.batches[0].action_space)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Set and return the seeds of the plants for the next reset.

        The seeds of the plants are computed from `seed`, in a range of seeds that no comparison
        of controllers uses.
        """
        offset = int(np.random.SeedSequence(seed).generate_state(1)[0])  # below 2**32
        seeds: list[int | None] = []
        for batch in self.batches:
            earlier_groups = len(seeds) // GROUP  # in the batches before this one
            seeds += batch.seed(TRAINING_SEEDS + offset + earlier_groups)
        return seeds

    def reset(self) -> NDArray[Any]:
        """Reset all plants, and return the policy's inputs, shape (plants, inputs)."""
        return np.concatenate([batch.reset() for batch in self.batches]) @ self._features

    def step_async(self, actions: NDArray[Any]) -> None:
        """Store actions of shape (plants, 1) for the next call of `step_wait`."""
        ends = np.cumsum([batch.num_envs for batch in self.batches])
        for batch, of_batch in zip(self.batches, np.split(actions, ends[:-1]), strict=True):
            batch.step_async(of_batch)

    def step_wait(self) -> VecEnvStepReturn:
        """Step all plants by the actions of `step_async`, as a `VecEnv` does.

        The returned observations, and the items "terminal_observation" of the infos, are inputs
        of the policy.
        """
        returned = [batch.step_wait() for batch in self.batches]
        observations, rewards, ended, infos = zip(*returned, strict=True)
        all_infos = [info for infos_of_batch in infos for info in infos_of_batch]
        all_ended = np.concatenate(ended)
        for i in np.flatnonzero(all_ended).tolist():
            last_observation = all_infos[i]["terminal_observation"]
            all_infos[i]["terminal_observation"] = last_observation @ self._features
        inputs_of_policy = np.concatenate(observations) @ self._features
        return inputs_of_policy, np.concatenate(rewards), all_ended, all_infos

    def close(self) -> None:
        """Close the batches."""
        for batch in self.batches:
            batch.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return the value of an attribute for each plant; `indices` is ignored."""
        return [value for batch in self.batches for value in batch.get_attr(attr_name)]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """Return False for each plant."""
        return [False] * self.num_envs

    def env_method(self, *args: Any, **kwargs: Any) -> NoReturn:
        """Raise a NotImplementedError, as there are no single environments."""
        raise NotImplementedError

    set_attr = env_method


def features(recipe: Recipe) -> Array:
    """Return the matrix that converts an observation to the inputs of the policy.

    The returned matrix has the shape (number of inputs, length of an observation). The inputs
    of the policy are the control error; the changes of set point, temperature and flow; and, if
    `recipe.levels` is true, the set point and the flow.
    """
    # The inputs are linear in the observation. So row i of the transposed matrix has the inputs
    # for an observation that is 1 at the element i and 0 elsewhere.
    observations = torch.eye(sum(recipe.windows.values()), dtype=torch.float64)
    # The last elements are the past flows; all elements before them are temperatures.
    observations[: -recipe.memory] /= recipe.temperature_scale
    transposed = inputs(observations, recipe.windows)
    if recipe.levels:
        setpoint = SETPOINT_SCALE * observations[:, :1]
        flow = observations[:, -recipe.memory, None]
        transposed = torch.hstack([transposed, setpoint, flow])
    return cast("Array", transposed.numpy().T)


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
    layers[0] = (first_weights @ features(recipe), first_biases)
    return PolicyNetwork(
        layers,
        observation=recipe.windows,
        action="change",
        max_move=MAX_MOVE,
        compensated_dead_zone=recipe.dead_zone,
        **KnownPlant(recipe.plant).limits,
    )
