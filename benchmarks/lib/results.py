"""Keep the results of a run in a folder, and the results of an unfinished run beside it.

A run writes to the folder `NAME.unfinished`. When the run has finished, this folder takes the
place of the folder `NAME`, so that no file of an earlier run stays beside a new report.
"""

import hashlib
import json
import shutil
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from benchmarks.lib.errors import UnfinishedError, UsageError
from benchmarks.lib.provenance import COMMAND_LINE, code_hash, versions
from benchmarks.lib.storage import out_folder, write_json

RECORD = "run.json"  # in a folder of results: what the run depends on, and the files it wrote
TASKS = "tasks"  # in the folder of an unfinished run: the results of finished tasks
HARMLESS = {".DS_Store", "Thumbs.db"}  # files that file managers add to a folder
IRRELEVANT = {"out", "fan_out"}  # options on which no result depends


@contextmanager
def results_folder(target: Path, conditions: Mapping[str, Any] | None = None) -> Iterator[Path]:
    """Yield a folder to write to, which takes the place of `target` at the end of the block.

    If the block raises an error or is interrupted, the yielded folder stays beside `target`,
    under the name of `target` with `.unfinished` after it, and `target` stays as it was.

    Parameters
    ----------
    target
        The folder of `--out`. A run replaces the files of an earlier run and no other files.
    conditions
        All that the results depend on, as `conditions_of` returns it. If the folder of an
        unfinished run has the same conditions, the run goes on in that folder. None: the run
        always starts in an empty folder.

    Raises
    ------
    UsageError
        If the folder cannot be written to, if another run is writing to it, or if it holds
        files that no run wrote.
    UnfinishedError
        If the results cannot be moved to `target`.
    """
    place = target.resolve()
    if not place.name:
        raise UsageError(f"--out: {target} is the root of a file system: choose a folder in it")
    out_folder(place.parent)
    unfinished = place.with_name(f"{place.name}.unfinished")
    _refuse_other_files(place)
    with _lock(place):
        _prepare(unfinished, conditions)
        try:
            yield unfinished
        except BaseException:
            _keep_or_remove(unfinished, conditions)
            raise
        try:
            _finish(unfinished, place)
        except (OSError, UsageError) as error:
            raise UnfinishedError(
                f"{place} could not be replaced: {error}; the results are in {unfinished}/"
            ) from error


def _lock(place: Path) -> AbstractContextManager[object]:
    """Lock a folder of results until the end of a `with` block.

    The system frees the lock if this process is killed. A `UsageError` is raised if another run
    holds the lock.
    """
    from filelock import FileLock, Timeout  # imported here, as --help needs no lock

    try:
        return FileLock(place.with_name(f".{place.name}.lock")).acquire(timeout=0)
    except Timeout as error:
        raise UsageError(
            f"--out: another run writes to {place}: wait for it, or choose another folder"
        ) from error


def _files(folder: Path) -> list[str]:
    """Return the names of the files in a folder, sorted; none if the folder does not exist."""
    if not folder.exists():
        return []
    return sorted({path.name for path in folder.iterdir()} - HARMLESS)


