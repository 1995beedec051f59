"""Write files completely or not at all, and record the provenance of results."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime, timezone
from functools import cache
from importlib import metadata
from pathlib import Path
from pickletools import genops
from typing import Any

PACKAGES = ("gymnasium", "numpy", "optuna", "scipy", "stable_baselines3", "torch")
ROOT = Path(__file__).resolve().parent.parent.parent  # the checkout
WAITS = (0.01, 0.05, 0.2, 0.5)  # s between attempts to put a file in place


class UnfinishedError(RuntimeError):
    """A command could not do all of its work; the message says why."""


class NotWrittenError(UnfinishedError):
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
    """Write a JSON file, completely or not at all; paths are written as text."""
    write_text(path, json.dumps(value, indent=2, default=str) + "\n")


def _write(value: Any, file: Path) -> None:
    file.write_text(json.dumps(value), encoding="utf-8", newline="\n")


def _read(file: Path) -> Any:
    return json.loads(file.read_text(encoding="utf-8"))


@dataclass(frozen=True)
class Kept:
    """Results in a folder, each in a file named after all that shapes it; see `key`."""

    folder: Path
    suffix: str = ".json"
    write: Callable[[Any, Path], None] = _write
    """Writes a result. JSON gives floats back to the last digit, and tuples as lists."""
    read: Callable[[Path], Any] = _read
    """Reads it; raises a ValueError or OSError if the file is damaged or missing."""

    def file(self, task: Callable[[], Any]) -> Path | None:
        """Return the file for the result of a task; None for a task without a key."""
        name = key(task)
        return self.folder / f"{name}{self.suffix}" if name else None

    def load(self, task: Callable[[], Any]) -> Any:
        """Return the result of a task; raise a `LookupError` if it is missing or damaged."""
        try:
            return self.read(self.file(task) or self.folder)
        except (ValueError, OSError) as error:
            raise LookupError(str(error)) from error

    def save(self, task: Callable[[], Any], result: Any) -> Any:
        """Write a result, completely or not at all, and return it as it is read."""
        file = self.file(task)
        if file is None:
            return result
        with replacing(file) as partial:
            self.write(result, partial)
        return self.read(file)


def key(*task: Any) -> str | None:
    """Return a hash of everything that shapes the result of a task.

    That is the task, the versions of packages, the code of the checkout, and that of modules
    elsewhere that the task names, such as a user's own controllers. None stands for a task that
    cannot be hashed, such as a lambda.
    """
    import joblib  # here: slow to import
    from joblib.externals.loky.backend.reduction import dumps

    try:
        words = {str(word) for _, word, _ in genops(bytes(dumps(task)))} & {*sys.modules}
        files = (getattr(sys.modules[word], "__file__", None) for word in sorted(words))
        named = [_digest(file) for file in files if file]
        return str(joblib.hash((task, versions(), code(), named)))
    except Exception:  # whatever the pickling of an object raises
        return None


@cache
def _digest(file: str) -> str:
    return hashlib.sha256(Path(file).read_bytes()).hexdigest()


@cache
def code() -> str:
    """Return a hash of the code and the networks of the checkout."""
    packages = (ROOT / name for name in ("agents", "benchmarks", "mptc_gym"))
    files = (file for package in packages for file in package.rglob("*.*"))
    digest = hashlib.sha256()
    for file in sorted(file for file in files if file.suffix in (".py", ".npz")):
        digest.update(file.relative_to(ROOT).as_posix().encode() + file.read_bytes())
    return digest.hexdigest()


@cache
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
