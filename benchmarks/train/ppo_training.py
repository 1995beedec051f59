"""Train PPO of Stable-Baselines3 to control the plant."""

from __future__ import annotations

import copy
import time
from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any, cast

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from agents import Increments, PolicyNetwork
from agents.policy_network import WINDOWS
from benchmarks.lib.storage import versions
from benchmarks.loop.metrics import mean_error
from benchmarks.loop.rollout import make_plants, rollout
from benchmarks.loop.scenarios import SCENARIOS
from benchmarks.train.ppo_arguments import PPOArguments
from mptc_gym import Parameters
from mptc_gym.sb3 import GymnasiumVecEnv
from mptc_gym.wrappers.vector import IncrementalAction

VALIDATION_INTERVAL = 32_768  # samples of experience
VALIDATION_RUNS = 16
VALIDATION_SEED = 2_000_000  # used neither in training nor in any comparison
VALIDATION_DEAD_ZONE = 6.5  # t/h, used in no comparison
# Set points that no comparison uses and that can be held with either dead zone: smaller ones
# need a flow within it. At the end of training, a policy is often worse at them than before.
HELD = [level for level in (4.8, -5.6, 5.3, -4.7, 5.8, -5.1) for _ in range(150)]
PROBE = SCENARIOS["square"]  # shown in the learning curve, without effect on the training
PROBE_SEED = 1_000_000  # used in no comparison
TRAINING_SEEDS = 1 << 32  # seeds from here on are those of the training plants alone


def train(arguments: PPOArguments) -> PolicyNetwork:
    """Train, and return the policy that did best in validation.

    Validation uses set points that occur neither in training nor in a comparison. The policy's
    provenance holds the arguments and the learning curve.
    """
    keeper = Keeper(arguments)
    for start in range(arguments.starts):
        begin(arguments, start).learn(keeper.share, callback=keeper)
    provenance = {
        "algorithm": "PPO of Stable-Baselines3",
        "arguments": asdict(arguments),
        "versions": versions(),
        "curve": keeper.curve,
    }
    return replace(exported(keeper.best, arguments), provenance=provenance)


def features(parameters: Parameters) -> NDArray[np.float64]:
    """Return the matrix that turns an observation into the inputs of the networks.

    The inputs are the error, the set point, the flow and their past changes: the flow is to be
    held when nothing changes. Factors bring each input to about 1. The matrix has the shape
    (inputs, observation_size).
    """
    size, (error, _, action) = parameters.observation_size, parameters.heads
    one = np.eye(size)
    changes = [
        factor * (one[first : last - 1] - one[first + 1 : last])  # the newer less the older
        for factor, first, last in ((0.1, 0, error), (0.5, error, action), (2.0, action, size))
    ]
    return np.vstack([one[error], 0.2 * one[0], one[action], *changes])


