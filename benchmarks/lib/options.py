"""Read command lines into dataclasses, with types and groups of options for all commands."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from cyclopts import App, CycloptsError, Parameter, Token
from cyclopts.validators import Number

from benchmarks.lib.command_line import UsageError, blame
from benchmarks.lib.fan_out import FanOut
from benchmarks.lib.storage import ROOT

Group = TypeVar("Group")

# Decorates a dataclass whose fields are options, also when it is nested in another dataclass.
options: Callable[[type[Group]], type[Group]] = Parameter(name="*")


def _typed(default: object) -> str | None:
    """Return a default as a user would type it; None if it is not worth showing."""
    if isinstance(default, tuple):
        default = " ".join(map(str, default))
    elif isinstance(default, Path) and default.is_relative_to(ROOT):
        default = default.relative_to(ROOT)
    return None if default is None or default is False or default == "" else str(default)


def flat(group: Any) -> dict[str, Any]:
    """Return the options of a group and its nested groups, as JSON values."""
    found: dict[str, Any] = {}
    for name, value in vars(group).items():
        if is_dataclass(value):
            found |= flat(value)
        else:
            found[name] = str(value) if isinstance(value, Path) else value
    return found


def _latest(_type: object, tokens: Sequence[Token]) -> tuple[str, ...]:
    """Return the names of the last occurrence of an option, which overrides earlier ones."""
    begins = [i for i, token in enumerate(tokens) if token.keyword and token.index == 0]
    return tuple(token.value for token in tokens[max(begins, default=0) :] if token.value)


def _integers(_type: object, tokens: Sequence[Token]) -> Any:
    """Read integers, and reject 2.5, which cyclopts would round."""
    try:
        found = [int(token.value) for token in tokens]
    except ValueError as error:
        given = " ".join(token.value for token in tokens)
        raise ValueError(f"must be an integer, got {given!r}") from error
    return tuple(found) if len(found) > 1 else found[0]


def integer(least: int, most: int, *, many: int = 1) -> Parameter:
    """Return a parameter for an integer within limits, or for `many` of them."""
    limits = Number(gte=least, lte=most)
    return Parameter(converter=_integers, validator=limits, n_tokens=many)


def choice(names: Collection[str], text: str) -> Parameter:
    """Return a parameter for one of `names`, which its help text lists."""
    listed = ", ".join(names)

    def convert(_: object, tokens: Sequence[Token]) -> str:
        if tokens[0].value not in names:
            raise ValueError(f"no {tokens[0].value!r}; there are {listed}")
        return tokens[0].value

    return Parameter(converter=convert, n_tokens=1, help=f"{text}: {listed}.")


Count = Annotated[int, integer(1, 1_000_000_000)]
Runs = Annotated[int, integer(1, 100_000)]
Seed = Annotated[int, integer(0, 2**63)]
Finite = Annotated[float, Parameter(validator=Number(gt=-math.inf, lt=math.inf))]
Positive = Annotated[float, Parameter(validator=Number(gt=0.0, lt=math.inf))]
Names = Annotated[tuple[str, ...], Parameter(converter=_latest, consume_multiple=True)]
Repeated = tuple[str, ...]
Folder = Annotated[Path, Parameter(help="Folder to write to.")]


@options
@dataclass(frozen=True, kw_only=True)
class FanOutOptions:
    """Options for running independent tasks in parallel."""

    jobs: Count | None = None
    """Number of tasks run at once (default: one per core)."""
    backend: Literal["loky", "ray"] = "loky"
    """Where tasks run: loky for this machine, ray for a Ray cluster."""

    def open(self) -> FanOut:
        """Return the fan-out with these options."""
        with blame("--backend"):
            return FanOut(self.jobs, self.backend)


def read(declared: type[Group], program: str, given: Sequence[str]) -> Group | None:
    """Read a program's command line into a dataclass of options.

    The docstring of the dataclass is the description in the help. With --help, the help is
    printed and None is returned. An invalid option raises `UsageError`.
    """
    app = App(
        name=program,
        help=inspect.getdoc(declared),
        version_flags=[],
        default_parameter=Parameter(negative=(), allow_repeating=True, show_default=_typed),
        result_action="return_value",
    )
    app["--help"].show = False
    app.default(declared)
    try:
        found = app(list(given), exit_on_error=False, print_error=False)
    except CycloptsError as error:
        name = error.argument.name if error.argument else ""
        text = " ".join(str(error).split()).removeprefix("Invalid value for ")
        raise UsageError(text if name in text else f"{name}: {text}") from error
    return found if isinstance(found, declared) else None
