"""Keep the results of one run in one folder, and unfinished results apart from it."""

import hashlib
import json
import shutil
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from benchmarks.lib.errors import UnfinishedError, UsageError
from benchmarks.lib.provenance import COMMAND_LINE, code_hash, versions
from benchmarks.lib.storage import out_folder, replacing, write_json

RECORD = "run.json"  # in each folder: what the run depends on, and the files that it wrote
TASKS = "tasks"  # folder of the results that an unfinished run keeps
HARMLESS = {".DS_Store", "Thumbs.db"}  # files that file managers add to a folder
NOT_RELEVANT = {"out", "fan_out"}  # options that no result depends on


@contextmanager
def results_folder(target: Path, conditions: Mapping[str, Any] | None = None) -> Iterator[Path]:
    """Yield a folder to write to, which takes the place of `target` at the end.

    The folder is beside `target` and has its name with `.unfinished` after it. If the block
    raises an error or is interrupted, it stays there, and `target` stays as it was.

    Parameters
    ----------
    target
        The folder of `--out`. A run replaces what an earlier run wrote and nothing else.
    conditions
        All that the results depend on, JSON-serialisable; see `conditions_of`. A run goes on
        in the folder of an unfinished run with the same conditions. None: it begins anew.

    Raises
    ------
    UsageError
        If the folder cannot be written to, if another run writes to it, or if it holds files
        that no run wrote.
    UnfinishedError
        If the results cannot be moved to `target`.
    """
    place = target.resolve()
    if not place.name:
        raise UsageError(f"--out: {target} is no folder that can be replaced")
    unfinished = place.with_name(f"{place.name}.unfinished")
    shown = target.with_name(unfinished.name)
    with _locked(target, place):
        try:
            _restore(place)
            _refuse_other_files(target)
            _prepare(unfinished, conditions, shown)
        except OSError as error:
            raise _not_writable(target, error) from error
        try:
            yield unfinished
        except BaseException:
            if _files(unfinished) == [RECORD]:
                shutil.rmtree(unfinished)
            else:
                how = "; the same command goes on from there" if conditions else ""
                print(f"\nUnfinished: what has finished is in {shown}/{how}.", flush=True)
            raise
        try:
            _finish(unfinished, place)
        except (OSError, UsageError) as error:
            message = f"{target} could not be replaced: {error}; the results are in {shown}/"
            raise UnfinishedError(message) from error


@contextmanager
def _locked(target: Path, place: Path) -> Iterator[None]:
    """Hold the lock of a folder; the system frees it even if the process is killed."""
    from filelock import FileLock, Timeout  # here: the help of a command does without it

    if place.exists() and not place.is_dir():
        raise UsageError(f"--out: {target} cannot be written to: it is a file")
    out_folder(place.parent)
    lock = FileLock(place.with_name(f".{place.name}.lock"))
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        raise UsageError(
            f"--out: another run writes to {target}: wait for it, or choose another folder"
        ) from error
    except (OSError, NotImplementedError) as error:  # the latter where nothing can be locked
        raise _not_writable(target, error) from error
    try:
        yield
    finally:
        lock.release()


def _not_writable(target: Path, error: Exception) -> UsageError:
    reason = getattr(error, "strerror", None) or error
    return UsageError(f"--out: {target} cannot be written to: {reason}")


def _files(folder: Path) -> list[str]:
    """Return the names of what is in a folder; none if there is no folder."""
    if not folder.is_dir():
        return []
    return sorted({path.name for path in folder.iterdir()} - HARMLESS)


def _record(folder: Path) -> dict[str, Any]:
    """Return the record of a run; empty if there is none or if it is damaged."""
    try:
        record = json.loads((folder / RECORD).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}


def _refuse_other_files(target: Path) -> None:
    """Raise a `UsageError` if a folder holds files that its run did not write."""
    written = [RECORD, *_record(target).get("files", [])]
    others = [name for name in _files(target) if name not in written]
    if others:
        listed = ", ".join(others[:3])
        raise UsageError(
            f"--out: {target} holds files that this version did not write ({listed}): remove "
            "the folder, or choose another one"
        )


