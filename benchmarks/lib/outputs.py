"""Write the results of a command to a new folder, with their provenance."""

import json
import platform
import shlex
import subprocess
import sys
from collections.abc import Mapping
from contextlib import suppress
from datetime import datetime, timezone
from importlib import metadata
from itertools import count
from pathlib import Path
from typing import Any

from benchmarks.lib.command import CommandError

ROOT = Path(__file__).resolve().parents[2]  # the checkout
PROVENANCE_FILE = "provenance.json"
# Packages whose versions may change a result.
PACKAGES = "gymnasium", "numpy", "optuna", "scipy", "stable_baselines3", "torch"


def new_folder(
    chosen: Path | None, name: str, provenance: Mapping[str, Any], *, goes_on: bool = False
) -> Path:
    """Create a folder for the results of a command, and write `provenance` to it.

    A folder of an earlier run keeps the provenance of that run.

    Two runs of a command at the same time get two folders, since a command calls this function
    before it computes its results.

    Parameters
    ----------
    chosen
        Folder that the user has chosen by the option `--out`, which must be new or empty; or
        None for the next free folder of `results/NAME`, `results/NAME-2`, and so on.
    name
        Name of the default folder.
    provenance
        Provenance of the results, as `provenance_of` returns it.
    goes_on
        Whether the chosen folder may also have the results of an earlier run, with which the
        command goes on.

    Raises
    ------
    CommandError
        If the chosen folder has files that the command must not mix with its results.
    """
    if chosen is None:
        folder = _next_free(Path("results"), name)
    else:
        folder = chosen
        is_continued = goes_on and (folder / PROVENANCE_FILE).exists()
        if folder.is_file() or (any(folder.glob("*")) and not is_continued):
            raise CommandError(f"--out must be a new or empty folder, got {folder}")
        if is_continued:
            return folder
        folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / PROVENANCE_FILE, provenance)
    return folder


def _next_free(parent: Path, name: str) -> Path:
    """Create and return the first folder of NAME, NAME-2, NAME-3, ... that does not exist."""
    for number in count(1):
        folder = parent / (name if number == 1 else f"{name}-{number}")
        with suppress(FileExistsError):
            folder.mkdir(parents=True)
            break
    return folder


def provenance_of(**details: Any) -> dict[str, Any]:
    """Return the provenance of results that are computed now, as a dict for JSON.

    The keys of the dict are "command" (the command line of this process), "started" (the
    present time, UTC, ISO 8601), "commit" (of git), "versions" (of packages), and the names in
    `details`, such as "seeds".
    """
    return {
        "command": shlex.join(["python", *sys.orig_argv[1:]]),
        "started": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "commit": commit(),
        "versions": versions(),
        **details,
    }


def versions() -> dict[str, str]:
    """Return the versions of Python, mptc_gym and the installed `PACKAGES`, by name."""
    import mptc_gym  # imported here, as Gymnasium is slow to import

    installed = {"python": platform.python_version(), "mptc_gym": mptc_gym.__version__}
    for package in PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            installed[package] = metadata.version(package)
    return installed


def commit() -> str:
    """Return the hash of the commit that is checked out, with "-dirty" if files have changed.

    The result is "unknown" if git is not installed, or if the project is not in a repository of
    its own.
    """
    # Without --git-dir, git would also search the parent folders for a repository.
    git = ["git", "--git-dir=.git"]
    describe = ["describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    with suppress(OSError):
        run = subprocess.run([*git, *describe], cwd=ROOT, capture_output=True, text=True)
        return run.stdout.strip() or "unknown"
    return "unknown"


def write_json(path: Path, value: Any) -> None:
    """Write `value` to the JSON file `path`, with `str(x)` for objects x unknown to JSON."""
    path.write_text(json.dumps(value, indent=2, default=str) + "\n", encoding="utf-8")
