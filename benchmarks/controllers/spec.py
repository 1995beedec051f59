"""Define the record of a controller, and what a controller may know about a plant."""

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
from mptc_gym.plant.signals import SetPointLevels

LEARNING = 1200  # samples of the square wave in which a controller learns before it is measured
COMMISSIONING_SEED = SEEDS["preparation"].first  # of the plants and noise of this learning
# Ms, the maximum sensitivity of the loop, to which the time constant of a controller is chosen.
# The rule SIMC without this choice leads to an Ms of 1.56.
ROBUSTNESS = 1.6

# Names of quantities that some controllers may know about the plant; see `knowledge`.
LIMITS = "u_min", "u_max"
DIRECTION = *LIMITS, "direction", "num_envs", "seed"
STEP_TEST = *LIMITS, "gain", "time_constant", "delay", "sampling_interval"
DATA_SHEET = *STEP_TEST, "dead_zone"
SETPOINT = "setpoint_holds", "setpoint_amplitude"
BANK = *STEP_TEST, "widest_dead_zone", "delay_range", *SETPOINT
EVERYTHING = "parameters", "num_envs", "seed"


def knowledge(names: Sequence[str], plant: Parameters, runs: int, seed: int) -> dict[str, Any]:
    """Return what a controller may know about a plant, by the names of the quantities.

    The values are arguments for the constructor of a controller.

    Parameters
    ----------
    names
        Names of the quantities to return: `parameters` (all arguments of the environment),
        `num_envs` (`runs`), `seed`, `u_min`, `u_max`, `dead_zone` and `widest_dead_zone` (t/h),
        `delay_range` (s), `setpoint_holds` (s), `setpoint_amplitude` (degC), `direction` (the
        sign of the gain, 1 or -1), and the results of `step_test`: `gain` (degC per t/h),
        `time_constant`, `delay` and `sampling_interval` (s).
    plant
        The plant. Where quantities of the plant have ranges, the limits are the widest limits,
        the dead zone is the middle of its range, and the step test is that of the plant in the
        middle of all ranges.
    runs
        Number of runs in a batch.
    seed
        Seed of the controller's random numbers in the first run; run i uses `seed + i`.
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

    A delay is here the time from a flow to the first output that the flow can affect, so it is
    one sample longer than the argument `delay` of the environment. The range of `plant.delay`
    gives the two delays.
    """
    if not isinstance(plant.delay, Sequence):
        return None
    shortest, longest = plant.delay
    interval = plant.sampling_interval
    return (shortest + 1) * interval, (longest + 1) * interval


def setpoint_holds(plant: Parameters) -> tuple[float, float] | None:
    """Return the shortest and the longest time for which a random set point is constant, s.

    The result is None if the set point is not random. `plant` has the arguments of the
    environment.
    """
    levels = SetPointLevels(plant)
    if not levels.random:
        return None
    return levels.shortest * plant.sampling_interval, levels.longest * plant.sampling_interval


