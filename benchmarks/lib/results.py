"""Keep the results of a command in a folder, also if the command is interrupted.

A command that is to write to the folder `NAME` first writes to the folder `NAME.unfinished`. At
the end of the command, `NAME.unfinished` replaces `NAME`, so that no file of an earlier run of
the command stays beside a new report. In this module, a run is one execution of a command.
"""

import hashlib
import json
import shutil
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

# Names in a folder of results: the file with the conditions and the names of the written files,
# and the folder with the results of the finished tasks of an unfinished run.
RECORD_FILE = "run.json"
TASKS_FOLDER = "tasks"
FILE_MANAGER_FILES = {".DS_Store", "Thumbs.db"}  # files that file managers add to a folder
WITHOUT_INFLUENCE = {"out", "fan_out"}  # fields of `Options` on which no result depends


@contextmanager
def results_folder(target: Path, conditions: Mapping[str, Any] | None = None) -> Iterator[Path]:
    """Yield a folder to write to, which replaces the folder `target` at the end of the block.

    The yielded folder lies beside `target` and has the name of `target` with `.unfinished`
    after it. If the block of the `with` statement raises an error or is interrupted, the
    yielded folder is kept with the files in it, and `target` stays as it was.

    Parameters
    ----------
    target
        The folder that the user has chosen by `--out`.
    conditions
        All that the results depend on, as `conditions_of` returns it. If an unfinished run with
        equal conditions has left its folder, this folder is yielded, with the files in it.
        Otherwise, and if `conditions` is None, the yielded folder is empty.

    Raises
    ------
    UsageError
        If `target` holds the current folder or cannot be written to, if another process is
        writing to `target`, or if `target` or the yielded folder has files that no run wrote.
    UnfinishedError
        If the yielded folder cannot be renamed to `target` at the end.
    """
    final = target.resolve()
    if Path.cwd().is_relative_to(final):
        raise UsageError(f"--out: {target} must not be the current folder or a folder above it")
    out_folder(final.parent)
    unfinished = final.with_name(f"{final.name}.unfinished")
    _refuse_other_files(final)
    with _lock(final):
        _prepare(unfinished, conditions)
        try:
            yield unfinished
        except BaseException:
            if _files(unfinished) == [RECORD_FILE]:
                shutil.rmtree(unfinished)
            else:
                print(f"\nThe run has not finished. Its results so far are in {unfinished}/.")
                if conditions:
                    print("The same command continues with these results.")
            raise
        try:
            _replace(final, unfinished)
        except (OSError, UsageError) as error:
            raise UnfinishedError(
                f"{final} could not be replaced: {error}; the results are in {unfinished}/"
            ) from error


def _lock(final: Path) -> AbstractContextManager[object]:
    """Lock the folder `final`, and return a context whose end unlocks the folder.

    The folder need not exist: the lock is a hidden file beside the folder. The operating system
    unlocks the folder if this process is killed.

    Raises
    ------
    UsageError
        If another process has locked the folder.
    """
    from filelock import FileLock, Timeout  # imported here, as --help needs no lock

    try:
        return FileLock(final.with_name(f".{final.name}.lock")).acquire(timeout=0)
    except Timeout as error:
        raise UsageError(
            f"--out: another run writes to {final}: wait for it, or choose another folder"
        ) from error


def _files(folder: Path) -> list[str]:
    """Return the sorted names of the files and folders in a folder, which need not exist.

    The names in `FILE_MANAGER_FILES` are left out.
    """
    if not folder.exists():
        return []
    return sorted({path.name for path in folder.iterdir()} - FILE_MANAGER_FILES)


