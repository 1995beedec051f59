"""Run the commands `python -m benchmarks.NAME`, and end them with a sentence and a status.

Only the standard library is imported before `main` is called, so that Ctrl-C and a missing
package are answered in a sentence, too.
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
    "render": "moviepy pygame",
    "data": "h5py minari",
    "bench": "optuna PIL stable_baselines3",
    "ray": "ray",
    "test": "tclab",
    "torch": "torch",
}


def command(
    name: str, *, width: int = 120, interrupted: str = "what has finished is kept."
) -> Callable[[Sequence[str] | None], int]:
    """Return the `main` of `python -m benchmarks.<name>`.

    Its package has two modules: `options`, with a dataclass `Options`, whose docstring is the
    description in the help; and `command`, which is imported after the options were read. Its
    function `execute` is called with the options and a `rich` console, does the work and
    returns the closing line.

    The main function takes the command line without the program's name and returns the exit
    status: 0; 1 if tasks failed or a file could not be written; 130 after Ctrl-C. An option
    that does not fit, or a package that is missing, ends the program with status 2.

    Parameters
    ----------
    name
        Of the command.
    width
        Columns of the console where nothing says how wide it is.
    interrupted
        What the user is told after Ctrl-C.
    """

    def main(arguments: Sequence[str] | None = None) -> int:
        os.environ["MPLBACKEND"] = "agg"  # pictures go to files, whatever the user's shell says
        for stream in (sys.stdout, sys.stderr):
            if hasattr(stream, "reconfigure"):
                stream.reconfigure(errors="replace")  # "°C" where there is ASCII alone
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
    """Return the message of an error, with the extra that has what could not be imported."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, ImportError):
        cause = cause.__cause__
    if cause is not None:
        words = set(re.findall(r"\w+", f"{cause.name} {cause}"))
        for extra, modules in EXTRAS.items():
            for module in words.intersection(modules.split()):
                return f'{module} is not installed: pip install -e ".[{extra}]" ({cause})'
        if cause is error:
            raise error  # a fault of ours
    return str(error)