class FixedFeatures(BaseFeaturesExtractor):
    """Multiply observations by a matrix from `features`, the same in training and in use."""

    matrix: torch.Tensor

    def __init__(
        self, observation_space: gymnasium.spaces.Box, matrix: list[list[float]]
    ) -> None:
        super().__init__(observation_space, features_dim=len(matrix))
        self.register_buffer("matrix", torch.tensor(matrix))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Return the inputs of the networks."""
        return observations @ self.matrix.T


def begin(arguments: PPOArguments, start: int = 0) -> PPO:
    """Return an untrained model; its random numbers depend on the seed and the start."""
    torch.set_num_threads(1)  # the networks are too small for more
    plants = GymnasiumVecEnv(
        *(
            IncrementalAction(
                gymnasium.make_vec("MiddlePoint-v0", count, autoreset_mode="SameStep", **given),
                max_move=arguments.max_move,
                compensate_dead_zone=arguments.compensate_dead_zone,
            )
            for count, given in arguments.plants
        )
    )
    matrix = features(Parameters(**arguments.training))
    seeds = np.random.SeedSequence([arguments.seed, start]).generate_state(2)
    model_seed, plants_seed = (int(seed) for seed in seeds)
    model = PPO(
        "MlpPolicy",
        plants,
        # At the last update nothing remains; the lower bound lets it have an effect.
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
        seed=model_seed,
        device="cpu",
    )
    # Without biases the mean is an odd function, which suits a symmetric plant: what is learnt
    # at +5 degC also holds at -5 degC.
    for layer in (*model.policy.mlp_extractor.policy_net, model.policy.action_net):
        if isinstance(layer, nn.Linear):
            nn.init.zeros_(layer.bias)
            layer.bias.requires_grad_(False)
    plants.seed(TRAINING_SEEDS + plants_seed)
    return model


def exported(state: Mapping[str, torch.Tensor], arguments: PPOArguments) -> PolicyNetwork:
    """Return the mean of a policy as a network in NumPy, given its state in PyTorch."""
    # Stable-Baselines3 also counts the activation after each hidden layer as a layer.
    names = [f"mlp_extractor.policy_net.{2 * i}" for i in range(len(arguments.hidden))]
    (first, bias), *others = [
        (state[f"{name}.weight"].double().numpy(), state[f"{name}.bias"].double().numpy())
        for name in (*names, "action_net")
    ]
    parameters = Parameters(**arguments.training)
    return PolicyNetwork(
        [(first @ features(parameters), bias), *others],
        observation={name: getattr(parameters, name) for name in WINDOWS},
        input_scale=np.ones(parameters.observation_size),
        activation="tanh",
        increments=Increments(arguments.max_move, arguments.compensate_dead_zone),
        provenance={"arguments": asdict(arguments)},
    )


class Keeper(BaseCallback):
    """Reduce the exploration over each start, and record the progress of the training."""

    def __init__(self, arguments: PPOArguments) -> None:
        super().__init__()
        self.share = arguments.steps // arguments.starts  # samples per start
        self.curve: list[dict[str, float]] = []  # the learning curve, one row per point
        self.best: dict[str, torch.Tensor] = {}  # parameters that did best in validation
        self._arguments = arguments
        self._errors: list[float] = []
        self._before = -self.share  # samples of the earlier starts
        self._began = time.process_time()

    def _on_training_start(self) -> None:
        self._before += self.share
        self._recorded = 0  # samples of this start at the last record

    def _on_training_end(self) -> None:
        self.record()

    def _on_step(self) -> bool:
        errors = cast("GymnasiumVecEnv", self.training_env).infos["error"]
        self._errors.append(float(np.mean(np.abs(errors))))
        return True

    def _on_rollout_start(self) -> None:
        done = self.num_timesteps / self.share
        log_std = np.interp(done, (0.0, 1.0), self._arguments.log_std)
        with torch.no_grad():
            cast("torch.Tensor", self.model.policy.log_std).fill_(float(log_std))
        if self.num_timesteps - self._recorded >= VALIDATION_INTERVAL:
            self.record()

    def record(self) -> None:
        """Add a point to the learning curve, and keep the policy if it is the best so far."""
        self._recorded = self.num_timesteps
        held = {**self._arguments.observation, "setpoint": HELD}
        noisy = {**self._arguments.training, "setpoint": HELD}
        square = {**self._arguments.observation, **PROBE.arguments}
        errors = [
            self._mae(noisy, VALIDATION_RUNS, len(HELD), VALIDATION_SEED),
            self._mae(held, 1, len(HELD), 0),
            self._mae({**held, "dead_zone": VALIDATION_DEAD_ZONE}, 1, len(HELD), 0),
        ]
        point = {
            "steps": self._before + self.num_timesteps,
            "seconds": time.process_time() - self._began,  # of CPU time
            "training_mae": float(np.mean(self._errors)),
            "validation_mae": float(np.mean(errors)),
            "square_mae": self._mae(square, 1, PROBE.samples, PROBE_SEED),
        }
        self._errors.clear()
        if all(point["validation_mae"] < each["validation_mae"] for each in self.curve):
            self.best = copy.deepcopy(self.model.policy.state_dict())
        self.curve.append(point)

    def _mae(self, arguments: dict[str, Any], runs: int, samples: int, seed: int) -> float:
        plants = make_plants(runs, samples, **arguments)
        agent = exported(self.model.policy.state_dict(), self._arguments)
        return float(mean_error(rollout(plants, agent, samples, seed)).mean())
