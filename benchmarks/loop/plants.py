"""Choose the plant of a command: from a file, a preset or single arguments."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from benchmarks.lib.command import Repeated, UsageError, blame, options
from mptc_gym import PRESETS, Parameters
from mptc_gym.parameters import slowest_pole


@dataclass(frozen=True)
class ChosenPlant:
    """The plant that the user chose."""

    name: str
    """Short description of the choice; "the paper's plant" by default."""
    arguments: dict[str, Any]
    """Arguments of the environment that differ from the defaults."""


@options
@dataclass(frozen=True, kw_only=True)
class PlantOptions:
    """Options that choose the plant: from a file, a preset or single arguments."""

    plant: Path | None = None
    """JSON file with arguments of the environment, such as the plant.json that
    benchmarks.identify writes."""
    preset: Annotated[str | None, Parameter(choices=PRESETS)] = None
    """A plant that comes with the environment."""
    set: Repeated = ()
    """An argument of the environment, such as delay=30 or delay=[12,24] (repeatable;
    overrides --plant, which overrides --preset)."""

    def chosen(self) -> ChosenPlant:
        """Return the chosen plant; `UsageError` if an option is invalid."""
        names: list[str] = []
        arguments: dict[str, Any] = {}
        if self.preset:
            names.append(self.preset)
            arguments |= PRESETS[self.preset]
        if self.plant:
            names.append(self.plant.stem)
            with blame("--plant"):
                arguments |= _read(self.plant)
        for text in self.set:
            name, equals, value = text.partition("=")
            if not (name and equals):
                raise UsageError(f"--set must be ARGUMENT=VALUE, got {text!r}")
            names.append(text)
            try:
                arguments[name] = json.loads(value)
            except (ValueError, RecursionError):
                arguments[name] = value  # a bare word, such as random
        given = [f"--{name}" for name in ("plant", "preset", "set") if getattr(self, name)]
        try:
            parameters = Parameters.of_environment(arguments)
            if abs(slowest_pole(parameters.a) or 0.0) > 1.0:
                raise ValueError(
                    "a must not have a root beyond the unit circle, as nothing holds such a "
                    f"plant, got {list(parameters.a)}"
                )
        except (TypeError, ValueError) as error:
            raise UsageError(f"{', '.join(given)}: {error}") from error
        return ChosenPlant(", ".join(names) or "the paper's plant", arguments)


def _read(path: Path) -> dict[str, Any]:
    """Return the arguments in a JSON file such as `plant.json`."""
    try:
        arguments = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:  # not JSON, not text, or too deep
        raise ValueError(f"{path} must be a JSON file: {error}") from error
    if not isinstance(arguments, dict):
        raise ValueError(
            f"{path} must hold one object of arguments, such as "
            f'{{"delay": 20}}, got {type(arguments).__name__}'
        )
    return arguments
