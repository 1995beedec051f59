"""Define `ControllerSpec`, and compute what a controller may know about a plant."""

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
COMMISSIONING_SEED = SEEDS["preparation"].first  # of the episodes in which a controller learns
# Maximum sensitivity Ms of the control loop, from which a controller's time constant is chosen:
# the largest magnitude of the loop's sensitivity function, which is low for a robust loop.
# The time constant of the tuning rule SIMC leads to an Ms of 1.56.
ROBUSTNESS = 1.6

# Names of quantities of a plant that some controllers know: arguments of `knowledge`.
LIMITS = "u_min", "u_max"
DIRECTION = *LIMITS, "direction", "num_envs", "seed"
STEP_TEST = *LIMITS, "gain", "time_constant", "delay", "sampling_interval"
DATA_SHEET = *STEP_TEST, "dead_zone"
SETPOINT = "setpoint_holds", "setpoint_amplitude"
BANK = *STEP_TEST, "widest_dead_zone", "delay_range", *SETPOINT
EVERYTHING = "parameters", "num_envs", "seed"


def knowledge(names: Sequence[str], plant: Parameters, runs: int, seed: int) -> dict[str, Any]:
    """Return what a controller may know about a plant, as a dict of quantities by name.

    The returned dict has keyword arguments for the constructor of a controller.

    Parameters
    ----------
    names
        Names of the quantities to return: `parameters` (all arguments of the environment),
        `num_envs` (`runs`), `seed`, `u_min`, `u_max`, `dead_zone` and `widest_dead_zone` (t/h),
        `delay_range` (s), `setpoint_holds` (s), `setpoint_amplitude` (degC), `direction` (the
        sign of the gain, 1 or -1), and the results of a step test: `gain` (degC per t/h),
        `time_constant`, `delay` and `sampling_interval` (s).
    plant
        Arguments of the environment. If arguments are ranges, `u_min` and `u_max` are the
        widest limits of the flow, `dead_zone` is the middle of the range, and the step test is
        made with the plant in the middle of all ranges.
    runs
        Number of runs that the controller controls at once.
    seed
        Seed of the controller's random numbers in the first run; run i has the seed `seed + i`.
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

    The delay from a flow to the first output that the flow can affect is one sample longer than
    the argument `delay` of the environment.
    """
    if not isinstance(plant.delay, Sequence):
        return None
    shortest, longest = plant.delay
    interval = plant.sampling_interval
    return (shortest + 1) * interval, (longest + 1) * interval


def setpoint_holds(plant: Parameters) -> tuple[float, float] | None:
    """Return the shortest and the longest time between changes of a random set point, s.

    The result is None if the set point of the plant is not random.
    """
    levels = SetPointLevels(plant)
    if not levels.random:
        return None
    return levels.shortest * plant.sampling_interval, levels.longest * plant.sampling_interval


