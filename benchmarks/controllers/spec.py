"""Define the record of a controller: all that the commands need to know of it."""

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

LEARNING = 1200  # samples of the square wave on which a network is commissioned
COMMISSIONING_SEED = SEEDS["preparation"].first  # of plants and noise during commissioning
ROBUSTNESS = 1.6  # Ms of the loop to which rules are tuned; SIMC's own default has 1.56

# What a controller may know of the plant, by the arguments of its `build`.
LIMITS = "u_min", "u_max"
DIRECTION = *LIMITS, "direction", "num_envs", "seed"
STEP_TEST = *LIMITS, "gain", "time_constant", "delay", "sampling_interval"
DATA_SHEET = *STEP_TEST, "dead_zone"
SETPOINT = "setpoint_holds", "setpoint_amplitude"
BANK = *STEP_TEST, "widest_dead_zone", "delay_range", *SETPOINT
EVERYTHING = "parameters", "num_envs", "seed"


def knowledge(names: Sequence[str], plant: Parameters, runs: int, seed: int) -> dict[str, Any]:
    """Return what a controller knows of a plant, by name, for a number of runs and a seed.

    Run i uses `seed + i`. Of what is sampled from ranges, these are the widest limits, the
    middle of the dead zone and the step test of the plant in the middle.
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
    """Return the shortest and the longest delay that a plant may have, s; None if it is fixed.

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
    """A controller, or one that was trained, as all commands know it."""

    name: str
    """Its name in options and files."""
    label: str
    """Its name in tables and pictures."""
    look: tuple[str, str]
    """Its colour and its marker in pictures: those of relatives are alike."""
    build: Callable[..., Agent]
    """Returns the controller, from its prior knowledge by name, its gains by name, and a
    `network` if it has `networks`."""
    prior_knowledge: Sequence[str] = LIMITS
    """What it knows about the plant: names of arguments of `build`, as in `knowledge`."""
    knows: str = ""
    """The same in words, for tables."""
    searched: str = ""
    """What was searched or trained beforehand, and in how many trials and samples, in words."""
    tuned_by: str = ""
    """The argument of `build`, a time constant in s, that is chosen such that the loop with the
    nominal plant has an Ms of `sensitivity`; empty if there is none."""
    sensitivity: float = ROBUSTNESS
    """Ms, the largest magnitude of the loop's sensitivity function; for `tuned_by`."""
    linear: bool = False
    """Whether it is linear away from the dead zone and the limits; then it has `transfer`."""
    assumes: Sequence[str] = ()
    """What it takes for granted about the plant: its "direction", or its "scale"."""
    made_for: Mapping[str, Any] = field(default_factory=dict)
    """The plant of which it assumes this, by the environment's arguments."""
    observation: Mapping[str, int] = field(default_factory=lambda: PAPER_WINDOWS)
    """The windows that it expects, by the environment's arguments."""
    networks: Callable[[], Mapping[str, Any]] | None = None
    """Returns the networks that were trained separately, by file: each makes a member."""
    random: bool = False
    """Whether it draws random numbers itself, such as its first weights."""
    learns: bool = False
    """Whether it learns from run to run."""
    spans: Callable[[Parameters], Mapping[str, tuple[float, float]]] | None = None
    """Returns the values of its gains between which a search on a plant looks, by name: of the
    smallest and of the largest magnitude, of the same sign."""
    compared: bool = True
    """Whether `compare` runs it by default."""
    swept: bool = True
    """Whether `sweep` runs it by default."""
    pictured: bool = False
    """Whether a comparison draws its responses."""
    provenance: Mapping[str, Any] = field(default_factory=dict)
    """Origin of a trained network, JSON-serialisable; empty if nothing was trained."""

    def members(self) -> "list[ControllerSpec]":
        """Return the controller, or one for each of the networks that it was trained to."""
        if self.networks is None:
            return [self]
        return [
            replace(
                self,
                build=partial(self.build, network=network),
                observation=getattr(network, "observation", self.observation),
                provenance={"file": file, **network.provenance},
                networks=None,
            )
            for file, network in sorted(self.networks().items())
        ]

    def with_gains(self, gains: Mapping[str, Any]) -> "ControllerSpec":
        """Return the controller with these arguments of `build` in place of its rule's."""
        build = partial(self.build, **gains)
        tuned_by = "" if self.tuned_by in gains else self.tuned_by
        return replace(self, build=build, tuned_by=tuned_by)

    def make(self, plant: Mapping[str, Any], runs: int, seed: int) -> Agent:
        """Return a controller of `runs` plants with these arguments of the environment."""
        parameters = Parameters(**{**plant, **self.observation})
        known = knowledge(self.prior_knowledge, parameters, runs, seed)
        if self.tuned_by:
            known[self.tuned_by] = self.robust_time_constant(plant)
        return self.build(**known)

    def robust_time_constant(self, plant: Mapping[str, Any]) -> float:
        """Return the value of the argument `tuned_by` with which Ms is `sensitivity`, s."""
        parameters = Parameters(**plant)
        known = knowledge(self.prior_knowledge, parameters, 1, 0)

        def build(time_constant: float) -> Any:
            return self.build(**known, **{self.tuned_by: time_constant})

        slowest = 30.0 * (known["time_constant"] + known["delay"])
        fastest = 0.1 * known["sampling_interval"]
        model = nominal(parameters)
        exact = time_constant_for(self.sensitivity, build, model, slowest, fastest)
        return float(f"{exact:.4g}")  # the same on all machines

    def loop(self, plant: Mapping[str, Any]) -> LinearLoop:
        """Return the loop of the controller, if it is linear, with the nominal plant."""
        controller: Any = self.make(plant, 1, 0)
        return LinearLoop.of(controller, nominal(Parameters(**plant)))

    def misfit(self, plant: Parameters) -> str:
        """Return in a sentence why its errors on a plant say nothing of it; "" if they do."""
        other = Parameters(**self.made_for)
        here, there = plant_scale.direction(plant), plant_scale.direction(other)
        if "direction" in self.assumes and here != there:
            sign = {1: "positive", -1: "negative"}
            return (
                f"{self.label} was made for a plant of {sign[there]} gain. This plant has a "
                f"{sign[here]} gain, so the loop runs in positive feedback."
            )
        if "scale" in self.assumes and (difference := plant_scale.difference(plant, other)):
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
        """Run a controller, by default a new one for this plant; see `rollout`."""
        agent = controller or self.make(plant, runs, seed)
        arguments = {**plant, **self.observation}
        if hasattr(agent, "opened"):  # a user's, that acts in its own
            with agent.opened(samples, **arguments) as plants:
                return rollout(plants, agent, samples, seed)
        return rollout(make_plants(runs, samples, **arguments), agent, samples, seed)

    def in_service(self, plant: Mapping[str, Any], runs: int, seed: int) -> Agent:
        """Return a controller that is ready for plants it was not made for.

        A controller that learns has already learnt on the plant it is made for.
        """
        controller = self.make(plant, runs, seed)
        if self.learns:
            square = {**plant, "setpoint": "square"}
            self.run(square, LEARNING, runs, COMMISSIONING_SEED, controller)
        return controller
