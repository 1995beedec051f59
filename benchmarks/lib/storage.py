"""Write files completely or not at all, and record the provenance of results."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import Any

PACKAGES = ("gymnasium", "numpy", "stable_baselines3", "torch")
ROOT = Path(__file__).parent.parent.parent  # the checkout
WAITS = (0.01, 0.05, 0.2, 0.5)  # s between attempts to put a file in place


class NotWrittenError(RuntimeError):
    """A file could not be written; the message gives its name and the reason."""


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path to write to, and move the file to `path` at the end.

    `path` is left as it was if there is an error or the process is killed.
    """
    # The suffix stays last, since some writers choose the format by it or append it.
    partial = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield partial
            _move(partial, path)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        reason = error.strerror or error
        raise NotWrittenError(f"{path} could not be written: {reason}") from error


def _move(partial: Path, path: Path) -> None:
    """Replace a file, with retries: Windows refuses while it is open elsewhere."""
    for wait in WAITS:
        with suppress(PermissionError):
            partial.replace(path)
            return
        time.sleep(wait)
    partial.replace(path)


def write_text(path: Path, text: str) -> None:
    """Write a text file, completely or not at all."""
    with replacing(path) as partial:
        # The same line ends, and so the same bytes, on Windows as elsewhere.
        partial.write_text(text, encoding="utf-8", newline="\n")


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file, completely or not at all."""
    write_text(path, json.dumps(value, indent=2) + "\n")


def seal(value: Any) -> str:
    """Return a value as JSON with a checksum, by which `unseal` detects damage."""
    checksum = hashlib.sha256(json.dumps(value).encode()).hexdigest()
    return json.dumps({"sha256": checksum, "value": value})


def unseal(text: str) -> Any:
    """Return the value in a text made by `seal`; ValueError if it is damaged."""
    sealed = json.loads(text)
    if not isinstance(sealed, dict) or text != seal(sealed.get("value")):
        raise ValueError("the checksum of a kept result does not fit")
    return sealed["value"]


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that affect a result."""
    import mptc_gym  # here: Gymnasium and NumPy are slow to import

    found = {"python": platform.python_version(), "mptc_gym": mptc_gym.__version__}
    for package in PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            found[package] = metadata.version(package)
    return found


def origin() -> dict[str, Any]:
    """Return the provenance of results made now: time, versions and commit."""
    started = datetime.now(timezone.utc).isoformat(timespec="seconds")
    return {"started": started, "versions": versions(), "commit": commit()}


def commit() -> str:
    """Return the checkout's commit, with "-dirty" if files differ; "unknown" without git."""
    describe = ["git", "describe", "--always", "--abbrev=40", "--dirty", "--exclude=*"]
    try:
        done = subprocess.run(describe, cwd=ROOT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return done.stdout.strip()
