"""The roster: one record for each controller, with all that any command has to know of it.

A controller is added here and nowhere else. `compare`, `sweep`, `tune`, `train` and `watch`
know it then. A user's own controllers (`--agent NAME=MODULE:FACTORY`) become such records, too.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np

from benchmarks.lib.command_line import UsageError, known
from benchmarks.lib.fan_out import FanOut
from benchmarks.rollout import Agent, make_plants
from mptc_gym import Parameters

Factory = Callable[..., Agent]

WINDOWS = ("setpoint_window", "error_window", "output_window", "action_window")
POLICIES = Path("results/policies")  # where trained policies are kept


@dataclass(frozen=True)
class Account:
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
    make
        "module:function", called with the gains, `final` (whether they are judged for the last
        time) and `member` (the number of the controller); returns a factory. By default the
        controller's own factory gets the gains as arguments.
    """

    space: Mapping[str, tuple[float, float]]
    trials: int = 800
    startup: int = 200
    finalists: int = 10
    penalty: float = 5.0
    members: tuple[int, int] = (1, 1)
    make: str = ""


@dataclass(frozen=True)
class Training:
    """How controllers that need training are to be had.

    Attributes
    ----------
    fan_out
        Runs the trainings.
    folder
        Where trained policies are kept.
    steps
        Samples of experience; None for as many as the training has by default.
    members
        How many policies, which differ in their seeds; None for the default.
    retrain
        Whether to train even where a finished policy is at hand.
    """

    fan_out: FanOut = field(default_factory=lambda: FanOut(1))
    folder: Path = POLICIES
    steps: int | None = None
    members: int | None = None
    retrain: bool = False


@dataclass(frozen=True)
class Controller:
    """A controller and all that any command has to know of it.

    Attributes
    ----------
    name
        In options and files.
    label
        In tables and plots.
    factory
        "module:factory"; see `load_factory`. Empty if `trained` is given.
    trained
        "module:function", called with a `Training`; returns factories, one for each policy.
        They may have attributes `provenance`, a dict for JSON, and `curve`, the learning curve
        as a list of rows.
    in_service
        "module:factory" of the controller as `sweep` meets it, if it is another one: one that
        has learnt on the plant that it was made for.
    account
        What it costs before it runs.
    tuning
        How its gains are searched, if they are.
    compared, swept
        Whether `compare` and `sweep` run it unless told otherwise.
    drawn
        Whether its responses are drawn in a comparison.
    """

    name: str
    label: str
    factory: str = ""
    trained: str = ""
    in_service: str = ""
    account: Account = Account()
    tuning: Tuning | None = None
    compared: bool = True
    swept: bool = False
    drawn: bool = False

    def members(self, training: Training | None = None) -> list[Factory]:
        """Return the factories of its members: one, or several that were trained apart."""
        if self.trained:
            return cast("list[Factory]", load(self.trained)(training or Training()))
        return [load_factory(self.factory)]

    def members_in_service(self, training: Training | None = None) -> list[Factory]:
        """Return its members as they come to plants that they were not made for."""
        if self.in_service:
            return [load_factory(self.in_service)]
        return self.members(training)


_STEP_TEST = "gain, time constant, delay"

