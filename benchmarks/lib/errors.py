"""Define the errors whose message a command prints without a traceback, and print a message."""

import sys
from typing import NoReturn

# The extra of this project, as in `pip install -e ".[EXTRA]"`, that installs each package.
EXTRAS = {
    "PIL": "bench",
    "cyclopts": "compare",
    "filelock": "compare",
    "h5py": "data",
    "joblib": "compare",
    "matplotlib": "compare",
    "minari": "data",
    "optuna": "bench",
    "pandas": "compare",
    "pygame": "bench",
    "ray": "ray",
    "rich": "compare",
    "scipy": "compare",
    "stable_baselines3": "bench",
    "tabulate": "compare",
    "torch": "torch",
}


class UsageError(ValueError):
    """A user has given a command something invalid, such as an unknown name in an option.

    The message tells the user what is invalid and why. A command that raises a `UsageError`
    ends with exit status 2.
    """


class UnfinishedError(RuntimeError):
    """A command could not do all of its work.

    The message tells the user what is missing. A command that raises an `UnfinishedError` ends
    with exit status 1.
    """


class NoBoundError(ValueError):
    """A scenario has no lower bound on the error, or no bound of the kind that was asked for.

    For example, the bound of the kind "reference" exists only if the plant settles before each
    change of the set point.
    """


def stop(program: str, error: UsageError | ImportError) -> NoReturn:
    """Print the message of an error without a traceback, and exit with status 2.

    If a package of `EXTRAS` is not installed, the message names the extra that installs the
    package. Any other ImportError is a bug in the code, and is raised again.

    Parameters
    ----------
    program
        The command, such as "python -m benchmarks.compare", with which the message begins.
    error
        The error, which an ImportError may have caused.
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
