"""List the controllers that the commands can run, each with the function that makes it.

The function of a controller takes a `KnownPlant` and shows what the controller knows: the
controller knows what its function takes from the plant. The command `compare` can run each
controller of `ROSTER`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from agents import (
    DahlinController,
    DirectNNController,
    PIController,
    PolicyNetwork,
    SelfTuningController,
    SmithPredictor,
)
from agents.networks import PRETRAINED
from agents.pi import SEARCHED_GAINS
from benchmarks.controllers.known_plant import KnownPlant
from benchmarks.controllers.mpc import PredictiveController
from benchmarks.loop.linear import ROBUSTNESS
from benchmarks.loop.runs import Agent, IdleValve, Trajectory, make_plants, simulate
from mptc_gym.plant.parameters import PAPER_WINDOWS

# Ratio of the closed-loop time constant of Dahlin's controller to the plant's time constant.
# The small ratio makes the control loop fast; the filter time constant makes the control loop
# robust.
LAMBDA = 0.1

Made = tuple[Agent, dict[str, Any]]  # a controller and the arguments of its environment


@dataclass(frozen=True)
class Group:
    """Controllers with equal prior knowledge, which pictures show alike."""

    title: str
    """What the controllers know before a run, in a few words."""
    colour: str
    marker: str
    """Colour and marker in Matplotlib pictures; the colour has a contrast of at least 3:1."""


GROUPS = {
    "plant": Group("knows the plant exactly", "#000000", "*"),
    "step test": Group("knows a step test of the plant", "#0072B2", "s"),
    "simulator": Group("settings from a simulator", "#007A5A", "D"),
    "paper's PI gains": Group("two gains from the paper", "#9B2F8C", "X"),
    "own": Group("your own", "#C04A00", "o"),
    "nothing": Group("knows nothing", "#666666", "P"),
}
"""The groups of controllers by a short name, in the order of pictures."""


@dataclass(frozen=True, kw_only=True)
class ControllerSpec:
    """The record of a controller: everything that commands need to run and describe it.

    Attributes
    ----------
    name : str
        Name of the controller in command-line options and files.
    label : str
        Name of the controller in tables and pictures.
    group : str
        Key of the group in `GROUPS` to which the controller belongs, by its prior knowledge.
    make : callable
        Function `make(plant, runs, seed)` that returns a controller for a batch of `runs` runs,
        and the arguments of its environment: those of the plant, and those of its observations
        and actions, such as `action_window=20`. `plant` is a `KnownPlant`, and the controller
        draws random numbers for run i with the seed `seed + i`.
    knows : str
        Text for tables that describes the prior knowledge of the controller.
    searched : str
        Text for tables that says what was searched or trained before a comparison, and in how
        many trials and samples.
    arguments : mapping
        Further arguments of `make` by name: gains, or a training run.
    trainings : sequence of str
        Files of trained networks in `agents/pretrained`, or a user's files or factories. A
        member of the controller is the controller with one of them, which `make` gets as its
        argument `training`. Commands run all members.
    direction : int, optional
        Sign of the gain of the plants that the controller was made for; None if the controller
        fits plants of both signs.
    random : bool
        Whether the controller draws random numbers, such as initial weights.
    learns : bool
        Whether the controller learns during a run, which pictures say.
    compared : bool
        Whether the command `compare` runs the controller by default.
    """

    name: str
    label: str
    group: str
    make: Callable[..., Made]
    knows: str = ""
    searched: str = ""
    arguments: Mapping[str, Any] = field(default_factory=dict)
    trainings: Sequence[str] = ()
    direction: int | None = None
    random: bool = False
    learns: bool = False
    compared: bool = True

    @property
    def prior_knowledge(self) -> str:
        """What the controller knows before a run, in a few words, and whether it learns."""
        title = GROUPS[self.group].title
        return f"{title}; learns in the run" if self.learns else title

    def members(self) -> "list[ControllerSpec]":
        """Return the controllers to start: one for each training, or this one if none."""
        # A member has no trainings, and so is its own only member.
        members = [
            replace(self, arguments={"training": training}, trainings=())
            for training in self.trainings
        ]
        return members or [self]

    def start(self, plant: Mapping[str, Any], runs: int, seed: int) -> Made:
        """Make a controller for a batch, and return it with the arguments of its environment.

        `plant` are arguments of the environment that define the plant and the set point.
        """
        # A controller observes the paper's windows, unless its `make` returns others.
        known = KnownPlant({**plant, **PAPER_WINDOWS})
        return self.make(known, runs, seed, **self.arguments)

    def run(self, plant: Mapping[str, Any], samples: int, runs: int, seed: int) -> Trajectory:
        """Start a controller, run it on a batch of plants, and return the signals of the runs.

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
        """
        agent, arguments = self.start(plant, runs, seed)
        return simulate(make_plants(runs, samples, **arguments), agent, samples, seed)


def idle(plant: KnownPlant, runs: int, seed: int) -> Made:
    """Return a controller that keeps the flow at 0 t/h."""
    return IdleValve(**plant.limits), plant.arguments


def nn(plant: KnownPlant, runs: int, seed: int, **gains: float) -> Made:
    """Return the paper's network, which knows the sign of the gain and learns the rest."""
    arguments: dict[str, Any] = {**plant.limits, **gains}
    network = DirectNNController(
        direction=plant.direction, num_envs=runs, seed=seed, **arguments
    )
    return network, plant.arguments


