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
CODE_SUFFIXES = {".py", ".npz", ".json"}  # with trained networks and the bounds of the package
PACKAGES = "gymnasium", "numpy", "optuna", "scipy", "stable_baselines3", "torch"

# The command line of the command that runs, as a user can type it; "" if no command runs.
COMMAND_LINE: ContextVar[str] = ContextVar("COMMAND_LINE", default="")


def origin() -> dict[str, Any]:
    """Return the provenance of results that are computed now, JSON-serialisable."""
    return {
        "started": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "command": COMMAND_LINE.get(),
        "versions": versions(),
        "commit": commit(),
        "code": code_hash(),
    }


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that affect a result."""
    import mptc_gym  # imported here, as Gymnasium is slow to import

    installed = {"python": platform.python_version(), "mptc_gym": mptc_gym.__version__}
    for package in PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            installed[package] = metadata.version(package)
    return installed


@cache
def commit() -> str:
    """Return the commit of the checkout, with "-dirty" after it if files differ from it.

    The result is "" without git, and if the checkout is not a repository.
    """
    if not (ROOT / ".git").exists():  # git would look for a repository around it.
        return ""
    command = ["git", "status", "--porcelain=v2", "--branch"]
    try:
        status = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return ""
    lines = status.stdout.splitlines()
    identifier = lines[0].split()[-1]  # of "# branch.oid COMMIT"
    is_clean = all(line.startswith("#") for line in lines)  # The other lines name files.
    return identifier if is_clean else f"{identifier}-dirty"


@cache
def code_hash() -> str:
    """Return a SHA-256 hash of the checkout's source files, trained networks and bounds."""
    digest = hashlib.sha256()
    for folder in CODE_FOLDERS:
        for path in sorted((ROOT / folder).rglob("*")):
            if path.suffix in CODE_SUFFIXES and "published" not in path.parts:
                content = hashlib.sha256(path.read_bytes()).hexdigest()
                digest.update(f"{path.relative_to(ROOT).as_posix()} {content}\n".encode())
    return digest.hexdigest()
