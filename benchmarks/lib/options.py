"""Read command lines into dataclasses: types of options, and groups that commands share."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from cyclopts import App, CycloptsError, Parameter, Token
from cyclopts.help import DefaultFormatter, HelpPanel

from benchmarks.lib.command_line import UsageError, blame
from benchmarks.lib.fan_out import FanOut
from benchmarks.lib.storage import ROOT

Group = TypeVar("Group")

# A dataclass whose fields are options, also of a dataclass that holds it.
options: Callable[[type[Group]], type[Group]] = Parameter(name="*")


def _typed(default: object) -> str | None:
    """Return a default as one would type it; None for one that tells nothing."""
    if isinstance(default, tuple):
        default = " ".join(map(str, default))
    elif isinstance(default, Path) and default.is_relative_to(ROOT):
        default = default.relative_to(ROOT)
    return None if default is None or default is False or default == "" else str(default)


def flat(group: Any) -> dict[str, Any]:
    """Return the options of a group and of the groups in it, as JSON can hold them."""
    found: dict[str, Any] = {}
    for each in fields(group):
        value = getattr(group, each.name)
        if is_dataclass(value):
            found |= flat(value)
        else:
            found[each.name] = str(value) if isinstance(value, Path) else value
    return found


def _latest(_type: object, tokens: Sequence[Token]) -> tuple[str, ...]:
    """Return the values of an option that is given more than once: those of the last time."""
    texts: list[str] = []
    for token in tokens:
        begins = token.keyword is not None and token.index == 0
        texts = [token.value] if begins else [*texts, token.value]
    return tuple(text for text in texts if text)


def reads(
    kind: Callable[[str], Any],
    what: str,
    least: float,
    most: float = math.inf,
    *,
    many: int = 0,
) -> Parameter:
    """Return how to read a number within limits, or `many` of them.

    `kind` makes a number of a text; `what` names what it must be in messages.
    """

    def convert(text: str) -> Any:
        try:
            value = kind(text)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and value >= least):
            raise ValueError(f"must be {what}, got {text!r}")
        if value > most:
            raise ValueError(f"must be at most {most:,}, got {text!r}")
        return value

    if not many:
        return Parameter(converter=lambda _, tokens: convert(tokens[0].value), n_tokens=1)
    return Parameter(
        converter=lambda _, tokens: tuple(map(convert, _latest(_, tokens))), n_tokens=many
    )


def choice(names: Collection[str], text: str) -> Parameter:
    """Return how to read one of the names that a help text lists."""
    listed = ", ".join(names)

    def convert(_: object, tokens: Sequence[Token]) -> str:
        if tokens[0].value not in names:
            raise ValueError(f"no {tokens[0].value!r}; there are {listed}")
        return tokens[0].value

    return Parameter(converter=convert, n_tokens=1, help=f"{text}: {listed}.")


Count = Annotated[int, reads(int, "an integer of at least 1", 1, 1_000_000_000)]
Runs = Annotated[int, reads(int, "an integer of at least 1", 1, 100_000)]
Seed = Annotated[int, reads(int, "an integer of at least 0", 0, 2**63)]
Finite = Annotated[float, reads(float, "a finite number", -math.inf)]
Positive = Annotated[float, reads(float, "a number above 0", math.nextafter(0.0, 1.0))]
Orders = Annotated[
    tuple[int, int, int], reads(int, "an integer of at least 0", 0, 1000, many=3)
]
Names = Annotated[tuple[str, ...], Parameter(converter=_latest, consume_multiple=True)]
Repeated = tuple[str, ...]
Folder = Annotated[Path, Parameter(help="Folder to write to.")]


@options
@dataclass(frozen=True, kw_only=True)
class FanOutOptions:
    """Where independent tasks run, and how many at once."""

    jobs: Count | None = None
    """How many tasks run at once (default: as many as there are cores)."""
    backend: Literal["loky", "ray"] = "loky"
    """Where tasks run: loky, on this machine; ray, on a Ray cluster."""

    def open(self) -> FanOut:
        """Return the fan-out that is asked for."""
        with blame("--backend"):
            return FanOut(self.jobs, self.backend)


class _Help(DefaultFormatter):
    """Shows help texts as paragraphs, however they are broken into lines in the code."""

    def __call__(self, console: Any, options: Any, panel: HelpPanel) -> None:
        for entry in panel.entries:
            text = entry.description.primary_renderable
            text.plain = " ".join(text.plain.split())
        super().__call__(console, options, panel)


def read(declared: type[Group], program: str, given: Sequence[str]) -> Group | None:
    """Read what was given to a program into a dataclass of options.

    The docstring of the dataclass is the description in the help. If that was asked for, it is
    printed, and None comes back. An option that does not fit is a `UsageError`.
    """
    paragraphs = (inspect.getdoc(declared) or "").split("\n\n")
    app = App(
        name=program,
        help="\n\n".join(" ".join(each.split()) for each in paragraphs),
        help_format="plaintext",
        help_formatter=_Help(),
        version_flags=[],
        default_parameter=Parameter(negative=(), allow_repeating=True, show_default=_typed),
        result_action="return_value",
    )
    app["--help"].show = False

    def main(options: Any) -> Any:
        return options

    main.__annotations__["options"] = declared
    with suppress(TypeError):  # if there is one that must be given
        main.__defaults__ = (declared(),)
    app.default(main)
    try:
        found = app(list(given), exit_on_error=False, print_error=False)
    except CycloptsError as error:
        name = error.argument.name if error.argument else ""
        text = " ".join(str(error).split()).removeprefix("Invalid value for ")
        raise UsageError(text if name in text else f"{name}: {text}") from error
    return found if isinstance(found, declared) else None
