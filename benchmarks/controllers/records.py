"""Declare what the roster holds: factories of controllers, and what commands know of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from agents.controller import PAPER_WINDOWS
from benchmarks.loop.rollout import Agent, Trajectory, make_plants, rollout
from benchmarks.train.ppo import PolicyRequest
from mptc_gym import Parameters

LEARNING = 1200  # samples of the square wave with which a network is commissioned
COMMISSIONING_SEED = 3_000_000  # of plants and noise then


@dataclass(frozen=True)
class Cost:
    """What a controller costs before it runs."""

    prior_knowledge: str = ""
    """What it is told about the plant."""
    parameters: str = ""
    """How many numbers shape it: gains, and weights if it has any."""
    samples: str = ""
    """Samples of the plant, or of a simulated one, that went into tuning and training."""


@dataclass(frozen=True)
class Factory:
    """Makes controllers and runs them, with all that a command has to know of them."""

    make: Callable[..., Agent]
    """Called with the plant that the controllers are made for (`Parameters`), how many runs
    there are, and a seed: run i is to use `seed + i`. Searched gains are given by name."""
    cost: Cost = Cost()
    observation: Mapping[str, int] = field(default_factory=lambda: PAPER_WINDOWS)
    """The windows of the environment that the controllers want."""
    learns: bool = False
    """Whether they go on learning from run to run."""
    code: str = ""
    """The module whose code shapes them, if it is not that of `make`."""
    provenance: Mapping[str, Any] = field(default_factory=dict)
    """Where a trained policy comes from, in a form for JSON; empty if nothing was trained."""
    curve: Sequence[Mapping[str, float]] = ()
    """Its learning curve, a row an evaluation."""

    @property
    def module(self) -> str:
        """The module whose code shapes the controllers."""
        make = self.make.func if isinstance(self.make, partial) else self.make
        return self.code or make.__module__

    def arguments(self, plant: Mapping[str, Any]) -> dict[str, Any]:
        """Return a plant's arguments of the environment, with the windows that are wanted."""
        return {**plant, **self.observation}

    def __call__(self, plant: Mapping[str, Any], runs: int, seed: int) -> Agent:
        """Return a controller of `runs` plants, made for a plant given by its arguments."""
        return self.make(Parameters(**self.arguments(plant)), runs, seed)

    def run(
        self,
        plant: Mapping[str, Any],
        samples: int,
        runs: int,
        seed: int,
        controller: Agent | None = None,
    ) -> Trajectory:
        """Run a controller, one made for this plant or another that is given; see `rollout`."""
        plants = make_plants(runs, samples, **self.arguments(plant))
        trajectory = rollout(plants, controller or self(plant, runs, seed), samples, seed)
        plants.close()
        return trajectory

    def in_service(self, plant: Mapping[str, Any], runs: int, seed: int) -> Agent:
        """Return a controller as it comes to plants that it was not made for.

        One that learns has learnt before, on the plant that it is made for.
        """
        controller = self(plant, runs, seed)
        if self.learns:
            square = {**plant, "setpoint": "square"}
            self.run(square, LEARNING, runs, COMMISSIONING_SEED, controller)
        return controller


# Returns the factories of a controller's members, given which trained policies are wanted.
Members = Callable[[PolicyRequest], Sequence[Factory]]


@dataclass(frozen=True)
class Tuning:
    """How the gains of a controller are searched."""

    space: Mapping[str, tuple[float, float]]
    """Name of a gain: lowest and highest value. Gains are searched on a logarithmic scale."""
    trials: int = 800
    startup: int = 200
    """How many of the trials are at random, before the sampler learns."""
    finalists: int = 10
    """How many of the best are judged again."""
    penalty: float = 5.0
    """For failing to settle at a constant set point, degC: what doing nothing about 5 degC
    costs."""
    members: tuple[int, int] = (1, 1)
    """How many controllers are made of the same gains, in the search and at last. Their
    objectives are averaged."""
    train: Callable[..., Factory] | None = None
    """Called with the gains, `final` (whether they are judged for the last time) and `member`
    (the number of the controller); returns a factory. None: the controller's own factory makes
    it with these gains."""


@dataclass(frozen=True)
class RosterEntry:
    """A controller, and how commands treat it."""

    name: str
    """In options and files."""
    label: str
    """In tables and plots."""
    made_by: Factory | Members
    """Makes it; or a function that returns several, for policies that were trained apart."""
    trained: bool = False
    """Whether `made_by` may have to train."""
    tuning: Tuning | None = None
    """How its gains are searched, if they are."""
    compared: bool = True
    swept: bool = True
    """Whether `compare` and `sweep` run it unless told otherwise."""
    drawn: bool = False
    """Whether its responses are drawn in a comparison."""

    def members(self, request: PolicyRequest | None = None) -> list[Factory]:
        """Return the factories of its members: one, or several that were trained apart."""
        if isinstance(self.made_by, Factory):
            return [self.made_by]
        return list(self.made_by(request or PolicyRequest()))

    def first(self) -> Factory:
        """Return the factory of the first member; no other is trained for it."""
        return self.members(PolicyRequest(policies=1))[0]


def provenances(members: Mapping[str, Sequence[Factory]]) -> dict[str, list[dict[str, Any]]]:
    """Return the provenance of every trained policy, by the name of its controller."""
    return {
        name: [dict(each.provenance) for each in factories]
        for name, factories in members.items()
        if factories[0].provenance
    }
