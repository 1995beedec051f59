"""List the controllers: one record each, with all that the commands need to know of it.

A controller is added here and nowhere else: `compare`, `sweep`, `tune` and `watch` then know
it. A user's own (`--agent NAME=MODULE:FACTORY`) becomes such a record, too.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, asdict, dataclass, field, replace
from functools import partial
from typing import Any

from agents import (
    DirectNNController,
    NeuralSelfTuningController,
    NeuralSmithPredictor,
    PIController,
    PolicyNetwork,
    RecurrentNetwork,
    SelfTuningController,
    SmithPredictor,
)
from agents.controller import PAPER_WINDOWS
from agents.networks import PRETRAINED
from agents.pi import SEARCHED_GAINS
from benchmarks.controllers.mpc import PredictiveController
from benchmarks.loop.linear import nominal, step_test
from benchmarks.loop.rollout import Agent, IdleValve, Trajectory, make_plants, rollout
from mptc_gym import Parameters

LEARNING = 1200  # samples of the square wave on which a network is commissioned
COMMISSIONING_SEED = 3_000_000  # of plants and noise during commissioning
OWN = ("#5B3FA6", "P"), ("#B22222", "X")

# What a controller may be told, by the arguments of its `make`.
LIMITS = "u_min", "u_max"
DIRECTION = *LIMITS, "direction", "num_envs", "seed"
STEP_TEST = *LIMITS, "gain", "time_constant", "delay", "sampling_interval"
DATA_SHEET = *STEP_TEST, "dead_zone"
BANK = *STEP_TEST, "widest_dead_zone", "delay_range"
EVERYTHING = "parameters", "num_envs", "seed"


def knowledge(names: Sequence[str], plant: Parameters, runs: int, seed: int) -> dict[str, Any]:
    """Return what a controller is told of a plant, for a number of runs and a seed.

    Run i uses `seed + i`. Of what is drawn from ranges these are the widest limits, the middle
    of the dead zone and the step test of the plant in the middle.
    """
    told: dict[str, Any] = {"parameters": plant, "num_envs": runs, "seed": seed}
    told |= {"u_min": plant.range_of("u_min")[0], "u_max": plant.range_of("u_max")[1]}
    told["dead_zone"] = sum(plant.range_of("dead_zone")) / 2
    told["widest_dead_zone"] = plant.range_of("dead_zone")[1]
    told["delay_range"] = delay_range(plant)
    if "direction" in names:
        told["direction"] = 1 if nominal(plant).gain > 0.0 else -1
    if "gain" in names:
        told |= step_test(plant)
        half = told["time_constant"] / 2  # that of the closed loop
        told["closed_loop_time_constant"] = float(f"{half:.2g}")
    return {name: told[name] for name in names}


def delay_range(plant: Parameters) -> tuple[float, float] | None:
    """Return the delays that a plant may have, s, with the sample that any input takes to show.

    It is None where the delay is no range.
    """
    if not isinstance(plant.delay, Sequence):
        return None
    shortest, longest = plant.delay
    interval = plant.sampling_interval
    return (shortest + 1) * interval, (longest + 1) * interval


def with_bank(
    kind: type[SelfTuningController], *, widest_dead_zone: float, **known: Any
) -> SelfTuningController:
    """Return a controller with a bank of models, whose commands clear the widest dead zone."""
    return kind(dead_zone=widest_dead_zone, **known)


@dataclass(frozen=True)
class Controller:
    """A controller, or one that was trained, as all commands know it."""

    name: str  # in options and files
    label: str  # in tables and pictures
    look: tuple[str, str]  # colour and marker in pictures: those of relatives are alike
    # Makes it from what it is told, searched gains by name, and a `network` of its own.
    make: Callable[..., Agent]
    _: KW_ONLY
    told: Sequence[str] = LIMITS  # arguments of `make`, as `knowledge` returns them
    knows: str = ""  # what it is told about the plant, in words
    searched: str = ""  # or trained, and in how many trials and samples of the plant
    # Windows that it expects, by the environment's arguments.
    observation: Mapping[str, int] = field(default_factory=lambda: PAPER_WINDOWS)
    # Reads the networks that were trained separately, by file: each makes a member.
    networks: Callable[[], Mapping[str, Any]] | None = None
    random: bool = False  # it draws something itself, such as its first weights
    learns: bool = False  # from run to run
    # Lowest and highest value of each of its gains in a search, by name.
    gains: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    compared: bool = True  # by default, in `compare`
    swept: bool = True  # likewise, in `sweep`
    drawn: bool = False  # its responses are, in a comparison
    # Origin of a trained network, JSON-serialisable; empty if nothing was trained.
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def members(self) -> "list[Controller]":
        """Return the controller, or one for each of the networks that it was trained to."""
        if self.networks is None:
            return [self]
        return [
            replace(
                self,
                make=partial(self.make, network=network),
                observation=getattr(network, "observation", self.observation),
                provenance={"file": file, **network.provenance},
                networks=None,
            )
            for file, network in sorted(self.networks().items())
        ]

    def __call__(self, plant: Mapping[str, Any], runs: int, seed: int) -> Agent:
        """Return a controller for `runs` plants, made for the plant with these arguments."""
        parameters = Parameters(**{**plant, **self.observation})
        return self.make(**knowledge(self.told, parameters, runs, seed))

    def run(
        self,
        plant: Mapping[str, Any],
        samples: int,
        runs: int,
        seed: int,
        controller: Agent | None = None,
    ) -> Trajectory:
        """Run the given controller, by default a new one for this plant; see `rollout`."""
        agent, arguments = controller or self(plant, runs, seed), {**plant, **self.observation}
        if hasattr(agent, "opened"):  # a user's, that acts in its own
            with agent.opened(samples, **arguments) as plants:
                return rollout(plants, agent, samples, seed)
        return rollout(make_plants(runs, samples, **arguments), agent, samples, seed)

    def in_service(self, plant: Mapping[str, Any], runs: int, seed: int) -> Agent:
        """Return a controller that is ready for plants it was not made for.

        A controller that learns has already learnt on the plant it is made for.
        """
        controller = self(plant, runs, seed)
        if self.learns:
            square = {**plant, "setpoint": "square"}
            self.run(square, LEARNING, runs, COMMISSIONING_SEED, controller)
        return controller


def frozen_nn(parameters: Parameters, num_envs: int, seed: int) -> Agent:
    """Return the paper's network after it has learnt on the plant that it is made for."""
    controller: Any = ROSTER["nn"].in_service(asdict(parameters), num_envs, seed)
    controller.learning = False
    return controller  # type: ignore[no-any-return]


