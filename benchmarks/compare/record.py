"""The folder of a comparison: which files are its own, and where they come from."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from tqdm import tqdm

from benchmarks.compare import tables
from benchmarks.lib.storage import write_json
from benchmarks.lib.tables import write_csv

PROVENANCE = "provenance.json"


class Record:
    """The files that a comparison writes.

    Parameters
    ----------
    folder
        Where to write. What an earlier comparison wrote there is removed before the first file.
    origin
        What the results come from: options, seeds, versions, commit.
    """

    def __init__(self, folder: Path, origin: Mapping[str, Any]) -> None:
        self.folder = folder
        self.origin = dict(origin)
        self._files: list[str] = []
        self._clock = time.perf_counter()

    def path(self, name: str) -> Path:
        """Return where to write a file."""
        if not self._files:
            self._remove_files_of_earlier_run()
        if name not in self._files:
            self._files.append(name)
        return self.folder / name

    def _remove_files_of_earlier_run(self) -> None:
        """Do so; if it cannot be read what they are, say so and go on."""
        provenance = self.folder / PROVENANCE
        if not provenance.exists():
            return
        try:
            stale = [Path(name) for name in json.loads(provenance.read_text("utf-8"))["files"]]
        except (KeyError, TypeError, ValueError) as error:
            text = f"{provenance} is damaged: {error}. Other files of the earlier run may stay."
            tqdm.write(text, file=sys.stderr)
            return
        for file in stale:
            (self.folder / file.name).unlink(missing_ok=True)

    def write_table(self, name: str, table: pd.DataFrame) -> None:
        """Write a table of numbers, texts and estimates."""
        write_csv(self.path(name), tables.for_csv(table))

    def write_runs(self, runs: pd.DataFrame, *, complete: bool) -> None:
        """Write the runs, and where all files come from."""
        self.write_table("runs.csv", runs)
        path = self.path(PROVENANCE)
        seconds = round(time.perf_counter() - self._clock, 1)
        about = {"complete": complete, "seconds": seconds, **self.origin, "files": self._files}
        write_json(path, about)
