"""Declare and run the commands `python -m benchmarks.NAME`.

A command is one file, `benchmarks/NAME.py`, or a folder with a `__main__.py`, in which stand

- a dataclass of options, decorated by `options`: its docstring is the head of the help, and the
  string under a field is the help of that option. A field of another such dataclass, such as
  `FanOut`, adds the options of that one;
- a function `work` of these options, which prints what it finds and returns the closing line.
  What is slow to import, it imports itself, so that the help takes no time;
- `main = command("NAME", Options, work)`, and at the end
  `if __name__ == "__main__": raise SystemExit(main())`.
"""

from __future__ import annotations

import errno
import importlib
import inspect
import math
import os
import re
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, NoReturn, TypeVar

from benchmarks.lib.storage import UnfinishedError, UsageError

EXTRAS = {
    "compare": "cyclopts joblib markdown matplotlib pandas rich scipy tabulate",
    "render": "pygame",
    "data": "h5py minari",
    "bench": "optuna PIL stable_baselines3",
    "ray": "ray",
    "torch": "torch",
}
FULL = errno.ENOSPC, errno.EDQUOT, errno.EPIPE  # a disk, or a reader that has gone
_HEARD: list[int] = []  # signals that interrupt the command


def stop(error: BaseException, program: str = "python -m benchmarks") -> NoReturn:
    """Print an error in a sentence and end the program with status 2.

    If a package is missing, the sentence names the extra that installs it. An import that fails
    for another reason is a bug, and is raised.
    """
    cause, said = error, str(error)
    while cause.__cause__ is not None:
        cause = cause.__cause__
    name = (cause.name or "").partition(".")[0] if isinstance(cause, ImportError) else ""
    for extra, packages in EXTRAS.items():
        if name in packages.split():
            said = f'{name} is not installed: pip install -e ".[{extra}]" ({cause})'
            break
    else:
        if isinstance(error, ImportError):
            raise error
    print(f"{program}: error: {said}", file=sys.stderr)
    raise SystemExit(2) from error


try:
    from cyclopts import App, CycloptsError, MissingArgumentError, Parameter
    from cyclopts.validators import Number
except ImportError as _missing:
    stop(_missing)

Group = TypeVar("Group")

# Decorates a dataclass whose fields are options, also when it is nested in another dataclass.
options: Callable[[type[Group]], type[Group]] = Parameter(name="*")


def _integer(_type: object, tokens: Sequence[Any]) -> int:
    """Read an integer, and reject 2.5, which cyclopts would round."""
    try:
        return int(tokens[0].value)
    except ValueError as error:
        raise ValueError(f"must be a whole number, got {tokens[0].value!r}") from error


def _folder(_type: object, tokens: Sequence[Any]) -> Path:
    """Read a folder, and reject "", which would be the current one."""
    if not tokens[0].value:
        raise ValueError("must name a folder, got ''")
    return Path(tokens[0].value)


def _integers(least: int, most: int) -> Parameter:
    return Parameter(converter=_integer, n_tokens=1, validator=Number(gte=least, lte=most))


Count = Annotated[int, _integers(1, 1_000_000_000)]
Runs = Annotated[int, _integers(1, 100_000)]
Seed = Annotated[int, _integers(0, 2**63)]
Finite = Annotated[float, Parameter(validator=Number(gt=-math.inf, lt=math.inf))]
Names = Annotated[tuple[str, ...], Parameter(consume_multiple=True)]
Repeated = tuple[str, ...]
Folder = Annotated[Path, Parameter(help="Folder to write to.", converter=_folder, n_tokens=1)]


@contextmanager
def blame(option: str) -> Iterator[None]:
    """Turn a ValueError into a `UsageError` that names the option."""
    try:
        yield
    except UsageError:
        raise
    except ValueError as error:
        raise UsageError(f"{option}: {error}") from error


def known(option: str, given: Sequence[str], names: Collection[str]) -> list[str]:
    """Return the names that an option lists, each once; `UsageError` if one is not known."""
    for name in given:
        if name not in names:
            raise UsageError(f"{option}: no {name!r}; there are {', '.join(names)}")
    return list(dict.fromkeys(given))


