"""The roster: one record for each controller, with all that any command has to know of it.

A controller is added here and nowhere else. `compare`, `sweep`, `tune`, `train` and `watch`
know it then. A user's own controllers (`--agent NAME=MODULE:FACTORY`) become such records, too.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from benchmarks.controllers.factories import load_factory, try_out
from benchmarks.controllers.records import POLICIES, Account, Controller, Training, Tuning
from benchmarks.lib.command_line import (
    UsageError,
    add_fan_out,
    fan_out,
    known,
    number,
    out_folder,
)

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
            "benchmarks.controllers.engineered:direct_nn",
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
            "self-tuning",
            "self-tuning",
            "benchmarks.controllers.engineered:self_tuning",
            account=Account(
                f"{_STEP_TEST}, dead zone, limits; delay range",
                "a bank of models, 30 settings",
                "one step test",
            ),
            swept=True,
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
            account=Account("dead zone; delay, by the past actions it sees"),
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
            account=Account("dead zone; delay range, by the past actions it sees"),
            compared=False,
            swept=False,
        ),
        Controller(
            "nn-dpc",
            "NN, trained through the plant",
            "benchmarks.controllers.pretrained:nn_dpc",
            account=Account("the paper's plant: its equations, ranges of dead zone and noise"),
            swept=True,
            drawn=True,
        ),
        Controller(
            "nn-adaptive",
            "NN, trained on many plants",
            "benchmarks.controllers.pretrained:nn_adaptive",
            account=Account("the class of plants: equations, and ranges of their numbers"),
            swept=True,
            drawn=True,
        ),
    )
}


def label(agent: str) -> str:
    """Return the name of a controller in tables and plots."""
    return ROSTER[agent].label if agent in ROSTER else agent


def add_options(parser: argparse.ArgumentParser, agents: Sequence[str], what: str) -> None:
    """Add the options that say which controllers are run, and how those that learn are trained.

    Parameters
    ----------
    parser
        Gets them.
    agents
        The controllers that are run by default.
    what
        Is run by the fan-out, in the words of its help.
    """
    add = parser.add_argument
    add(
        "--agents",
        nargs="*",
        default=agents,
        metavar="NAME",
        help=f"which controllers to run, out of {', '.join(ROSTER)}",
    )
    add(
        "--agent",
        action="append",
        default=[],
        metavar="NAME=MODULE:FACTORY",
        help="a controller of your own, beside those of --agents (may be given more than once)",
    )
    add(
        "--training-steps",
        type=number,
        default=argparse.SUPPRESS,
        metavar="N",
        help="train each policy of PPO with N samples of experience (default: take those that "
        "come with the project)",
    )
    add(
        "--policies",
        type=number,
        default=argparse.SUPPRESS,
        metavar="N",
        help="how many policies of PPO to run, each from a seed of its own (default: 5)",
    )
    add_fan_out(parser, what)
    add(
        "--kept",
        type=Path,
        default=POLICIES,
        metavar="FOLDER",
        help="where policies that are trained here are kept; no code in its files is run",
    )


def training(options: argparse.Namespace, *, retrain: bool = False) -> Training:
    """Return the training that the options of `add_options` ask for.

    Raises
    ------
    UsageError
        If policies are to be trained and their folder cannot be written to.
    """
    steps, policies = (getattr(options, name, None) for name in ("training_steps", "policies"))
    is_folder = options.kept.is_dir() or not options.kept.exists()
    if retrain or steps or policies or not is_folder:
        out_folder(options.kept, "--kept")
    return Training(fan_out(options), options.kept, steps, policies, retrain)


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