def pi(plant: KnownPlant, runs: int, seed: int, **gains: float) -> Made:
    """Return a PI controller with fixed gains, by default those of the paper."""
    arguments: dict[str, Any] = {**plant.limits, **gains}
    return PIController(**arguments), plant.arguments


def pi_simc(plant: KnownPlant, runs: int, seed: int) -> Made:
    """Return a PI controller that the rule SIMC tunes to a step test."""

    def simc(time_constant: float) -> PIController:
        return PIController.simc(
            closed_loop_time_constant=time_constant, **plant.step_test, **plant.limits
        )

    return plant.robust(simc), plant.arguments


def smith(plant: KnownPlant, runs: int, seed: int) -> Made:
    """Return a Smith predictor that knows a step test, the dead zone and the limits."""

    def predictor(time_constant: float) -> SmithPredictor:
        return SmithPredictor(
            closed_loop_time_constant=time_constant,
            dead_zone=plant.dead_zone,
            **plant.step_test,
            **plant.limits,
        )

    return plant.robust(predictor), plant.arguments


def dahlin(plant: KnownPlant, runs: int, seed: int) -> Made:
    """Return Dahlin's controller, which knows a step test, the dead zone and the limits."""

    def controller(filter_time_constant: float) -> DahlinController:
        return DahlinController(
            closed_loop_time_constant=LAMBDA * plant.step_test["time_constant"],
            filter_time_constant=filter_time_constant,
            dead_zone=plant.dead_zone,
            **plant.step_test,
            **plant.limits,
        )

    return plant.robust(controller), plant.arguments


def self_tuning(plant: KnownPlant, runs: int, seed: int) -> Made:
    """Return a self-tuning controller, which weighs candidates for the plant.

    The controller knows a step test, the limits, the largest dead zone, and the ranges of the
    delay and of the set points. It assumes the shape of the paper's polynomials: their fast
    pole, the ratio of the coefficients of B, and the colour of the noise.
    """
    controller = SelfTuningController(
        dead_zone=plant.widest_dead_zone,
        delay_range=plant.delay_range,
        setpoint_holds=plant.setpoint_holds,
        setpoint_amplitude=plant.parameters.setpoint_amplitude,
        **plant.step_test,
        **plant.limits,
    )
    return controller, plant.arguments


def mpc(plant: KnownPlant, runs: int, seed: int) -> Made:
    """Return model predictive control, which knows everything except the future."""
    return PredictiveController(plant.parameters, runs, seed), plant.arguments


def ppo(plant: KnownPlant, runs: int, seed: int, training: str) -> Made:
    """Return a policy that was trained by PPO, which observes and acts as in its training.

    `training` is the file of the network. If a dead zone was compensated in the training, the
    dead zone of `plant` is compensated instead, unless that is a range.
    """
    # The absolute path of a user's file takes the place of the folder `PRETRAINED`.
    network = PolicyNetwork.load(PRETRAINED / training, **plant.limits)
    interface = network.interface
    if network.compensated_dead_zone and "dead_zone" not in plant.parameters.ranges:
        interface["compensated_dead_zone"] = plant.dead_zone
    return network, {**plant.arguments, **interface}