ROSTER: dict[str, Controller] = {
    controller.name: controller
    for controller in (
        Controller(
            "nothing",
            "no control",
            "benchmarks.controllers.engineered:Nothing",
            account=Account("nothing", "0", "none"),
            compared=False,
        ),
        Controller(
            "nn",
            "NN",
            "agents:DirectNNController",
            in_service="benchmarks.controllers.commissioned:learning_network",
            account=Account(
                "direction; gains searched on the paper's plant",
                "25 weights, 6 gains",
                "566 M (search)",
            ),
            tuning=Tuning(
                {
                    "eta": (1e-3, 10.0),
                    "eta_1": (1e-3, 1.0),
                    "eta_theta": (1e-4, 1.0),
                    "eta_1_theta": (1e-4, 1.0),
                    "input_scale": (0.02, 1.0),
                    "weight_scale": (0.05, 2.0),
                }
            ),
            swept=True,
            drawn=True,
        ),
        Controller(
            "nn-frozen",
            "NN, frozen",
            "benchmarks.controllers.commissioned:frozen_network",
            account=Account(
                "direction; gains searched on the paper's plant",
                "25 weights, 6 gains",
                "566 M (search), 1,200 a network",
            ),
            compared=False,
            swept=True,
        ),
        Controller(
            "pi",
            "PI",
            "agents:PIController",
            account=Account("gains of the paper", "2", "not stated"),
            tuning=Tuning({"kp": (0.1, 10.0), "ki": (1e-3, 1.0)}),
            swept=True,
            drawn=True,
        ),
        Controller(
            "pi-simc",
            "PI, SIMC",
            "benchmarks.controllers.engineered:simc_pi",
            account=Account(_STEP_TEST, "2", "one step test"),
            swept=True,
        ),
        Controller(
            "pi-searched",
            "PI, searched",
            "benchmarks.controllers.engineered:searched_pi",
            account=Account("gains searched on the paper's plant", "2", "566 M (search)"),
        ),
        Controller(
            "smith",
            "Smith",
            "benchmarks.controllers.engineered:smith",
            account=Account(
                f"{_STEP_TEST}, dead zone, limits", "2 gains, 5 of the model", "one step test"
            ),
            swept=True,
            drawn=True,
        ),
        Controller(
            "mpc",
            "MPC",
            "benchmarks.controllers.engineered:mpc",
            account=Account("everything but the future", "all of the plant's", "none"),
        ),
        Controller(
            "ppo",
            "PPO",
            trained="benchmarks.train.ppo:members",
            account=Account("delay, by the past actions it sees", "6,081 weights a policy"),
            tuning=Tuning(
                {
                    "learning_rate": (7e-4, 2e-3),
                    "gamma": (0.96, 0.985),
                    "noise_variance": (0.1, 0.8),
                    "setpoint_amplitude": (5.0, 7.0),
                },
                trials=9,
                startup=5,
                finalists=2,
                # Without integral action a policy does not settle to the last; only its
                # errors count.
                penalty=0.0,
                members=(2, 4),
                make="benchmarks.train.ppo:tuned",
            ),
            swept=True,
            drawn=True,
        ),
        Controller(
            "ppo-randomised",
            "PPO, randomised",
            trained="benchmarks.train.ppo:randomised_members",
            account=Account("delay range, by the past actions it sees", "8,400 weights"),
            compared=False,
            swept=True,
        ),
    )
}


def label(agent: str) -> str:
    """Return the name of a controller in tables and plots."""
    return ROSTER[agent].label if agent in ROSTER else agent


def chosen(names: Sequence[str], own: Sequence[str] = ()) -> dict[str, Controller]:
    """Return the controllers that options ask for.

    Parameters
    ----------
    names
        Of the roster, with spaces or commas between them.
    own
        A user's own, each `NAME=MODULE:FACTORY`.

    Returns
    -------
    dict of Controller
        By name, those of the roster first.

    Raises
    ------
    UsageError
        If there is no such controller, or no controller at all.
    """
    found = {name: ROSTER[name] for name in known("--agents", names, list(ROSTER))}
    for text in own:
        name, equals, location = text.partition("=")
        if not (name and equals) or name.lower() in {*ROSTER, *found}:
            raise UsageError(f"--agent must be NEW_NAME=MODULE:FACTORY, got {text!r}")
        found[name] = own_controller(name, location)
    if not found:
        raise UsageError("--agents, --agent: no controller to run")
    return found


