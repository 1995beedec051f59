"""Make controllers from trained networks and PPO policies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from agents import LawNetwork, PolicyNetwork
from benchmarks.controllers.engineered import limits
from benchmarks.controllers.records import Cost, Factory, Members
from benchmarks.loop.rollout import Agent
from benchmarks.train import ppo
from benchmarks.train.ppo_arguments import PPOArguments
from mptc_gym import Parameters


def trained(network: PolicyNetwork, plant: Parameters, runs: int, seed: int) -> PolicyNetwork:
    """Return a controller with the network, told the actuator's limits.

    In velocity form it is also told the dead zone, if that is a number.
    """
    increments = network.increments
    if increments and not isinstance(plant.dead_zone, Sequence):
        increments = replace(increments, dead_zone=plant.dead_zone)
    return replace(network, increments=increments, **limits(plant))


def told_network(make: Callable[..., Agent], cost: Cost) -> Members:
    """Return the only member of a controller with the told network, read when it is used."""

    def members(_: ppo.PolicyRequest) -> list[Factory]:
        about = {"file": "nn-smith.npz", **LawNetwork.load().provenance}
        return [Factory(make, cost, provenance=about)]

    return members


def ppo_policies(request: ppo.PolicyRequest) -> list[Factory]:
    """Return PPO policies for the paper's plant."""
    return [_factory(network, file.name) for file, network in ppo.members(request).items()]


def tuned_policy(*, final: bool, member: int, **gains: Any) -> Factory:
    """Train a policy with other settings for a search, from a seed that no comparison uses."""
    first = ppo.FINAL_SEED if final else ppo.TUNING_SEED
    arguments = PPOArguments(seed=first + member, **gains)
    return _factory(ppo.train(arguments))


def _factory(network: PolicyNetwork, file: str = "") -> Factory:
    about = {name: value for name, value in network.provenance.items() if name != "curve"}
    weights = sum(W.size + b.size for W, b in network.layers)
    return Factory(
        partial(trained, network),  # sent along to machines that lack its file
        Cost(
            "dead zone; delay, by the past actions it sees",
            f"{weights:,} weights a policy",
            f"{about['arguments']['steps'] / 1e6:g} M a policy",
        ),
        network.observation,
        provenance={"file": file, **about},
        curve=network.provenance.get("curve", []),
    )
