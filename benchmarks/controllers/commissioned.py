"""The paper's network as it comes to other plants: after it has learnt on the nominal one."""

from __future__ import annotations

from agents import DirectNNController
from benchmarks.rollout import make_plants, rollout

LEARNING = 1200  # samples of the square wave with which a network is commissioned
COMMISSIONING_SEED = 3_000_000  # of the noise then, if there were any


def learning_network(num_envs: int, seed: int) -> DirectNNController:
    """Return networks that have learnt on the nominal plant and go on learning."""
    controller = DirectNNController(num_envs=num_envs, seed=seed)
    rollout(make_plants(num_envs, LEARNING), controller, LEARNING, COMMISSIONING_SEED)
    return controller


def frozen_network(num_envs: int, seed: int) -> DirectNNController:
    """Return networks that have learnt on the nominal plant and do not learn any more."""
    controller = learning_network(num_envs, seed)
    controller.learning = False
    return controller
