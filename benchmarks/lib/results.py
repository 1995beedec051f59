"""Keep the results of a command in a folder, even if the command is interrupted.

A command writes results for the folder `NAME` to the folder `NAME.unfinished`. When the command
has finished, the folder `NAME.unfinished` replaces the folder `NAME`, so that old and new
results are never mixed. In this module, a run is one execution of a command.
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

# Names in a folder of results: the file with the conditions of the run and the names of the
# written files, and the folder with the results of finished tasks during a run.
RECORD_FILE = "run.json"
TASKS_FOLDER = "tasks"
FILE_MANAGER_FILES = {".DS_Store", "Thumbs.db"}  # files that file managers add to a folder
WITHOUT_INFLUENCE = {"out", "fan_out"}  # fields of `Options` on which no result depends


@contextmanager
def results_folder(target: Path, conditions: Mapping[str, Any] | None = None) -> Iterator[Path]:
    """Yield a folder for new results, which replaces `target` at the end of the `with` block.

    The yielded folder for the `target` "results/x", for example, is "results/x.unfinished". If
    the `with` block raises an error or is interrupted, the folder `target` does not change, and
    the yielded folder is kept with the results in it, or removed if it has no results.

    Parameters
    ----------
    target
        Folder that the user has chosen by the option `--out`.
    conditions
        Everything that the results of the command depend on, as returned by `conditions_of`. If
        an unfinished run with equal conditions has left a folder, `results_folder` yields that
        folder with the results in it. If `conditions` is None, the yielded folder is always
        empty.

    Raises
    ------
    UsageError
        If `target` is the current folder or a folder above it, cannot be written to, or is in
        use by another process; or if `target` or the folder to yield has files that no command
        wrote.
    UnfinishedError
        If the yielded folder cannot replace `target` after the `with` block.
    """
    final = target.resolve()
    if Path.cwd().is_relative_to(final):
        raise UsageError(f"--out: {target} must not be the current folder or a folder above it")
    out_folder(final.parent)
    unfinished = final.with_name(f"{final.name}.unfinished")
    try:
        _refuse_other_files(final)
        _refuse_other_files(_earlier(final))
        lock = _lock(final)
    except OSError as error:  # for example, a name that is too long
        raise UsageError(f"--out: {target} cannot be used: {error.strerror}") from error
    with lock:
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
    """Lock the folder `final`, and return a context manager that unlocks the folder.

    The lock is a hidden file beside the folder `final`. The folder `final` need not exist. If
    the process is killed, the operating system releases the lock.

    Raises
    ------
    UsageError
        If another process has locked the folder `final`.
    """
    from filelock import FileLock, Timeout  # imported here, as --help needs no lock

    try:
        return FileLock(final.with_name(f".{final.name}.lock")).acquire(timeout=0)
    except Timeout as error:
        raise UsageError(
            f"--out: another run writes to {final}: wait for it, or choose another folder"
        ) from error


def _files(folder: Path) -> list[str]:
    """Return the sorted names of files and folders in `folder`, except `FILE_MANAGER_FILES`.

    If `folder` does not exist, the result is an empty list.
    """
    if not folder.exists():
        return []
    return sorted({path.name for path in folder.iterdir()} - FILE_MANAGER_FILES)


def _record(folder: Path) -> dict[str, Any]:
    """Return the content of the file `RECORD_FILE` in a folder of results, as a dict.

    The keys of the dict are "command", "conditions" and, after a finished run, "files". The
    dict is empty if `RECORD_FILE` is missing or is not JSON.
    """
    try:
        record = json.loads((folder / RECORD_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}


def _earlier(final: Path) -> Path:
    """Return the folder to which `final` is moved for the moment in which it is replaced."""
    return final.with_name(f".{final.name}.earlier")


def _refuse_other_files(final: Path) -> None:
    """Raise a `UsageError` if `final` is a file, or has files that no command wrote."""
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
    """Empty the folder `unfinished`, unless a run with equal `conditions` has left the folder.

    A folder that was emptied gets a new file `RECORD_FILE` with `conditions`.

    Raises
    ------
    UsageError
        If `unfinished` is a file, or a folder with files but without a valid `RECORD_FILE`.
    """
    if unfinished.exists() and not unfinished.is_dir():
        raise UsageError(f"--out: {unfinished} must be a folder: remove the file")
    record = _record(unfinished)
    has_files = bool(_files(unfinished))
    if has_files and not {"command", "conditions"} <= set(record):
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

    Before the replacement, the names of all result files are added to `RECORD_FILE`, and the
    folder `TASKS_FOLDER` is removed.
    """
    _refuse_other_files(final)  # Somebody may have added files since the run began.
    shutil.rmtree(unfinished / TASKS_FOLDER, ignore_errors=True)
    record = {**_record(unfinished), "files": _files(unfinished)}
    write_json(unfinished / RECORD_FILE, record)
    earlier = _earlier(final)
    _refuse_other_files(earlier)
    shutil.rmtree(earlier, ignore_errors=True)
    if final.exists():
        final.rename(earlier)
    unfinished.rename(final)
    shutil.rmtree(earlier, ignore_errors=True)


def conditions_of(command: str, options: Any) -> dict[str, Any]:
    """Return everything that the results of a command depend on, as a dict for JSON.

    The dict has the name of the command, the options, a hash of the source code, and the
    versions of Python and of packages. If the dicts of two runs of a command are equal, the
    results of the two runs are equal.

    Parameters
    ----------
    command
        Name of the command, such as "tune".
    options
        Dataclass with the options of the command. In the returned dict, a hash of a file's
        content replaces the file's path, and the options in `WITHOUT_INFLUENCE` are left out.
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
    """Return options as a dict, without those on which no result depends."""
    return {name: value for name, value in options if name not in WITHOUT_INFLUENCE}


def _content(value: object) -> str:
    """Convert `value`, whose type JSON does not have, to text for `json.dumps`.

    The path of a file is converted to a SHA-256 hash of the file's content, and every other
    object to `str(value)`.
    """
    if isinstance(value, Path) and value.is_file():
        return hashlib.sha256(value.read_bytes()).hexdigest()
    return str(value)


def save_arrays(path: Path, result: Mapping[str, Any]) -> None:
    """Save `result`, a mapping from names to numbers or arrays, as the NPZ file `path`."""
    np.savez(path, **result)


def load_arrays(path: Path) -> dict[str, Any]:
    """Return the numbers and arrays, by name, of an NPZ file that `save_arrays` has written.

    NumPy raises a ValueError for an NPZ file with pickled objects, since loading pickled
    objects could run foreign code.
    """
    result = {}
    with np.load(path) as arrays:
        for name, array in arrays.items():
            # NumPy saves a number as an array without dimensions.
            result[name] = array if array.ndim else array.item()
    return result


@dataclass(frozen=True)
class KeptResults:
    """Files with the results of finished tasks, from which an interrupted run can continue.

    When a command has finished, the function `results_folder` removes the files with the
    results of tasks.

    Attributes
    ----------
    folder : Path
        Folder that `results_folder` yields; the files are in the subfolder `TASKS_FOLDER`.
    save_file : callable
        Function `save_file(path, result)` that saves the result of a task to a file.
    load_file : callable
        Function `load_file(path)` that returns the result of a task from a file.
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

        If the process is killed, the file of the task is either complete or missing.
        """
        path = self.path(name)
        path.parent.mkdir(exist_ok=True)
        partial = path.with_name("partial.npz")
        self.save_file(partial, result)
        partial.replace(path)
