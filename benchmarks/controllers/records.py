"""Declare what the roster holds: factories of controllers, and what commands know of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from agents.controller import PAPER_WINDOWS
from benchmarks.loop.rollout import Agent, make_plants, rollout
from benchmarks.train.ppo import PolicyRequest
from mptc_gym import Parameters

LEARNING = 1200  # samples of the square wave with which a network is commissioned
COMMISSIONING_SEED = 3_000_000  # of plants and noise then


@dataclass(frozen=True)
class Cost:
    """What a controller costs before it runs.

    Attributes
    ----------
    prior_knowledge
        What it is told about the plant.
    parameters
        How many numbers shape it: gains, and weights if it has any.
    samples
        Samples of the plant, or of a simulated one, that went into tuning and training.
    """

    prior_knowledge: str = ""
    parameters: str = ""
    samples: str = ""


@dataclass(frozen=True)
class Factory:
    """Makes controllers: all that a command may ask of a controller before it runs.

    Attributes
    ----------
    make
        Called with the plant that the controllers are made for (`Parameters`), how many runs
        there are, and a seed: run i is to use `seed + i`. A search adds gains by name.
    observation
        The windows of the environment that the controllers want.
    learns
        Whether they go on learning from run to run.
    code
        The module whose code shapes them, if it is not that of `make`.
    provenance
        Where a trained policy comes from, in a form for JSON; empty if nothing was trained.
    curve
        Its learning curve, a row an evaluation.
    cost
        What it costs, where that is not known before the training.
    """

    make: Callable[..., Agent]
    observation: Mapping[str, int] = field(default_factory=lambda: PAPER_WINDOWS)
    learns: bool = False
    code: str = ""
    provenance: Mapping[str, Any] = field(default_factory=dict)
    curve: Sequence[Mapping[str, float]] = ()
    cost: Cost | None = None

    @property
    def module(self) -> str:
        """The module whose code shapes the controllers."""
        return self.code or self.make.__module__

    def arguments(self, plant: Mapping[str, Any]) -> dict[str, Any]:
        """Return a plant's arguments of the environment, with the windows that are wanted."""
        return {**plant, **self.observation}

    def __call__(self, plant: Mapping[str, Any], runs: int, seed: int) -> Agent:
        """Return a controller of `runs` plants, made for a plant given by its arguments."""
        return self.make(Parameters(**self.arguments(plant)), runs, seed)

    def in_service(self, plant: Mapping[str, Any], runs: int, seed: int) -> Agent:
        """Return a controller as it comes to plants that it was not made for.

        One that learns has learnt before, on the plant that it is made for.
        """
        controller = self(plant, runs, seed)
        if self.learns:
            plants = make_plants(
                runs, LEARNING, **{**self.arguments(plant), "setpoint": "square"}
            )
            rollout(plants, controller, LEARNING, COMMISSIONING_SEED)
            plants.close()
        return controller


Members = Callable[[PolicyRequest], Sequence[Factory]]


def alone(make: Callable[..., Agent], **more: Any) -> Members:
    """Return the members of a controller that is not trained: one factory, as `Factory`."""
    factory = Factory(make, **more)
    return lambda request: [factory]


@dataclass(frozen=True)
class Tuning:
    """How the gains of a controller are searched.

    Attributes
    ----------
    space
        Name of a gain: lowest and highest value. Gains are searched on a logarithmic scale.
    trials, startup
        Number of trials, and how many of them are at random before the sampler learns.
    finalists
        How many of the best are judged again.
    penalty
        For failing to settle at a constant set point, degC: what doing nothing about 5 degC
        costs.
    members
        How many controllers are made of the same gains, in the search and at last. Their
        objectives are averaged.
    train
        Called with the gains, `final` (whether they are judged for the last time) and `member`
        (the number of the controller); returns a factory. None: the controller's own factory
        makes it with these gains.
    """

    space: Mapping[str, tuple[float, float]]
    trials: int = 800
    startup: int = 200
    finalists: int = 10
    penalty: float = 5.0
    members: tuple[int, int] = (1, 1)
    train: Callable[..., Factory] | None = None


@dataclass(frozen=True)
class RosterEntry:
    """A controller and all that any command has to know of it.

    Attributes
    ----------
    name
        In options and files.
    label
        In tables and plots.
    made_by
        Returns its factories: one, or several for policies that were trained apart. Called
        with a request, which controllers that are not trained ignore.
    cost
        What it costs before it runs.
    told
        Whether it is set up for the plant that it is told. Otherwise it is made for the paper's
        plant, and is told no more than the actuator.
    trained
        Whether `made_by` may have to train.
    tuning
        How its gains are searched, if they are.
    compared, swept
        Whether `compare` and `sweep` run it unless told otherwise.
    drawn
        Whether its responses are drawn in a comparison.
    """

    name: str
    label: str
    made_by: Members
    cost: Cost = Cost()
    told: bool = True
    trained: bool = False
    tuning: Tuning | None = None
    compared: bool = True
    swept: bool = False
    drawn: bool = False

    def members(self, request: PolicyRequest | None = None) -> list[Factory]:
        """Return the factories of its members: one, or several that were trained apart."""
        return list(self.made_by(request or PolicyRequest()))

    def first(self) -> Factory:
        """Return the factory of the first member; no other is trained for it."""
        return self.members(PolicyRequest(policies=1))[0]


def provenances(members: Mapping[str, Sequence[Factory]]) -> dict[str, list[dict[str, Any]]]:
    """Return the provenance of every trained policy, by the name of its controller."""
    found = {
        name: [dict(each.provenance) for each in factories if each.provenance]
        for name, factories in members.items()
    }
    return {name: each for name, each in found.items() if each}