def _trained(pattern: str) -> list[str]:
    """Return the names of the project's network files that match `pattern`."""
    return sorted(file.name for file in PRETRAINED.glob(pattern))


# Texts for reports: what a controller knows, and how the controller was searched or trained. In
# reports, 1 M samples are a million samples.
_KNOWS_STEP_TEST = "gain, time constant, delay"
_KNOWS_DATA_SHEET = f"{_KNOWS_STEP_TEST}, dead zone, limits"
_TUNING_RULE = f"one time constant, by a tuning rule and an Ms of {ROBUSTNESS:g}; one step test"
_SPECS = (
    ControllerSpec(
        name="idle",
        label="idle valve",
        group="nothing",
        make=idle,
        knows="nothing",
        searched="nothing",
        compared=False,
    ),
    ControllerSpec(
        name="nn",
        label="NN (1992)",
        group="simulator",
        learns=True,
        make=nn,
        knows="sign of the gain; settings searched on the paper's plant",
        searched="25 weights in the run itself; 6 settings by the search of version 0.1; the "
        "present search takes 800 trials: 566 M samples, 6 min",
        random=True,
    ),
    ControllerSpec(
        name="pi",
        label="PI (1992)",
        group="paper's PI gains",
        make=pi,
        knows="gains of the paper, for its plant",
        searched="2 gains; the paper does not say how they were found",
        direction=-1,
    ),
    ControllerSpec(
        name="pi-simc",
        label="PI (SIMC)",
        group="step test",
        make=pi_simc,
        knows=_KNOWS_STEP_TEST,
        searched=_TUNING_RULE,
    ),
    ControllerSpec(
        name="pi-searched",
        label="PI (searched)",
        group="simulator",
        make=pi,
        arguments=SEARCHED_GAINS,
        knows="gains searched on the paper's plant",
        searched="2 gains by an earlier version of the search; the present search takes 800 "
        "trials: 566 M samples, 3 min",
        direction=-1,
    ),
    ControllerSpec(
        name="smith",
        label="Smith",
        group="step test",
        make=smith,
        knows=_KNOWS_DATA_SHEET,
        searched=_TUNING_RULE,
    ),
    ControllerSpec(
        name="dahlin",
        label="Dahlin",
        group="step test",
        make=dahlin,
        knows=_KNOWS_DATA_SHEET,
        searched=f"{_TUNING_RULE}; closed-loop time constant by hand: a tenth of the plant's",
    ),
    ControllerSpec(
        name="self-tuning",
        label="self-tuning",
        group="step test",
        learns=True,
        make=self_tuning,
        knows=f"{_KNOWS_DATA_SHEET}; delay range; hold times of random set points; fast pole, "
        "ratio of the coefficients of B, and noise colour of the paper's plant",
        searched="about 20 settings by hand; one step test",
    ),
    ControllerSpec(
        name="mpc",
        label="MPC",
        group="plant",
        make=mpc,
        knows="everything except the future",
        searched="nothing",
    ),
    ControllerSpec(
        name="ppo",
        label="PPO",
        group="simulator",
        make=ppo,
        trainings=_trained("ppo-[0-9]*.npz"),
        knows="dead zone; trained on a simulator of the paper's plant",
        searched="388 weights on the paper's plant: 5 M samples per policy; settings by 79 "
        "trials: 121 M samples, 30 min",
        direction=-1,
    ),
    ControllerSpec(
        name="ppo-hard",
        label="PPO (hard)",
        group="simulator",
        make=ppo,
        trainings=_trained("ppo-hard-*.npz"),
        knows="limits; trained on a simulator of the plants of the preset hard",
        searched="12,608 weights on plants that vary: 4 M samples per policy; settings by 43 "
        "trials: 36 M samples, 12 min",
        direction=-1,
    ),
)

ROSTER = {spec.name: spec for spec in _SPECS}
"""All controllers by name."""