@dataclass(frozen=True, kw_only=True)
class ControllerSpec:
    """The record of a controller: all that the commands need to run and describe it.

    The nominal plant is the plant in the middle of the ranges of the environment's arguments.

    Attributes
    ----------
    name : str
        The name of the controller in options and files.
    label : str
        The name of the controller in tables and pictures.
    look : tuple of str
        The colour and the marker of the controller in pictures, for matplotlib.
    build : callable
        Returns the controller. The keyword arguments are the prior knowledge, gains and time
        constants by name, and also `network`, a trained network, if the record has `networks`.
    prior_knowledge : sequence of str
        What the controller knows about the plant: names of quantities that the function
        `knowledge` returns.
    knows : str
        The prior knowledge in words, for tables.
    searched : str
        What was searched or trained beforehand, and in how many trials and samples, in words.
    tuned_by : str
        The argument of `build`, a time constant in s, that is chosen such that the loop with
        the nominal plant has a maximum sensitivity of `sensitivity`. The text is "" if the
        controller has no such argument.
    sensitivity : float
        Ms, the largest magnitude of the sensitivity function of the loop.
    linear : bool
        Whether the controller is linear for commands outside the dead zone and within the
        limits. A linear controller has a method `transfer`.
    assumes : sequence of str
        What has to agree between the plant and the plant that the controller was made for: the
        "direction" (the sign of the gain) or the "scale" (the magnitudes of gain, reachable
        temperature, time constant and delay).
    made_for : mapping
        The plant that the controller was made for, by the environment's arguments; empty for
        the paper's plant.
    observation : mapping
        How many samples of each signal the controller observes, by the environment's arguments,
        such as `{"error_window": 3}`.
    networks : callable, optional
        Returns the networks that were trained for the controller, by file. The controller has
        one member for each network, and a command runs all members.
    networks_are_alike : bool
        Whether the networks hardly differ, so that most comparisons run the first network only.
    random : bool
        Whether the controller draws random numbers, such as its initial weights.
    learns : bool
        Whether the controller goes on learning from one run to the next.
    spans : callable, optional
        Takes a plant, and returns the interval in which a search looks for each gain. An
        interval begins with its end of smaller magnitude; both ends have the same sign.
    compared : bool
        Whether the command `compare` runs the controller by default.
    swept : bool
        Whether the command `sweep` runs the controller by default.
    pictured : bool
        Whether a comparison draws the temperature and the flow over time with the controller.
    provenance : mapping
        The origin of the trained network of a member, as JSON can store it; empty if nothing
        was trained.
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
        """Return a record for each trained network, in the order of the files' names.

        Each record builds the controller with one network. If the controller has no networks,
        the list consists of this record.
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
        """Return a record with the first network only, if the networks are alike.

        A controller whose networks are not alike, or that has none, keeps its record.
        """
        networks = self.networks
        if networks is None or not self.networks_are_alike:
            return self

        def first_network() -> dict[str, Any]:
            file, network = min(networks().items())
            return {file: network}

        return replace(self, networks=first_network)

    def with_gains(self, gains: Mapping[str, Any]) -> "ControllerSpec":
        """Return a record of the controller with fixed gains.

        `gains` has arguments of `build` by name. If the argument `tuned_by` is among the
        gains, `robust_time_constant` does not choose its value any more.
        """
        tuned_by = "" if self.tuned_by in gains else self.tuned_by
        return replace(self, build=partial(self.build, **gains), tuned_by=tuned_by)

    def make(self, plant: Mapping[str, Any], runs: int, seed: int) -> Agent:
        """Return a controller for a batch of `runs` runs.

        The controller's prior knowledge is that of `plant`, the environment's arguments. The
        controller draws random numbers for run i with the seed `seed + i`.
        """
        parameters = Parameters(**{**plant, **self.observation})
        arguments = knowledge(self.prior_knowledge, parameters, runs, seed)
        if self.tuned_by:
            arguments[self.tuned_by] = self.robust_time_constant(plant)
        return self.build(**arguments)

    def robust_time_constant(self, plant: Mapping[str, Any]) -> float:
        """Return the time constant for the argument `tuned_by` of `build`, s.

        The result is the smallest time constant with which Ms, the maximum sensitivity of the
        loop with the nominal plant, is at most `sensitivity`. `plant` has the environment's
        arguments. The result is rounded to four digits, so that it is equal on all machines.
        """
        parameters = Parameters(**plant)
        arguments = knowledge(self.prior_knowledge, parameters, 1, 0)

        def build(time_constant: float) -> Any:
            return self.build(**arguments, **{self.tuned_by: time_constant})

        # The search covers all useful time constants between these two.
        slowest = 30.0 * (arguments["time_constant"] + arguments["delay"])
        fastest = 0.1 * arguments["sampling_interval"]
        model = nominal(parameters)
        exact = time_constant_for(self.sensitivity, build, model, slowest, fastest)
        return float(f"{exact:.4g}")

    def loop(self, plant: Mapping[str, Any]) -> LinearLoop:
        """Return the loop of this controller, which must be linear, with the nominal plant.

        `plant` has the environment's arguments.
        """
        controller: Any = self.make(plant, 1, 0)
        return LinearLoop.of(controller, nominal(Parameters(**plant)))

    def misfit(self, plant: Parameters) -> str:
        """Return a sentence that says why the controller does not fit a plant; "" if it fits.

        A controller fits a plant that agrees with the plant `made_for` in all that the
        controller `assumes`.
        """
        made_for = Parameters(**self.made_for)
        signs = {1: "positive", -1: "negative"}
        sign = signs[plant_scale.direction(plant)]
        expected_sign = signs[plant_scale.direction(made_for)]
        if "direction" in self.assumes and sign != expected_sign:
            return (
                f"{self.label} was made for a plant of {expected_sign} gain. This plant has a "
                f"{sign} gain, so the loop runs in positive feedback."
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
        """Run the controller on a batch of plants, and return the signals of the runs.

        Parameters
        ----------
        plant
            The environment's arguments.
        samples
            Length of a run, in samples.
        runs
            Number of runs in the batch.
        seed
            Seed of the first run: the environment draws the random numbers of run i, such as
            its noise, with the seed `seed + i`.
        controller
            A controller that `make` or `in_service` has returned for a batch of `runs` runs; by
            default, a new one is made for `plant`.
        """
        agent = controller or self.make(plant, runs, seed)
        plants = make_plants(runs, samples, **{**plant, **self.observation})
        return rollout(plants, agent, samples, seed)

    def in_service(self, plant: Mapping[str, Any], runs: int, seed: int) -> Agent:
        """Make a controller for a batch of `runs` runs, let it learn if it can, and return it.

        Learning takes `LEARNING` samples of the square wave on the plant with the environment's
        arguments `plant`. The controller draws random numbers for run i with the seed
        `seed + i`.
        """
        controller = self.make(plant, runs, seed)
        if self.learns:
            square = {**plant, "setpoint": "square"}
            self.run(square, LEARNING, runs, COMMISSIONING_SEED, controller)
        return controller
