"""Define the record of a controller, and what a controller knows of a plant."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from agents.controller import PAPER_WINDOWS
from benchmarks.controllers import plant_scale
from benchmarks.lib.seeds import SEEDS
from benchmarks.loop.linear import LinearLoop, nominal, step_test, time_constant_for
from benchmarks.loop.rollout import Agent, Trajectory, make_plants, rollout
from mptc_gym import Parameters
from mptc_gym.signals import Levels

LEARNING = 1200  # samples of the square wave in which a controller learns before its service
COMMISSIONING_SEED = SEEDS["preparation"].first  # of the plants and noise of these samples
ROBUSTNESS = 1.6  # Ms of the loop to which rules are tuned; the rule SIMC itself leads to 1.56

# What a controller may know of the plant, as names of `knowledge`.
LIMITS = "u_min", "u_max"
DIRECTION = *LIMITS, "direction", "num_envs", "seed"
STEP_TEST = *LIMITS, "gain", "time_constant", "delay", "sampling_interval"
DATA_SHEET = *STEP_TEST, "dead_zone"
SETPOINT = "setpoint_holds", "setpoint_amplitude"
BANK = *STEP_TEST, "widest_dead_zone", "delay_range", *SETPOINT
EVERYTHING = "parameters", "num_envs", "seed"


def knowledge(names: Sequence[str], plant: Parameters, runs: int, seed: int) -> dict[str, Any]:
    """Return what a controller of a batch of runs knows of a plant, by name.

    Parameters
    ----------
    names
        Names of quantities: `parameters`, `num_envs`, `seed`, `u_min`, `u_max` and `dead_zone`
        (t/h), `widest_dead_zone` (t/h), `delay_range` (s), `direction` (1 or -1), and those of
        a step test.
    plant
        The plant. If quantities have ranges, a controller knows the widest limits, the middle
        of the dead zone, and the step test of the plant in the middle of the ranges.
    runs
        Number of runs in the batch.
    seed
        Seed of the first run; run i uses the seed `seed + i`.
    """
    values: dict[str, Any] = {"parameters": plant, "num_envs": runs, "seed": seed}
    values["u_min"] = plant.range_of("u_min")[0]
    values["u_max"] = plant.range_of("u_max")[1]
    values["dead_zone"] = sum(plant.range_of("dead_zone")) / 2
    values["widest_dead_zone"] = plant.range_of("dead_zone")[1]
    values["delay_range"] = delay_range(plant)
    values["setpoint_holds"] = setpoint_holds(plant)
    values["setpoint_amplitude"] = plant.setpoint_amplitude
    if "direction" in names:
        values["direction"] = plant_scale.direction(plant)
    if "gain" in names:
        values |= step_test(plant)
    return {name: values[name] for name in names}


def delay_range(plant: Parameters) -> tuple[float, float] | None:
    """Return the shortest and the longest delay of a plant, s; None if the delay is fixed.

    They include the one sample that every input takes to show.
    """
    if not isinstance(plant.delay, Sequence):
        return None
    shortest, longest = plant.delay
    interval = plant.sampling_interval
    return (shortest + 1) * interval, (longest + 1) * interval


def setpoint_holds(plant: Parameters) -> tuple[float, float] | None:
    """Return for how long a random set point is held, s; None if it is not random."""
    levels = Levels(plant)
    if not levels.random:
        return None
    return levels.shortest * plant.sampling_interval, levels.longest * plant.sampling_interval


@dataclass(frozen=True, kw_only=True)
class ControllerSpec:
    """The record of a controller: all that the commands need to know of it.

    Attributes
    ----------
    name : str
        Its name in options and files.
    label : str
        Its name in tables and pictures.
    look : tuple of str
        Its colour and its marker in pictures. Related controllers have similar ones.
    build : callable
        Returns the controller. Its arguments are the prior knowledge and the gains by name, and
        a `network` if the record has `networks`.
    prior_knowledge : sequence of str
        What the controller knows of the plant: names in `knowledge`.
    knows : str
        The prior knowledge in words, for tables.
    searched : str
        What was searched or trained beforehand, and in how many trials and samples, in words.
    tuned_by : str
        The argument of `build`, a time constant in s, that is chosen such that the loop with
        the nominal plant has an Ms of `sensitivity`; "" if no argument is.
    sensitivity : float
        Ms, the largest magnitude of the loop's sensitivity function.
    linear : bool
        Whether the controller is linear away from the dead zone and the limits. Then it has a
        method `transfer`.
    assumes : sequence of str
        What the controller takes for granted about the plant: its "direction", its "scale".
    made_for : mapping
        The plant that it was made for, by the environment's arguments.
    observation : mapping
        The windows of its observation, by the environment's arguments.
    networks : callable, optional
        Returns the networks that were trained for the controller, by file. There is a member of
        the controller for each of them.
    networks_are_alike : bool
        Whether the networks hardly differ, so that most comparisons run the first one alone.
    random : bool
        Whether the controller draws random numbers, such as its initial weights.
    learns : bool
        Whether the controller learns from run to run.
    spans : callable, optional
        Returns the interval in which a search looks for each gain, for a plant. An interval has
        the value of the smallest and that of the largest magnitude, of the same sign.
    compared : bool
        Whether `compare` runs the controller by default.
    swept : bool
        Whether `sweep` runs the controller by default.
    pictured : bool
        Whether a comparison draws its responses.
    provenance : mapping
        Origin of the network of a member, JSON-serialisable; empty if nothing was trained.
    """

    name: str
    label: str
    look: tuple[str, str]
    build: Callable[..., Agent]
    prior_knowledge: Sequence[str] = LIMITS
    knows: str = ""
    searched: str = ""
    tuned_by: str = ""
    sensitivity: float = ROBUSTNESS
    linear: bool = False
    assumes: Sequence[str] = ()
    made_for: Mapping[str, Any] = field(default_factory=dict)
    observation: Mapping[str, int] = field(default_factory=lambda: PAPER_WINDOWS)
    networks: Callable[[], Mapping[str, Any]] | None = None
    networks_are_alike: bool = False
    random: bool = False
    learns: bool = False
    spans: Callable[[Parameters], plant_scale.Spans] | None = None
    compared: bool = True
    swept: bool = True
    pictured: bool = False
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def members(self) -> "list[ControllerSpec]":
        """Return the record of a controller with each of the networks, in the order of files.

        Without networks, the list holds this record alone.
        """
        if self.networks is None:
            return [self]
        members = []
        for file, network in sorted(self.networks().items()):
            member = replace(
                self,
                build=partial(self.build, network=network),
                observation=getattr(network, "observation", self.observation),
                provenance={"file": file, **network.provenance},
                networks=None,
            )
            members.append(member)
        return members

    def with_few_networks(self) -> "ControllerSpec":
        """Return the record with the first network alone, if the networks are alike."""
        networks = self.networks
        if networks is None or not self.networks_are_alike:
            return self
        return replace(self, networks=lambda: dict(sorted(networks().items())[:1]))

    def with_gains(self, gains: Mapping[str, Any]) -> "ControllerSpec":
        """Return the record of the controller with these arguments of `build`."""
        tuned_by = "" if self.tuned_by in gains else self.tuned_by
        return replace(self, build=partial(self.build, **gains), tuned_by=tuned_by)

    def make(self, plant: Mapping[str, Any], runs: int, seed: int) -> Agent:
        """Return a controller of a batch of runs; run i uses the seed `seed + i`.

        `plant` has the environment's arguments from which the prior knowledge follows.
        """
        parameters = Parameters(**{**plant, **self.observation})
        arguments = knowledge(self.prior_knowledge, parameters, runs, seed)
        if self.tuned_by:
            arguments[self.tuned_by] = self.robust_time_constant(plant)
        return self.build(**arguments)

    def robust_time_constant(self, plant: Mapping[str, Any]) -> float:
        """Return the value of the argument `tuned_by` with which Ms is `sensitivity`, s.

        `plant` has the environment's arguments. The time constant is rounded to four digits, so
        that it is the same on all machines.
        """
        parameters = Parameters(**plant)
        arguments = knowledge(self.prior_knowledge, parameters, 1, 0)

        def build(time_constant: float) -> Any:
            return self.build(**arguments, **{self.tuned_by: time_constant})

        slowest = 30.0 * (arguments["time_constant"] + arguments["delay"])
        fastest = 0.1 * arguments["sampling_interval"]
        model = nominal(parameters)
        exact = time_constant_for(self.sensitivity, build, model, slowest, fastest)
        return float(f"{exact:.4g}")

    def loop(self, plant: Mapping[str, Any]) -> LinearLoop:
        """Return the loop of a linear controller with the nominal plant.

        `plant` has the environment's arguments.
        """
        controller: Any = self.make(plant, 1, 0)
        return LinearLoop.of(controller, nominal(Parameters(**plant)))

    def misfit(self, plant: Parameters) -> str:
        """Return a sentence that says why the controller does not fit a plant; "" if it fits.

        A controller fits if the plant is like the one that the controller was made for, in what
        the controller assumes. The errors of one that does not fit say nothing about it.
        """
        made_for = Parameters(**self.made_for)
        direction = plant_scale.direction(plant)
        expected_direction = plant_scale.direction(made_for)
        if "direction" in self.assumes and direction != expected_direction:
            sign = {1: "positive", -1: "negative"}
            return (
                f"{self.label} was made for a plant of {sign[expected_direction]} gain. This "
                f"plant has a {sign[direction]} gain, so the loop runs in positive feedback."
            )
        if "scale" in self.assumes:
            difference = plant_scale.difference(plant, made_for)
            if difference:
                return f"{self.label} was made for another plant: {difference}."
        return ""

    def run(
        self,
        plant: Mapping[str, Any],
        samples: int,
        runs: int,
        seed: int,
        controller: Agent | None = None,
    ) -> Trajectory:
        """Run a controller on a batch of plants.

        Parameters
        ----------
        plant
            The environment's arguments.
        samples
            Length of the runs.
        runs
            Number of runs.
        seed
            Run i has the noise and the set point of the seed `seed + i`.
        controller
            The controller of a batch of `runs`; by default, it is made for this plant.
        """
        agent = controller or self.make(plant, runs, seed)
        arguments = {**plant, **self.observation}
        if hasattr(agent, "opened"):  # A user's policy acts in an environment of its own.
            with agent.opened(samples, **arguments) as plants:
                return rollout(plants, agent, samples, seed)
        return rollout(make_plants(runs, samples, **arguments), agent, samples, seed)

    def in_service(self, plant: Mapping[str, Any], runs: int, seed: int) -> Agent:
        """Return a controller that is made for a plant, and has learnt on it if it learns.

        `plant` has the environment's arguments. The controller is one of a batch of `runs`.
        """
        controller = self.make(plant, runs, seed)
        if self.learns:
            square = {**plant, "setpoint": "square"}
            self.run(square, LEARNING, runs, COMMISSIONING_SEED, controller)
        return controller
