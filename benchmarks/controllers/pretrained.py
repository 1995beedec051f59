"""Make controllers of trained networks, and of PPO's policies."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from agents import LawNetwork, PolicyNetwork
from benchmarks.controllers.engineered import limits
from benchmarks.controllers.records import Cost, Factory, Members
from benchmarks.loop.rollout import Agent
from benchmarks.train import ppo
from benchmarks.train.ppo_arguments import RANDOMISED, PPOArguments
from mptc_gym import Parameters


@dataclass(frozen=True)
class Trained:
    """Makes controllers of a trained network, which is told the actuator's limits.

    Attributes
    ----------
    network
        It goes along to machines where its file is not.
    """

    network: PolicyNetwork

    def __call__(self, plant: Parameters, runs: int, seed: int) -> PolicyNetwork:
        """Return a controller; in velocity form it is told the dead zone, if it is a number.

        Raises
        ------
        ValueError
            If the dead zone that it is to undo leaves no flow on one side.
        """
        network = copy.deepcopy(self.network)
        known = limits(plant)
        network.u_min, network.u_max = known["u_min"], known["u_max"]
        zone = plant.dead_zone
        if network.increments and not isinstance(zone, Sequence):
            if zone >= min(-network.u_min, network.u_max):
                raise ValueError(
                    f"dead_zone must be inside u_min = {plant.u_min} and u_max = {plant.u_max} "
                    f"for a policy that undoes it, got {zone}"
                )
            network.increments = replace(network.increments, dead_zone=zone)
        return network


def told_network(make: Callable[..., Agent]) -> Members:
    """Return the members of a controller that has the told network."""

    def members(_: ppo.PolicyRequest) -> list[Factory]:
        about = dict(LawNetwork.load().provenance)
        return [Factory(make, provenance={"file": "nn-smith.npz", **about})]

    return members


def ppo_policies(request: ppo.PolicyRequest) -> list[Factory]:
    """Return PPO's policies for the paper's plant; those that are missing are trained."""
    return [_policy(each) for each in ppo.members(request)]


def randomised_policies(request: ppo.PolicyRequest) -> list[Factory]:
    """Return PPO's policies for many plants."""
    arguments = replace(PPOArguments(), **RANDOMISED)
    return [_policy(each) for each in ppo.members(request, arguments)]


def tuned_policy(*, final: bool, member: int, **gains: float) -> Factory:
    """Return a policy of PPO that was trained with other settings, for a search."""
    return _policy(ppo.tuned(final=final, member=member, **gains))


def _policy(policy: ppo.Policy) -> Factory:
    weights = sum(W.size + b.size for W, b in policy.network.layers)
    cost = Cost(
        "dead zone; delay, by the past actions it sees",
        f"{weights:,} weights a policy",
        f"{policy.arguments.steps / 1e6:g} M a policy",
    )
    made = _factory(policy.network, policy.file.name)
    return replace(made, curve=policy.curve, cost=cost)


def _factory(network: PolicyNetwork, file: str) -> Factory:
    about = {name: value for name, value in network.provenance.items() if name != "curve"}
    return Factory(Trained(network), network.observation, provenance={"file": file, **about})
