"""Declare the records in the roster: factories of controllers, and facts about them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any

from agents.controller import PAPER_WINDOWS
from benchmarks.loop.rollout import Agent, Trajectory, make_plants, rollout
from mptc_gym import Parameters
from mptc_gym.environments import opened
from mptc_gym.evaluation import case_of

LEARNING = 1200  # samples of the square wave on which a network is commissioned
COMMISSIONING_SEED = 3_000_000  # of plants and noise during commissioning


@dataclass(frozen=True)
class Cost:
    """The cost of a controller before it runs."""

    prior_knowledge: str = ""
    """What the controller knows about the plant."""
    parameters: str = ""
    """Number of its gains, and of its weights if it has any."""
    samples: str = ""
    """Samples of the plant, real or simulated, that one tuning or training takes."""
    search: str = ""
    """Trials by which its settings were found, all their samples, and minutes of one core."""


@dataclass(frozen=True)
class Factory:
    """Make and run controllers, and hold all that commands need to know of them."""

    make: Callable[..., Agent]
    """Function of the plant that the controllers are made for (`Parameters`), the number of
    runs, and a seed; run i should use `seed + i`. Searched gains are passed by name."""
    cost: Cost = Cost()
    observation: Mapping[str, int] = field(default_factory=lambda: PAPER_WINDOWS)
    """The observation windows that the controllers expect, by the environment's arguments."""
    learns: bool = False
    """Whether the controllers keep learning from run to run."""
    code: str = ""
    """Hash of the code of a user's own controller, which is not part of the checkout's."""
    provenance: Mapping[str, Any] = field(default_factory=dict)
    """Origin of a trained policy, JSON-serialisable; empty if nothing was trained."""

    def arguments(self, plant: Mapping[str, Any]) -> dict[str, Any]:
        """Return a plant's arguments of the environment, with the observation windows."""
        return {**plant, **self.observation}

    def __call__(self, plant: Mapping[str, Any], runs: int, seed: int) -> Agent:
        """Return a controller for `runs` plants, made for the plant with these arguments."""
        return self.make(Parameters(**self.arguments(plant)), runs, seed)

    def run(
        self,
        plant: Mapping[str, Any],
        samples: int,
        runs: int,
        seed: int,
        controller: Agent | None = None,
    ) -> Trajectory:
        """Run the given controller, by default a new one for this plant; see `rollout`."""
        agent = controller or self(plant, runs, seed)
        env = getattr(agent, "env", None)  # of a user's policy that acts in one of its own
        if env is None:
            with closing(make_plants(runs, samples, **self.arguments(plant))) as plants:
                return rollout(plants, agent, samples, seed)
        with opened(env, runs) as plants:
            there = [case_of(each.parameters) for each in plants.inner]
            if set(there) != {case_of(Parameters(**self.arguments(plant)))}:
                raise ValueError("the environment must have the parameters that it is made for")
            return rollout(plants, agent, samples, seed)

    def in_service(self, plant: Mapping[str, Any], runs: int, seed: int) -> Agent:
        """Return a controller that is ready for plants it was not made for.

        A controller that learns has already learnt on the plant it is made for.
        """
        controller = self(plant, runs, seed)
        if self.learns:
            square = {**plant, "setpoint": "square"}
            self.run(square, LEARNING, runs, COMMISSIONING_SEED, controller)
        return controller


Members = Callable[[], Sequence[Factory]]  # reads the factories of a controller's members


@dataclass(frozen=True)
class Tuning:
    """The search for the gains of a controller."""

    space: Mapping[str, tuple[float, float]]
    """Lowest and highest value of each gain, by name. The search is on a logarithmic scale."""
    trials: int = 800
    startup: int = 200
    """Number of random trials before the sampler learns."""
    finalists: int = 10
    """Number of the best trials that are evaluated again."""
    penalty: float = 5.0
    """Penalty for failing to settle at a constant set point, degC: the cost of doing nothing
    about an error of 5 degC."""


@dataclass(frozen=True)
class RosterEntry:
    """A controller, and how commands treat it."""

    name: str
    """Name in options and files."""
    label: str
    """Name in tables and plots."""
    look: tuple[str, str]
    """Colour and marker in plots; relatives have shades of one hue and the same marker."""
    made_by: Factory | Members
    """Its factory, or a function that returns several, for policies trained separately."""
    tuning: Tuning | None = None
    """The search for its gains, if there is one."""
    compared: bool = True
    swept: bool = True
    """Whether `compare` (`compared`) and `sweep` (`swept`) run it by default."""
    drawn: bool = False
    """Whether its responses are drawn in a comparison."""

    def members(self) -> list[Factory]:
        """Return the factories of its members: one, or several trained separately."""
        if isinstance(self.made_by, Factory):
            return [self.made_by]
        return list(self.made_by())


def provenances(members: Mapping[str, Sequence[Factory]]) -> dict[str, list[dict[str, Any]]]:
    """Return the provenance of every trained policy, by the name of its controller."""
    return {
        name: [dict(each.provenance) for each in factories]
        for name, factories in members.items()
        if factories[0].provenance
    }