def with_policy(parameters: Parameters, network: PolicyNetwork, **limits: Any) -> Agent:
    """Return a trained policy for the actuator's limits.

    If it compensates a dead zone, that is the plant's, where it is a number.
    """
    increments, zone = network.increments, parameters.dead_zone
    if increments and increments.dead_zone and not isinstance(zone, Sequence):
        increments = replace(increments, dead_zone=zone)
    return replace(network, increments=increments, **limits)


def trained(kind: type[PolicyNetwork | RecurrentNetwork], files: str) -> Mapping[str, Any]:
    """Return the networks in `agents/pretrained` that match a pattern, by file."""
    return {file.name: kind.load(file) for file in PRETRAINED.glob(files)}


_STEP_TEST = "gain, time constant, delay"
_DATA_SHEET = f"{_STEP_TEST}, dead zone, limits"
_NN = "25 weights in the run itself; 6 gains by 800 trials: 566 M samples, 6 min"
_LAW = "16,496 weights for all plants: 9.4 M samples a network, 8 min; 45 settings by hand"
_RULE = "nothing: one step test, a rule"
_NETWORK = partial(trained, RecurrentNetwork, "neural-[0-9]*.npz")

ROSTER = {each.name: each for each in (
    Controller(
        "nothing", "no control", ("#8C8C8C", "x"), IdleValve,
        knows="nothing", searched="nothing", observation={}, compared=False, swept=False,
    ),
    Controller(
        "nn", "NN (1992)", ("#D55E00", "o"), DirectNNController, told=DIRECTION,
        knows="direction", searched=_NN, random=True, learns=True, drawn=True,
        gains={
            "eta": (1e-3, 10.0),
            "eta_1": (1e-3, 1.0),
            "eta_theta": (1e-4, 1.0),
            "eta_1_theta": (1e-4, 1.0),
            "input_scale": (0.02, 1.0),
            "weight_scale": (0.05, 2.0),
        },
    ),
    Controller(
        "nn-frozen", "NN (1992), frozen", ("#7A3600", "o"), frozen_nn, told=EVERYTHING,
        knows="direction", searched=f"{_NN}; 1,200 samples before", random=True, compared=False,
    ),
    Controller(
        "pi", "PI (1992)", ("#CC79A7", "s"), PIController,
        knows="gains of the paper", searched="2 gains, not stated how", drawn=True,
        gains={"kp": (0.1, 10.0), "ki": (1e-3, 1.0)},
    ),
    Controller(
        "pi-simc", "PI (SIMC)", ("#8E3B6B", "s"), PIController.simc, told=STEP_TEST,
        knows=_STEP_TEST, searched=_RULE,
    ),
    Controller(
        "pi-searched", "PI (searched)", ("#4F1F3B", "s"),
        partial(PIController, kp=SEARCHED_GAINS["kp"], ki=SEARCHED_GAINS["ki"]),
        knows="gains of the search",
        searched="2 gains by 800 trials: 566 M samples, 3 min", swept=False,
    ),
    Controller(
        "smith", "Smith", ("#56B4E9", "^"), SmithPredictor,
        told=(*DATA_SHEET, "closed_loop_time_constant"),
        knows=_DATA_SHEET, searched=_RULE,
    ),
    Controller(
        "self-tuning", "self-tuning", ("#00B98A", "v"),
        partial(with_bank, SelfTuningController), told=BANK,
        knows=f"{_DATA_SHEET}; delay range",
        searched="30 settings by hand; one step test",
    ),
    Controller(
        "mpc", "MPC", ("#000000", "*"), PredictiveController, told=EVERYTHING,
        knows="everything but the future", searched="nothing", swept=False,
    ),
    Controller(
        "ppo", "PPO", ("#E69F00", "D"), with_policy, told=("parameters", *LIMITS),
        knows="dead zone", drawn=True,
        searched="388 weights on the paper's plant: 5 M samples a policy; settings by 79 "
        "trials: 121 M samples, 30 min",
        networks=partial(trained, PolicyNetwork, "ppo-[0-9]*.npz"),
    ),
    Controller(
        "ppo-hard", "PPO (hard)", ("#8F6200", "D"), with_policy, told=("parameters", *LIMITS),
        knows="nothing",
        searched="12,608 weights on plants that vary: 4 M samples a policy; settings by 43 "
        "trials: 36 M samples, 12 min",
        networks=partial(trained, PolicyNetwork, "ppo-hard-*.npz"),
    ),
    Controller(
        "neural-smith", "neural Smith", ("#0072B2", "^"),
        NeuralSmithPredictor, told=DATA_SHEET, knows=_DATA_SHEET,
        searched=f"{_LAW}; one step test", networks=_NETWORK, drawn=True,
    ),
    Controller(
        "neural-self-tuning", "neural self-tuning", ("#00664B", "v"),
        partial(with_bank, NeuralSelfTuningController), told=BANK,
        knows=f"{_DATA_SHEET}; delay range",
        searched=f"{_LAW}; one step test", networks=_NETWORK,
    ),
)}  # fmt: skip


def label(agent: str) -> str:
    """Return the name of a controller in tables and pictures."""
    return ROSTER[agent].label if agent in ROSTER else agent


def looks(agents: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Return the colour and the marker of each controller; a user's own take turns."""
    turns = itertools.cycle(OWN)
    return {agent: ROSTER[agent].look if agent in ROSTER else next(turns) for agent in agents}