@dataclass(frozen=True, kw_only=True)
class ControllerSpec:
    """The record of a controller: everything that commands need to run and describe it.

    The nominal plant has the middle value of each environment argument that is a range.

    Attributes
    ----------
    name : str
        Name of the controller in command-line options and files.
    label : str
        Name of the controller in tables and pictures.
    look : tuple of str
        Colour and marker of the controller in Matplotlib pictures.
    build : callable
        Function that returns the controller. The keyword arguments of `build` are prior
        knowledge, gains, time constants and, if `networks` is not None, a trained `network`.
    prior_knowledge : sequence of str
        Names of the quantities of the plant that the controller knows, as listed in the
        docstring of the function `knowledge`.
    knows : str
        Text for tables that describes the prior knowledge of the controller.
    searched : str
        Text for tables that says what was searched or trained before a comparison, and in how
        many trials and samples.
    tuned_by : str
        Name of the argument of `build`, a time constant in s, that is chosen so that the
        maximum sensitivity of the control loop with the nominal plant is `ROBUSTNESS`; "" if no
        argument is chosen.
    linear : bool
        Whether the controller is linear for commands outside the dead zone and within the
        limits. A linear controller has a method `transfer`, which returns the transfer function
        of the controller.
    assumes : sequence of str
        Properties in which the plant must agree with `made_for`: "direction" (the sign of the
        gain) or "scale" (the magnitudes of gain, reachable temperature, time constant and
        delay).
    made_for : mapping
        Arguments of the environment for which the controller was made; empty for the paper's
        plant.
    observation : mapping
        Number of samples of each signal that the controller observes, by the environment's
        arguments, such as `{"error_window": 3}`.
    networks : callable, optional
        Function that returns the controller's trained networks by file name. A member of the
        controller is the controller with one of the networks; commands run all members.
    random : bool
        Whether the controller draws random numbers, such as initial weights.
    learns : bool
        Whether the controller goes on learning from one run to the next.
    spans : callable, optional
        Function that takes a plant, and returns the interval in which a search looks for each
        gain. Both ends of a search interval have the same sign, and the first end has the
        smaller magnitude.
    compared : bool
        Whether the command `compare` runs the controller by default.
    pictured : bool
        Whether comparisons draw the temperature and the flow of the controller over time.
    provenance : mapping
        Mapping for a JSON file that says where a member comes from, and how its network was
        trained; empty for a controller without trained networks in `ROSTER`.
    """

    name: str
    label: str
    look: tuple[str, str]
    build: Callable[..., Agent]
    prior_knowledge: Sequence[str] = LIMITS
    knows: str = ""
    searched: str = ""
    tuned_by: str = ""
    linear: bool = False
    assumes: Sequence[str] = ()
    made_for: Mapping[str, Any] = field(default_factory=dict)
    observation: Mapping[str, int] = field(default_factory=lambda: PAPER_WINDOWS)
    networks: Callable[[], Mapping[str, Any]] | None = None
    random: bool = False
    learns: bool = False
    spans: Callable[[Parameters], plant_scale.Spans] | None = None
    compared: bool = True
    pictured: bool = False
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def members(self) -> "list[ControllerSpec]":
        """Return a `ControllerSpec` for each trained network, sorted by file name.

        If the controller has no trained networks, the result is the list `[self]`.
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

    def with_gains(self, gains: Mapping[str, Any]) -> "ControllerSpec":
        """Return a copy in which arguments of `build`, by name, have the fixed values `gains`.

        If `gains` has a value for the argument that `tuned_by` names, `robust_time_constant` no
        longer chooses this argument.
        """
        tuned_by = "" if self.tuned_by in gains else self.tuned_by
        return replace(self, build=partial(self.build, **gains), tuned_by=tuned_by)

    def make(self, plant: Mapping[str, Any], runs: int, seed: int) -> Agent:
        """Return a controller for a batch of `runs` runs.

        The controller's prior knowledge is computed from `plant`, arguments of the environment.
        The controller draws random numbers for run i with the seed `seed + i`.
        """
        parameters = Parameters(**{**plant, **self.observation})
        arguments = knowledge(self.prior_knowledge, parameters, runs, seed)
        if self.tuned_by:
            arguments[self.tuned_by] = self.robust_time_constant(plant)
        return self.build(**arguments)

    def robust_time_constant(self, plant: Mapping[str, Any]) -> float:
        """Return the smallest time constant, s, with which the control loop is robust enough.

        The time constant is the argument of `build` that `tuned_by` names. The control loop
        with the nominal plant is robust enough if its maximum sensitivity Ms is at most
        `ROBUSTNESS`. The time constant is rounded to four digits, so that all machines return
        the same number. The rounding can raise Ms slightly above `ROBUSTNESS`.
        """
        parameters = Parameters(**plant)
        arguments = knowledge(self.prior_knowledge, parameters, 1, 0)

        def build(time_constant: float) -> Any:
            return self.build(**arguments, **{self.tuned_by: time_constant})

        # All useful time constants are between `fastest` and `slowest`, s.
        slowest = 30.0 * (arguments["time_constant"] + arguments["delay"])
        fastest = 0.1 * arguments["sampling_interval"]
        model = nominal(parameters)
        exact = time_constant_for(ROBUSTNESS, build, model, slowest, fastest)
        return float(f"{exact:.4g}")

    def loop(self, plant: Mapping[str, Any]) -> LinearLoop:
        """Return the control loop of this linear controller with the nominal plant."""
        controller: Any = self.make(plant, 1, 0)
        return LinearLoop.of(controller, nominal(Parameters(**plant)))

    def misfit(self, plant: Parameters) -> str:
        """Return why the controller does not fit `plant`, as a text; "" if it fits.

        The controller fits if `plant` agrees with the plant `made_for` in all properties of
        `assumes`.
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
            Arguments of the environment.
        samples
            Length of a run, in samples.
        runs
            Number of runs in the batch.
        seed
            Seed of the first run. The environment draws the noise and all other random numbers
            of run i with the seed `seed + i`.
        controller
            Controller that `make` or `in_service` has returned for `runs` runs. By default,
            `run` makes a new controller for `plant`.
        """
        agent = controller or self.make(plant, runs, seed)
        plants = make_plants(runs, samples, **{**plant, **self.observation})
        return rollout(plants, agent, samples, seed)

    def in_service(self, plant: Mapping[str, Any], runs: int, seed: int) -> Agent:
        """Return a controller for `runs` runs, trained on `plant` if the controller learns.

        A controller that learns is first run on `plant` for `LEARNING` samples of the square
        wave.
        """
        controller = self.make(plant, runs, seed)
        if self.learns:
            square = {**plant, "setpoint": "square"}
            self.run(square, LEARNING, runs, COMMISSIONING_SEED, controller)
        return controller
