"""Write the results of a command to a new folder, with their provenance."""

import json
import platform
import subprocess
from collections.abc import Mapping
from contextlib import suppress
from datetime import datetime, timezone
from importlib import metadata
from itertools import count
from pathlib import Path
from typing import Any

from benchmarks.lib.command import COMMAND_LINE, CommandError

ROOT = Path(__file__).resolve().parents[2]  # the checkout
PROVENANCE_FILE = "provenance.json"
# Packages whose versions may change a result.
PACKAGES = "gymnasium", "numpy", "optuna", "scipy", "stable_baselines3", "torch"


def new_folder(
    chosen: Path | None, name: str, provenance: Mapping[str, Any], *, goes_on: bool = False
) -> Path:
    """Create a folder for the results of a command, and write `provenance` to it.

    Two runs of a command at the same time get two folders, since the folder is created, and the
    file with the provenance is written, before the results are computed.

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
        folder.mkdir(parents=True, exist_ok=True)
        is_continued = goes_on and (folder / PROVENANCE_FILE).exists()
        if any(folder.iterdir()) and not is_continued:
            raise CommandError(f"--out must be a new or empty folder, got {folder} with files")
    if not goes_on:
        (folder / PROVENANCE_FILE).touch(exist_ok=False)  # Another run may have chosen it, too.
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

    The keys of the dict are "command" (the command line), "started" (the present time, UTC, ISO
    8601), "commit" (of git), "versions" (of packages), and the names in `details`, such as
    "seeds".
    """
    return {
        "command": COMMAND_LINE.get(),
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
    if not (ROOT / ".git").exists():  # git would search the parent folders.
        return "unknown"
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    with suppress(OSError):
        run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
        return run.stdout.strip() or "unknown"
    return "unknown"


def write_json(path: Path, value: Any) -> None:
    """Write `value` to the JSON file `path`, with `str(x)` for objects x unknown to JSON."""
    write_text(path, json.dumps(value, indent=2, default=str) + "\n")


def write_csv(path: Path, table: Any) -> None:
    """Write `table`, a DataFrame of pandas, to the CSV file `path`, without the row index."""
    table.to_csv(path, index=False, lineterminator="\n")


def write_text(path: Path, text: str) -> None:
    """Write `text` to the file `path`, in UTF-8 and with the line ends of Unix."""
    path.write_text(text, encoding="utf-8", newline="\n")