def own_controller(name: str, location: str) -> Controller:
    """Return a record for a user's own controller, which has been tried out.

    Raises
    ------
    UsageError
        If there is no such factory, or if what it makes is no controller.
    """
    try:
        try_out(load_factory(location))
    except ValueError as error:
        raise UsageError(f"--agent: {error}") from error
    return Controller(name, name, location, drawn=True)


def try_out(factory: Factory) -> None:
    """Have a factory's controller act once on two plants.

    Raises
    ------
    ValueError
        If it is no controller of a batch; the message says what is expected.
    """
    windows = observation(factory)
    parameters = Parameters(**windows)
    controller = build(factory, parameters, 2, 0)
    for method in ("reset", "act"):
        if not callable(getattr(controller, method, None)):
            raise ValueError(
                f"{factory!r} must return an object with reset() and act(observations), "
                f"got {controller!r}"
            )
    plants = make_plants(2, 1, **windows)
    observations, _ = plants.reset(seed=0)
    plants.close()
    expected = (
        f"act must take observations of shape {observations.shape}, one row a plant, and "
        "return actions of shape (2, 1)"
    )
    controller.reset()
    try:
        actions = np.asarray(controller.act(observations), np.float64)
    except Exception as error:
        raise ValueError(f"{expected}; it raised {type(error).__name__}: {error}") from error
    if actions.shape != (2, 1):
        raise ValueError(f"{expected}, got shape {actions.shape}")


def load(location: str) -> Callable[..., Any]:
    """Import what `module:name` names.

    Raises
    ------
    ValueError
        If there is no such module, or nothing callable of that name in it.
    """
    module_name, _, name = location.partition(":")
    if not (module_name and name):
        raise ValueError(f"{location!r} must be module:factory")
    try:
        found = getattr(importlib.import_module(module_name), name)
    except (ImportError, AttributeError, ValueError, TypeError) as error:
        raise ValueError(f"{location!r} must be module:factory: {error}") from error
    if not callable(found):
        raise ValueError(f"{location!r} must be callable, got {found!r}")
    return cast("Callable[..., Any]", found)


def load_factory(location: str) -> Factory:
    """Import a factory.

    Parameters
    ----------
    location
        `module:factory`. The factory is called with keyword arguments, those of the following
        that it has: `num_envs` (runs in the batch), `seed` (run i is to use `seed + i`),
        `u_min`, `u_max` (t/h) and `parameters` (all arguments of the environment). It returns
        an object with `reset()` and `act(observations) -> actions`. Its attribute
        `observation`, if it has one, is a dict of the environment's `*_window` arguments, and
        gives the controller the observation that it wants.

    Returns
    -------
    callable
        The factory.

    Raises
    ------
    ValueError
        If there is no such module or factory in it, or if its observation is none.
    """
    factory = cast("Factory", load(location))
    observation(factory)
    return factory


def build(factory: Factory, parameters: Parameters, num_envs: int, seed: int) -> Agent:
    """Call a factory with those of the arguments it can be offered that it has."""
    offered: dict[str, Any] = {
        "num_envs": num_envs,
        "seed": seed,
        "u_min": parameters.range_of("u_min")[0],
        "u_max": parameters.range_of("u_max")[1],
        "parameters": parameters,
    }
    accepted = inspect.signature(factory).parameters
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in accepted.values()):
        return factory(**offered)
    return factory(**{name: value for name, value in offered.items() if name in accepted})


def observation(factory: Factory) -> dict[str, Any]:
    """Return the arguments of the environment that give a factory's controllers their input.

    Raises
    ------
    ValueError
        If it is no dict, or holds other arguments: everyone is to control the same plant.
    """
    arguments = getattr(factory, "observation", {})
    if not isinstance(arguments, Mapping):
        raise ValueError(f"observation of {factory!r} must be a dict, got {arguments!r}")
    for name in arguments:
        if name not in WINDOWS:
            raise ValueError(
                f"observation of {factory!r} must have names out of {', '.join(WINDOWS)}, "
                f"got {name!r}"
            )
    return dict(arguments)