def _prepare(unfinished: Path, conditions: Mapping[str, Any] | None, shown: Path) -> None:
    """Create the folder of a run, or keep that of an unfinished run that can go on."""
    files, record = _files(unfinished), _record(unfinished)
    if files and not record:
        raise UsageError(f"--out: {shown} holds files that no run wrote: remove it")
    if conditions and record.get("conditions") == conditions:
        for leftover in unfinished.rglob(".*.partial*"):  # of a process that was killed
            leftover.unlink()
        print(f"The run goes on from what has finished in {shown}/", flush=True)
        return
    if conditions and files:
        print(f"{shown}/ is of other options, code or packages: the run begins anew.")
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir()
    write_json(unfinished / RECORD, {"command": COMMAND_LINE.get(), "conditions": conditions})


def _finish(unfinished: Path, place: Path) -> None:
    """Move the folder of a finished run to its place."""
    _refuse_other_files(place)  # which may have come since the run began
    shutil.rmtree(unfinished / TASKS, ignore_errors=True)
    written = {"files": [name for name in _files(unfinished) if name != RECORD]}
    write_json(unfinished / RECORD, _record(unfinished) | written)
    earlier = _earlier(place)
    shutil.rmtree(earlier, ignore_errors=True)
    try:
        if place.exists():
            place.rename(earlier)
        unfinished.rename(place)
    finally:
        _restore(place)
    shutil.rmtree(earlier, ignore_errors=True)


def _earlier(place: Path) -> Path:
    """Return where earlier results are while new ones take their place."""
    return place.with_name(f".{place.name}.earlier")


def _restore(place: Path) -> None:
    """Bring earlier results back if a run was stopped before new ones took their place."""
    if _earlier(place).exists() and not place.exists():
        _earlier(place).rename(place)


def conditions_of(command: str, options: Any) -> dict[str, Any]:
    """Return all that the results of a command depend on, JSON-serialisable.

    `options` is its dataclass of options. A file among them counts by its content.
    """
    relevant = _relevant(asdict(options))
    conditions = {
        "command": command,
        "options": relevant,
        "versions": versions(),
        "code": code_hash(),
    }
    as_read: dict[str, Any] = json.loads(json.dumps(conditions, default=_content))
    return as_read


def _relevant(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return options without those that no result depends on, also in groups of options."""
    relevant = {}
    for name, value in options.items():
        if name not in NOT_RELEVANT:
            relevant[name] = _relevant(value) if isinstance(value, dict) else value
    return relevant


def _content(value: object) -> str:
    """Return a hash of the content of a file, and another value as text."""
    if isinstance(value, Path) and value.is_file():
        return hashlib.sha256(value.read_bytes()).hexdigest()
    return str(value)


def save_arrays(path: Path, result: Mapping[str, Any]) -> None:
    """Save numbers and arrays by name as an NPZ file, completely or not at all."""
    with replacing(path) as partial:
        np.savez(partial, **result)


def load_arrays(path: Path) -> dict[str, Any]:
    """Return the numbers and arrays of an NPZ file, by name. No code is run."""
    with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
        # A number was saved as an array without dimensions.
        return {name: array if array.ndim else array.item() for name, array in arrays.items()}


@dataclass(frozen=True)
class KeptResults:
    """Results of the tasks of an unfinished run, a file each, by the names of the tasks.

    They are there until the run is finished.
    """

    folder: Path  # that `results_folder` yields
    save_file: Callable[[Path, Any], None] = save_arrays
    load_file: Callable[[Path], Any] = load_arrays

    def path(self, name: str) -> Path:
        """Return the file of a task."""
        return self.folder / TASKS / f"{quote(name, safe=' ,')}.npz"

    def load(self, name: str) -> Any:
        """Return the result of a task; None if it is missing or damaged."""
        try:
            return self.load_file(self.path(name))
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error):
            return None

    def save(self, name: str, result: Any) -> None:
        """Write the result of a task, completely or not at all."""
        self.save_file(self.path(name), result)
