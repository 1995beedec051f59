"""Declare the options that say which controllers are run, and read them."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from benchmarks.controllers.factories import load_factory, try_out
from benchmarks.controllers.records import POLICIES, Controller, Training
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command_line import (
    UsageError,
    add_fan_out,
    fan_out,
    known,
    number,
    out_folder,
)


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
