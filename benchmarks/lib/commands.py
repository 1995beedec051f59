"""Run the commands `python -m benchmarks.NAME`; each ends with a sentence and an exit status.

Only the standard library is imported before `main` is called, so that Ctrl-C and a missing
package also end in a sentence.
"""

from __future__ import annotations

import importlib
import os
import re
import sys
from collections.abc import Callable, Sequence

from benchmarks.lib.command_line import UsageError

EXTRAS = {
    "compare": "cyclopts joblib matplotlib pandas rich scipy tabulate tqdm",
    "render": "pygame",
    "data": "h5py minari",
    "bench": "optuna PIL stable_baselines3",
    "ray": "ray",
    "torch": "torch",
}


def command(
    name: str, *, width: int = 120, interrupted: str = "what has finished is kept."
) -> Callable[[Sequence[str] | None], int]:
    """Return the `main` of `python -m benchmarks.<name>`.

    The command is a package of two modules. `options` has a dataclass `Options`, whose
    docstring is the description in the help. `command` is imported once the options are read;
    its function `execute(options, console)` does the work, prints on the `rich` console and
    returns the closing line.

    `main` takes the command line without the program's name and returns the exit status: 0 for
    success; 1 if tasks failed, a file could not be written or memory ran out; 130 after Ctrl-C.
    An invalid option or a missing package ends the program with status 2.

    Parameters
    ----------
    name
        Name of the command.
    width
        Width of the console, in columns, if the output is not a terminal.
    interrupted
        Message after Ctrl-C.
    """

    def main(arguments: Sequence[str] | None = None) -> int:
        os.environ["MPLBACKEND"] = "agg"  # figures go to files, whatever the shell has set
        for stream in (sys.stdout, sys.stderr):
            if hasattr(stream, "reconfigure"):
                stream.reconfigure(errors="replace")  # for "°C" on an ASCII terminal
        try:
            given = sys.argv[1:] if arguments is None else arguments
            return _main(f"benchmarks.{name}", given, width)
        except KeyboardInterrupt:
            print(f"\nInterrupted: {interrupted}")
            return 130
        except MemoryError:
            print("There is not enough memory for so many runs or samples.", file=sys.stderr)
            return 1
        except (UsageError, ImportError) as error:
            print(f"python -m benchmarks.{name}: error: {sentence(error)}", file=sys.stderr)
            raise SystemExit(2) from error

    return main


def _main(package: str, given: Sequence[str], width: int) -> int:
    declared = importlib.import_module(f"{package}.options").Options
    from benchmarks.lib.options import read

    options = read(declared, f"python -m {package}", given)
    if options is None:
        return 0
    execute = importlib.import_module(f"{package}.command").execute
    from rich.console import Console

    from benchmarks.lib.fan_out import TasksFailedError
    from benchmarks.lib.storage import NotWrittenError

    console = Console(
        width=None if sys.stdout.isatty() else width, highlight=False, markup=False
    )
    try:
        console.print(execute(options, console))
    except (TasksFailedError, NotWrittenError) as error:
        console.print(str(error))
        return 1
    return 0


def sentence(error: BaseException) -> str:
    """Return an error's message or, if a package is missing, the extra that installs it."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, ImportError):
        cause = cause.__cause__
    if cause is not None:
        words = set(re.findall(r"\w+", f"{cause.name} {cause}"))
        for extra, modules in EXTRAS.items():
            for module in words.intersection(modules.split()):
                return f'{module} is not installed: pip install -e ".[{extra}]" ({cause})'
        if cause is error:
            raise error  # a bug, not a missing extra
    return str(error)
