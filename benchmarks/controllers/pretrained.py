"""Make controllers from the trained networks in `agents/pretrained`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from agents import LawNetwork, PolicyNetwork
from agents.networks import PRETRAINED
from benchmarks.controllers.engineered import limits
from benchmarks.controllers.records import Cost, Factory, Members
from benchmarks.loop.rollout import Agent
from mptc_gym import Parameters


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