def _record(folder: Path) -> dict[str, Any]:
    """Return the content of the file `RECORD_FILE` in a folder of results.

    The keys are "command", "conditions" and, after a finished run, "files". If the file is
    missing or is not JSON, the dict is empty.
    """
    try:
        record: dict[str, Any] = json.loads((folder / RECORD_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return record


def _refuse_other_files(final: Path) -> None:
    """Raise a `UsageError` if the folder `final` has files that no finished run has recorded.

    So a command never replaces a folder with files of the user.
    """
    if final.exists() and not final.is_dir():
        raise UsageError(f"--out: {final} cannot be written to: it is not a folder")
    recorded = {RECORD_FILE, *_record(final).get("files", [])}
    others = [name for name in _files(final) if name not in recorded]
    if others:
        listed = ", ".join(others[:3])
        raise UsageError(
            f"--out: {final} holds files that this version did not write ({listed}): remove "
            "the folder, or choose another one"
        )


def _prepare(unfinished: Path, conditions: Mapping[str, Any] | None) -> None:
    """Prepare the folder `unfinished`, which `results_folder` yields.

    If a run with equal `conditions` has left the folder, the folder stays as it is. Otherwise,
    and if `conditions` is None, the folder becomes empty except for the file `RECORD_FILE`.

    Raises
    ------
    UsageError
        If the folder has files, but no valid `RECORD_FILE`: then no run has written the files.
    """
    record = _record(unfinished)
    has_files = bool(_files(unfinished))
    if has_files and not record:
        raise UsageError(f"--out: {unfinished} holds files that no run wrote: remove it")
    if conditions and record.get("conditions") == conditions:
        print(f"The run continues with the results in {unfinished}/", flush=True)
        return
    if conditions and has_files:
        print(f"The results in {unfinished}/ are of other options, code or packages.")
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir()
    new_record = {"command": COMMAND_LINE.get(), "conditions": conditions}
    write_json(unfinished / RECORD_FILE, new_record)


def _replace(final: Path, unfinished: Path) -> None:
    """Replace the folder `final` by the folder `unfinished` of a run that has finished.

    The names of the run's files are added to `RECORD_FILE`, and the results of single tasks are
    removed.
    """
    _refuse_other_files(final)  # Somebody may have added files since the run began.
    shutil.rmtree(unfinished / TASKS_FOLDER, ignore_errors=True)
    record = {**_record(unfinished), "files": _files(unfinished)}
    write_json(unfinished / RECORD_FILE, record)
    earlier = final.with_name(f".{final.name}.earlier")
    shutil.rmtree(earlier, ignore_errors=True)
    if final.exists():
        final.rename(earlier)
    unfinished.rename(final)
    shutil.rmtree(earlier, ignore_errors=True)


def conditions_of(command: str, options: Any) -> dict[str, Any]:
    """Return all that the results of a command depend on, as a dict that JSON can store.

    Two runs of a command with equal conditions have equal results. The conditions are the name
    of the command, its options, a hash of the code, and the versions of Python and of packages.

    Parameters
    ----------
    command
        The name of the command, such as "sweep".
    options
        The command's options, a dataclass. An option that is a file is replaced by a hash of
        the content of the file. The options in `WITHOUT_INFLUENCE` are left out.
    """
    conditions = {
        "command": command,
        "options": asdict(options, dict_factory=_relevant),
        "versions": versions(),
        "code": code_hash(),
    }
    as_read: dict[str, Any] = json.loads(json.dumps(conditions, default=_content))
    return as_read


def _relevant(options: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return pairs of name and value as a dict, without the names in `WITHOUT_INFLUENCE`.

    `dataclasses.asdict` calls this function for the dataclass of options, and for each
    dataclass in it.
    """
    return {name: value for name, value in options if name not in WITHOUT_INFLUENCE}


def _content(value: object) -> str:
    """Return an object that JSON cannot store as text, for `json.dumps`.

    The text is a SHA-256 hash of the content if `value` is the path of a file, and otherwise
    `str(value)`.
    """
    if isinstance(value, Path) and value.is_file():
        return hashlib.sha256(value.read_bytes()).hexdigest()
    return str(value)


def save_arrays(path: Path, result: Mapping[str, Any]) -> None:
    """Save `result`, a mapping from names to numbers or arrays, as the NPZ file `path`."""
    np.savez(path, **result)


def load_arrays(path: Path) -> dict[str, Any]:
    """Return the numbers and arrays of the NPZ file `path` by name, as saved by `save_arrays`.

    NumPy refuses pickled objects with a ValueError, since loading them could run foreign code.
    """
    result = {}
    with np.load(path) as arrays:
        for name, array in arrays.items():
            # A number was saved as an array without dimensions.
            result[name] = array if array.ndim else array.item()
    return result


@dataclass(frozen=True)
class KeptResults:
    """The results of finished tasks, one file each, with which an interrupted run can continue.

    `results_folder` removes the files when the whole run has finished.

    Attributes
    ----------
    folder : Path
        The folder that `results_folder` yields. The files are in its folder `TASKS_FOLDER`.
    save_file : callable
        Saves the result of a task to a file: `save_file(path, result)`.
    load_file : callable
        Returns the result of a task from a file: `load_file(path)`.
    """

    folder: Path
    save_file: Callable[[Path, Any], None] = save_arrays
    load_file: Callable[[Path], Any] = load_arrays

    def path(self, name: str) -> Path:
        """Return the path of the file for the result of the task called `name`."""
        return self.folder / TASKS_FOLDER / f"{quote(name, safe=' ,')}.npz"

    def load(self, name: str) -> Any:
        """Return the stored result of the task called `name`; None if no result is stored."""
        path = self.path(name)
        return self.load_file(path) if path.exists() else None

    def save(self, name: str, result: Any) -> None:
        """Write `result`, the result of the task called `name`, to the file of the task.

        A run that is killed leaves either the whole file or no file of this name.
        """
        path = self.path(name)
        path.parent.mkdir(exist_ok=True)
        partial = path.with_name("partial.npz")
        self.save_file(partial, result)
        partial.replace(path)