def _typed(default: object) -> str | None:
    """Return a default as a user would type it; None if it is not worth showing."""
    if default is None or default is False or default == ():
        return None
    return " ".join(map(str, default)) if isinstance(default, tuple) else str(default)


def read(declared: type[Group], program: str, given: Sequence[str]) -> Group | None:
    """Read a program's command line into a dataclass of options.

    With --help, the help is printed and None is returned. An invalid option raises
    `UsageError`.
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
        text = re.sub(
            r"^Invalid value for (\S+): must", r"\1 must", " ".join(str(error).split())
        )
        if isinstance(error, MissingArgumentError) and error.argument:
            choices = ", ".join(error.argument.get_choices() or ())
            text = f"{error.argument.names[0].lstrip('-').upper()} is missing"
            text += f": one of {choices}" if choices else "; --help says what it is"
        raise UsageError(text) from error
    return found if isinstance(found, declared) else None


def command(
    name: str,
    declared: type[Group],
    work: Callable[[Group], str],
    interrupted: str = "what has finished is written.",
) -> Callable[..., int]:
    """Return the `main` of the command `python -m benchmarks.NAME`.

    It takes the command line without the program's name, by default that of the process, and
    returns the exit status: 0 for success; 1 if tasks failed, a file could not be written or
    memory ran out; 130 after Ctrl-C and 143 after SIGTERM, with the message `interrupted`. An
    invalid option or a missing package ends the program with 2.
    """
    program = f"python -m benchmarks.{name}"

    def main(arguments: Sequence[str] | None = None) -> int:
        if work.__module__ == "__main__" and (spec := sys.modules["__main__"].__spec__):
            # Other processes find tasks by the name of a module to be imported.
            return int(importlib.import_module(spec.name).main())
        os.environ["MPLBACKEND"] = "agg"  # figures go to files, whatever the shell has set
        for stream in (sys.stdout, sys.stderr):
            if hasattr(stream, "reconfigure"):
                stream.reconfigure(errors="replace")  # for "°C" on an ASCII terminal
        with _heard(to_the_end=arguments is None):
            try:
                given = sys.argv[1:] if arguments is None else arguments
                if (chosen := read(declared, program, given)) is not None:
                    print(work(chosen), flush=True)
            except KeyboardInterrupt as stopped:
                print(f"\nInterrupted: {interrupted}", flush=True)
                return 128 + (stopped.args[0] if stopped.args else signal.SIGINT)
            except (UnfinishedError, MemoryError) as error:
                print(str(error) or "There is not enough memory for so many runs or samples.")
                return 1
            except (UsageError, ImportError) as error:
                stop(error, program)
            except OSError as error:
                return cut_off(error, program)
        return 0

    return main


def cut_off(error: OSError, program: str) -> int:
    """Say that the output cannot be written, and return 1; other errors are raised."""
    if error.errno not in FULL:
        raise error
    print(f"{program}: the output is cut off: {error.strerror}", file=sys.stderr)
    sys.stdout = open(os.devnull, "w")  # noqa: PTH123, SIM115 (what is left is flushed at exit)
    return 1


@contextmanager
def _heard(*, to_the_end: bool) -> Iterator[None]:
    """Raise KeyboardInterrupt for SIGTERM, and for Ctrl-C unless the shell has it ignored.

    At the end, the signals are ignored if the process ends: nothing is left to be interrupted.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    _HEARD[:] = [number for number in before if before[number] is not signal.SIG_IGN]
    listen()
    try:
        yield
    finally:
        _HEARD.clear()
        for number, handler in before.items():
            signal.signal(number, signal.SIG_IGN if to_the_end else handler)


def listen() -> None:
    """Let the signals interrupt again, after one has."""
    for number in _HEARD:
        signal.signal(number, _interrupt)


def _interrupt(number: int, _frame: object) -> NoReturn:
    for each in _HEARD:  # while joblib ends its processes, of which its threads may complain
        signal.signal(each, signal.SIG_IGN)
    threading.excepthook = lambda _: None
    warnings.simplefilter("ignore")
    raise KeyboardInterrupt(number)
