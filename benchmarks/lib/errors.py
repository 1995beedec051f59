"""Define the exceptions of the benchmarks, and end a command with a message."""

import sys
from typing import NoReturn

# The extra of this project, as in `pip install -e ".[EXTRA]"`, that installs each package.
EXTRAS = {
    "cyclopts": "compare",
    "filelock": "compare",
    "h5py": "data",
    "joblib": "compare",
    "matplotlib": "compare",
    "minari": "data",
    "optuna": "bench",
    "pandas": "compare",
    "ray": "ray",
    "rich": "compare",
    "scipy": "compare",
    "stable_baselines3": "bench",
    "tabulate": "compare",
    "torch": "torch",
}


class UsageError(ValueError):
    """A command cannot run as the user typed it, for example because a name is unknown.

    A command that raises a `UsageError` ends with exit status 2.
    """


class UnfinishedError(RuntimeError):
    """A command could not do all of its work.

    A command that raises an `UnfinishedError` ends with exit status 1.
    """


class NoBoundError(ValueError):
    """A case has no least possible error of the requested kind.

    For example, a least possible error of the kind "reference" exists only if the plant settles
    before each change of the set point.
    """


def stop(program: str, error: UsageError | ImportError) -> NoReturn:
    """Print the message of `error` without a traceback, and exit with status 2.

    The printed message begins with the command `program`. If a package from an extra of this
    project is not installed, the message names the extra. An ImportError for any other package
    is a bug, and is raised again.
    """
    message = str(error)
    cause = error.__cause__ or error
    package = ""
    if isinstance(cause, ImportError):
        package = str(cause.name).partition(".")[0]
    if package in EXTRAS:
        extra = EXTRAS[package]
        message = f'{package} is not installed: pip install -e ".[{extra}]" ({cause})'
    elif isinstance(error, ImportError):
        raise error
    print(f"{program}: error: {message}", file=sys.stderr)
    raise SystemExit(2) from error
