"""Return the provenance of results: the command line, the code and the versions of packages."""

import hashlib
import platform
import subprocess
from contextlib import suppress
from contextvars import ContextVar
from datetime import datetime, timezone
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]  # the checkout
CODE_FOLDERS = "mptc_gym", "agents", "benchmarks"
# Source files, trained networks (.npz) and the error bounds of the package (.json).
CODE_SUFFIXES = {".py", ".npz", ".json"}
# Packages whose versions may change a result.
PACKAGES = "gymnasium", "numpy", "optuna", "scipy", "stable_baselines3", "torch"

# The command line that this process executes, such as "python -m benchmarks.compare"; "" if a
# function was called from Python.
COMMAND_LINE: ContextVar[str] = ContextVar("COMMAND_LINE", default="")


def origin() -> dict[str, Any]:
    """Return the provenance of results that are computed now, as a dict that JSON can store.

    The keys of the dict are "started" (the present time, UTC, ISO 8601), "command" (the command
    line), "versions" (of packages), "commit" (of git) and "code" (a hash of the source files).
    """
    return {
        "started": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "command": COMMAND_LINE.get(),
        "versions": versions(),
        "commit": commit(),
        "code": code_hash(),
    }


def versions() -> dict[str, str]:
    """Return the versions of Python, mptc_gym and the installed `PACKAGES`, by name."""
    import mptc_gym  # imported here, as Gymnasium is slow to import

    installed = {"python": platform.python_version(), "mptc_gym": mptc_gym.__version__}
    for package in PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            installed[package] = metadata.version(package)
    return installed


@cache
def commit() -> str:
    """Return the hash of the git commit that is checked out, 40 hexadecimal digits.

    If files have changed or have been added since the commit, the text "-dirty" follows the
    hash of the commit. If git is not installed or the project is not in a git repository, the
    result is "".
    """
    if not (ROOT / ".git").exists():  # git would search the parent folders.
        return ""
    command = ["git", "status", "--porcelain=v2", "--branch"]
    try:
        status = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return ""
    lines = status.stdout.splitlines()
    identifier = lines[0].split()[-1]  # of "# branch.oid COMMIT"
    is_clean = all(line.startswith("#") for line in lines)  # Other lines name changed files.
    return identifier if is_clean else f"{identifier}-dirty"


@cache
def code_hash() -> str:
    """Return a SHA-256 hash of the files in `CODE_FOLDERS` with a suffix in `CODE_SUFFIXES`.

    The hash leaves out folders called "published", which contain results and no code.
    """
    digest = hashlib.sha256()
    for folder in CODE_FOLDERS:
        for path in sorted((ROOT / folder).rglob("*")):
            if path.suffix in CODE_SUFFIXES and "published" not in path.parts:
                content = hashlib.sha256(path.read_bytes()).hexdigest()
                digest.update(f"{path.relative_to(ROOT).as_posix()} {content}\n".encode())
    return digest.hexdigest()
