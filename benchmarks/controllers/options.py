"""Declare and read the options that choose the controllers to run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

from cyclopts import Parameter

from benchmarks.controllers.own import own_entry
from benchmarks.controllers.records import RosterEntry
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command import (
    Names,
    Repeated,
    UsageError,
    known,
    options,
)
from benchmarks.lib.fan_out import FanOut

AgentNames = Annotated[
    Names, Parameter(help=f"Controllers to run, out of {', '.join(ROSTER)}.")
]


@options
@dataclass(frozen=True, kw_only=True)
class ControllerOptions:
    """A user's own controllers, and where controllers run."""

    agent: Repeated = ()
    """A controller of your own in addition to those of --agents, NAME=MODULE:FACTORY or
    NAME=PPO:FILE.zip, of mptc_gym.sb3.save; loading a zip runs the code in it. The same name
    again adds another training of it (repeatable)."""
    fan_out: FanOut = field(default_factory=FanOut)


def chosen(names: Sequence[str], own: Sequence[str] = ()) -> dict[str, RosterEntry]:
    """Return controllers of the roster by name, then a user's own, as given to `--agent`.

    Raises
    ------
    UsageError
        If there is no such controller, or no controller at all.
    """
    found = {name: ROSTER[name] for name in known("--agents", names, list(ROSTER))}
    locations: dict[str, list[str]] = {}
    for text in own:
        name, equals, location = text.partition("=")
        taken = f", and {name!r} is taken" if name.lower() in ROSTER else ""
        if taken or not (name and equals):
            raise UsageError(
                "--agent must be NEW_NAME=MODULE:FACTORY or NEW_NAME=PPO:FILE.zip"
                f"{taken}, got {text!r}"
            )
        locations.setdefault(name, []).append(location)
    found |= {name: own_entry(name, each) for name, each in locations.items()}
    if not found:
        raise UsageError("--agents, --agent: no controller to run")
    return found
