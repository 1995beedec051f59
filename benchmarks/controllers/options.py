"""Declare the options that say which controllers are run, and read them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from benchmarks.controllers.own import own_entry
from benchmarks.controllers.records import RosterEntry
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command_line import UsageError, known, out_folder
from benchmarks.lib.options import Count, FanOutOptions, Names, Repeated, options
from benchmarks.train.ppo import KEPT, PolicyRequest

AgentNames = Annotated[
    Names, Parameter(help=f"Controllers to run, out of {', '.join(ROSTER)}.")
]


@options
@dataclass(frozen=True, kw_only=True)
class ControllerOptions:
    """Controllers of one's own, and how those that learn are trained."""

    agent: Repeated = ()
    """A controller of your own beside those of --agents, NAME=MODULE:FACTORY or
    NAME=PPO:FILE.zip; the same name again is another training of it (repeatable)."""
    training_steps: Count | None = None
    """Train each policy of PPO with so many samples of experience (default: take those that
    come with the project)."""
    policies: Count | None = None
    """How many policies of PPO to run, each from a seed of its own (default: 5)."""
    kept: Path = KEPT
    """Where policies that are trained here are kept; no code in its files is run."""
    fan_out: FanOutOptions = field(default_factory=FanOutOptions)
    retrain: bool = False
    """Train policies of PPO anew, which takes many minutes."""

    def training(self) -> PolicyRequest:
        """Return which trained policies are asked for, if their folder can be written to."""
        is_folder = self.kept.is_dir() or not self.kept.exists()
        if self.retrain or self.training_steps or self.policies or not is_folder:
            out_folder(self.kept, "--kept")
        return PolicyRequest(
            self.fan_out.open(), self.kept, self.training_steps, self.policies, self.retrain
        )


def chosen(names: Sequence[str], own: Sequence[str] = ()) -> dict[str, RosterEntry]:
    """Return controllers of the roster by name, then a user's own, as `--agent` has them.

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
