"""Make controllers for a plant: as an engineer sets them up, or from trained networks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from typing import Any, TypeVar

from agents import (
    DirectNNController,
    LawNetwork,
    NeuralSelfTuningController,
    NeuralSmithPredictor,
    PIController,
    PolicyNetwork,
    SelfTuningController,
    SmithPredictor,
)
from agents.networks import PRETRAINED
from agents.pi import SEARCHED_GAINS
from benchmarks.controllers.mpc import PredictiveController
from benchmarks.controllers.records import Cost, Factory, Members
from benchmarks.loop.linear import nominal, step_test
from benchmarks.loop.rollout import Agent, IdleValve
from mptc_gym import Parameters

Made = TypeVar("Made")


def limits(plant: Parameters) -> dict[str, Any]:
    """Return the limits of the flow, the widest possible if they are drawn."""
    return {"u_min": plant.range_of("u_min")[0], "u_max": plant.range_of("u_max")[1]}


def step_test_and_data_sheet(plant: Parameters) -> dict[str, Any]:
    """Return the results of a step test and the actuator's data sheet.

    If the dead zone is drawn, the middle of its range is returned.
    """
    dead_zone = sum(plant.range_of("dead_zone")) / 2
    return {**asdict(step_test(plant)), **limits(plant), "dead_zone": dead_zone}


def with_limits(
    make: Callable[..., Made], plant: Parameters, runs: int, seed: int, **gains: Any
) -> Made:
    """Return a controller that knows its gains and the limits of the flow, nothing else."""
    return make(**gains, **limits(plant))


def with_step_test(
    make: Callable[..., Made], plant: Parameters, runs: int = 1, seed: int = 0
) -> Made:
    """Return a controller that knows a step test and the actuator's data sheet."""
    return make(**step_test_and_data_sheet(plant))


nothing = partial(with_limits, IdleValve)
paper_pi = partial(with_limits, PIController)
searched_pi = partial(paper_pi, **SEARCHED_GAINS)
self_tuning = partial(with_step_test, SelfTuningController)
nn_smith = partial(with_step_test, NeuralSmithPredictor)
nn_self_tuning = partial(with_step_test, NeuralSelfTuningController)
mpc = PredictiveController  # knows the whole plant


def simc_pi(plant: Parameters, runs: int = 1, seed: int = 0) -> PIController:
    """Return a PI controller tuned by the SIMC rule from a step test alone."""
    return PIController.simc(**asdict(step_test(plant)), **limits(plant))


def smith(plant: Parameters, runs: int = 1, seed: int = 0) -> SmithPredictor:
    """Return a Smith predictor whose closed loop has half the plant's time constant."""
    known = step_test_and_data_sheet(plant)
    half = float(f"{known['time_constant'] / 2:.2g}")
    return SmithPredictor(**known, closed_loop_time_constant=half)


def direct_nn(plant: Parameters, runs: int, seed: int, **gains: Any) -> DirectNNController:
    """Return the paper's network, which knows the direction of the plant's response."""
    direction = 1 if nominal(plant).gain > 0.0 else -1
    return DirectNNController(
        num_envs=runs, seed=seed, direction=direction, **limits(plant), **gains
    )


def frozen_nn(plant: Parameters, runs: int, seed: int) -> DirectNNController:
    """Return the paper's network after it has learnt on the plant that it is made for."""
    controller = Factory(direct_nn, learns=True).in_service(asdict(plant), runs, seed)
    assert isinstance(controller, DirectNNController)
    controller.learning = False
    return controller


def trained(network: PolicyNetwork, plant: Parameters, runs: int, seed: int) -> PolicyNetwork:
    """Return a controller with the network for the actuator's limits.

    If it compensates a dead zone, that is the plant's, where it is a number.
    """
    increments = network.increments
    if increments and increments.dead_zone and not isinstance(plant.dead_zone, Sequence):
        increments = replace(increments, dead_zone=plant.dead_zone)
    return replace(network, increments=increments, **limits(plant))


def law_network(make: Callable[..., Agent], cost: Cost) -> Members:
    """Return the only member of a controller with the network of the law."""

    def members() -> list[Factory]:
        about = {"file": "nn-smith.npz", **LawNetwork.load().provenance}
        return [Factory(make, cost, provenance=about)]

    return members


def policies(files: str, cost: Cost) -> Members:
    """Return one member for each file in `agents/pretrained` that matches a pattern.

    The files are those of `PolicyNetwork.save`, from any learner.
    """

    def members() -> list[Factory]:
        networks = {file.name: PolicyNetwork.load(file) for file in PRETRAINED.glob(files)}
        if not networks:
            raise FileNotFoundError(f"there is no file {PRETRAINED / files}")
        return [
            # The network itself is sent along to machines that lack its file.
            Factory(
                partial(trained, network),
                cost,
                network.observation,
                provenance={"file": name, **network.provenance},
            )
            for name, network in sorted(networks.items())
        ]

    return members