def _record(folder: Path) -> dict[str, Any]:
    """Return the record of the run that wrote a folder; empty if there is no valid record."""
    try:
        record: dict[str, Any] = json.loads((folder / RECORD).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return record


def _refuse_other_files(place: Path) -> None:
    """Raise a `UsageError` if a folder of results holds files that its run did not write."""
    if place.exists() and not place.is_dir():
        raise UsageError(f"--out: {place} cannot be written to: it is not a folder")
    written = {RECORD, *_record(place).get("files", [])}
    foreign = [name for name in _files(place) if name not in written]
    if foreign:
        listed = ", ".join(foreign[:3])
        raise UsageError(
            f"--out: {place} holds files that this version did not write ({listed}): remove "
            "the folder, or choose another one"
        )


def _prepare(unfinished: Path, conditions: Mapping[str, Any] | None) -> None:
    """Make an empty folder for a run, or go on in the folder of a run with these conditions."""
    record = _record(unfinished)
    is_in_use = bool(_files(unfinished))
    if is_in_use and not record:
        raise UsageError(f"--out: {unfinished} holds files that no run wrote: remove it")
    if conditions and record.get("conditions") == conditions:
        print(f"The run continues with the results in {unfinished}/", flush=True)
        return
    if conditions and is_in_use:
        print(f"The results in {unfinished}/ are of other options, code or packages.")
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir()
    write_json(unfinished / RECORD, {"command": COMMAND_LINE.get(), "conditions": conditions})


def _keep_or_remove(unfinished: Path, conditions: Mapping[str, Any] | None) -> None:
    """Tell where the results of an interrupted run are; remove its folder if it has none."""
    if _files(unfinished) == [RECORD]:
        shutil.rmtree(unfinished)
        return
    print(f"\nThe run has not finished. Its results so far are in {unfinished}/.", flush=True)
    if conditions:
        print("The same command continues with them.", flush=True)


def _finish(unfinished: Path, place: Path) -> None:
    """Record the files of a finished run, and move its folder to its place."""
    _refuse_other_files(place)  # Somebody may have added files since the run began.
    shutil.rmtree(unfinished / TASKS, ignore_errors=True)
    record = {**_record(unfinished), "files": _files(unfinished)}
    write_json(unfinished / RECORD, record)
    earlier = place.with_name(f".{place.name}.earlier")
    shutil.rmtree(earlier, ignore_errors=True)
    if place.exists():
        place.rename(earlier)
    unfinished.rename(place)
    shutil.rmtree(earlier, ignore_errors=True)


def conditions_of(command: str, options: Any) -> dict[str, Any]:
    """Return all that the results of a command depend on, JSON-serialisable.

    Results depend on the options, on the code and on the versions of packages. `options` is the
    dataclass of options. If an option is a file, its content counts, not its name.
    """
    conditions = {
        "command": command,
        "options": _relevant(asdict(options)),
        "versions": versions(),
        "code": code_hash(),
    }
    as_read: dict[str, Any] = json.loads(json.dumps(conditions, default=_content))
    return as_read


def _relevant(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options on which results depend; options may be nested in groups."""
    relevant = {}
    for name, value in options.items():
        if isinstance(value, dict):
            value = _relevant(value)
        if name not in IRRELEVANT:
            relevant[name] = value
    return relevant


def _content(value: object) -> str:
    """Return a hash of the content of a file, given its path, and another value as text."""
    if isinstance(value, Path) and value.is_file():
        return hashlib.sha256(value.read_bytes()).hexdigest()
    return str(value)


def save_arrays(path: Path, result: Mapping[str, Any]) -> None:
    """Save numbers and arrays by name as an NPZ file."""
    np.savez(path, **result)


def load_arrays(path: Path) -> dict[str, Any]:
    """Return the numbers and arrays of an NPZ file by name, without running code in it."""
    result = {}
    with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
        for name, array in arrays.items():
            # A number was saved as an array without dimensions.
            result[name] = array if array.ndim else array.item()
    return result


@dataclass(frozen=True)
class KeptResults:
    """The results of the finished tasks of an unfinished run, in a file for each task.

    The files are removed when the run has finished.

    Attributes
    ----------
    folder : Path
        The folder that `results_folder` yields.
    save_file : callable
        Saves a result: `save_file(path, result)`.
    load_file : callable
        Returns the result in a file: `load_file(path)`.
    """

    folder: Path
    save_file: Callable[[Path, Any], None] = save_arrays
    load_file: Callable[[Path], Any] = load_arrays

    def path(self, name: str) -> Path:
        """Return the file of the task with this name."""
        return self.folder / TASKS / f"{quote(name, safe=' ,')}.npz"

    def load(self, name: str) -> Any:
        """Return the result of a task; None if its file is missing or damaged."""
        try:
            return self.load_file(self.path(name))
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error):
            return None

    def save(self, name: str, result: Any) -> None:
        """Write the result of a task to its file."""
        path = self.path(name)
        path.parent.mkdir(exist_ok=True)
        self.save_file(path, result)
