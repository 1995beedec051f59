"""Make controllers of trained networks, and of PPO's policies."""

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
from benchmarks.train.ppo_arguments import RANDOMISED, PPOArguments
from mptc_gym import Parameters


def trained(network: PolicyNetwork, plant: Parameters, runs: int, seed: int) -> PolicyNetwork:
    """Return a controller that has the network, and is told the actuator's limits.

    In velocity form it is told the dead zone, too, if that is a number.

    Raises
    ------
    ValueError
        If the dead zone that it is to undo leaves no flow on one side.
    """
    increments = network.increments
    if increments and not isinstance(plant.dead_zone, Sequence):
        increments = replace(increments, dead_zone=plant.dead_zone)
    return replace(network, increments=increments, **limits(plant))


def told_network(make: Callable[..., Agent]) -> Members:
    """Return the members of a controller that has the told network."""

    def members(_: ppo.PolicyRequest) -> list[Factory]:
        about = dict(LawNetwork.load().provenance)
        return [Factory(make, provenance={"file": "nn-smith.npz", **about})]

    return members


def ppo_policies(
    request: ppo.PolicyRequest, arguments: PPOArguments | None = None
) -> list[Factory]:
    """Return PPO's policies for the paper's plant; those that are missing are trained."""
    policies = ppo.members(request, arguments)
    return [_factory(each.arguments, each.network, each.file.name) for each in policies]


def randomised_policies(request: ppo.PolicyRequest) -> list[Factory]:
    """Return PPO's policies for many plants."""
    return ppo_policies(request, PPOArguments(**RANDOMISED))


def tuned_policy(*, final: bool, member: int, **gains: Any) -> Factory:
    """Train a policy with other settings for a search, of a seed that no comparison has."""
    first = ppo.FINAL_SEED if final else ppo.TUNING_SEED
    arguments = PPOArguments(seed=first + member, **gains)
    return _factory(arguments, ppo.train(arguments))


def _factory(arguments: PPOArguments, network: PolicyNetwork, file: str = "") -> Factory:
    about = {name: value for name, value in network.provenance.items() if name != "curve"}
    weights = sum(W.size + b.size for W, b in network.layers)
    return Factory(
        partial(trained, network),  # which goes along to machines where its file is not
        network.observation,
        provenance={"file": file, **about},
        curve=network.provenance.get("curve", []),
        cost=Cost(
            "dead zone; delay, by the past actions it sees",
            f"{weights:,} weights a policy",
            f"{arguments.steps / 1e6:g} M a policy",
        ),
    )
