"""Declare and read the options that choose the controllers to run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from benchmarks.controllers.own import own_entry
from benchmarks.controllers.records import RosterEntry
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command import (
    Count,
    Names,
    Repeated,
    UsageError,
    known,
    options,
    out_folder,
)
from benchmarks.lib.fan_out import FanOut
from benchmarks.train.ppo import KEPT, PolicyRequest

AgentNames = Annotated[
    Names, Parameter(help=f"Controllers to run, out of {', '.join(ROSTER)}.")
]


@options
@dataclass(frozen=True, kw_only=True)
class ControllerOptions:
    """A user's own controllers, and how PPO policies are trained."""

    agent: Repeated = ()
    """A controller of your own in addition to those of --agents, NAME=MODULE:FACTORY or
    NAME=PPO:FILE.zip, of mptc_gym.sb3.save; loading a zip runs the code in it. The same name
    again adds another training of it (repeatable)."""
    training_steps: Count | None = None
    """Samples of experience to train each PPO policy with (default: use the policies that come
    with the project)."""
    policies: Count | None = None
    """Number of PPO policies to run, each from its own seed (default: 5)."""
    kept: Path = KEPT
    """Folder of locally trained policies; no code in its files is executed."""
    fan_out: FanOut = field(default_factory=FanOut)
    retrain: bool = False
    """Train PPO policies again, which takes many minutes."""

    def training(self) -> PolicyRequest:
        """Return the request for trained policies; if any may be saved, check the folder."""
        is_folder = self.kept.is_dir() or not self.kept.exists()
        if self.retrain or self.training_steps or self.policies or not is_folder:
            out_folder(self.kept, "--kept")
        return PolicyRequest(
            self.fan_out, self.kept, self.training_steps, self.policies, self.retrain
        )


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
