"""Read a recorded log, and report what is wrong with it."""

from __future__ import annotations

import itertools
import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from tqdm import tqdm

from benchmarks.identify.options import UNITS, Columns

Array = NDArray[np.float64]

DAY_FIRST = r"^(\d\d)\.(\d\d)\.(\d{4})\b"
CHUNK = 200_000  # rows read at once
MOST_ROWS = 20_000  # latest rows kept by default
PROGRESS_AFTER = 1.0  # s
UNEVEN = 0.1  # tolerance of a time step, as a share of the sampling interval
LONGEST_GAP = 2_000  # most rows that a gap is filled with: the past is forgotten by then
LARGEST = 1e30  # bound of a number, so that its square is finite
LEAST_KNOWN = 0.5  # least share of flows that must be known
LEAST_TEMPERATURES = 100


@dataclass(frozen=True)
class Log:
    """A recorded log, one row per sample. NaN stands for what is unknown."""

    flow: Array  # from the time of its row on, t/h
    temperature: Array  # at the time of its row, degC
    sampling_interval: float  # s
    notes: list[str] = field(default_factory=list)  # remarks for the user about the log
    # Other measured inputs, by column, from the times of their rows on.
    disturbances: dict[str, Array] = field(default_factory=dict)
    flow_error: float = 0.0  # standard error of the flow, t/h

    def mended(self, note: str, **changes: Any) -> Log:
        """Return the log with changes, and a note that describes them."""
        return replace(self, notes=[*self.notes, note], **changes)


def read_log(path: Path, columns: Columns | None = None, rows: int = MOST_ROWS) -> Log:
    """Read a table with a heading, and keep its latest rows.

    The separator (comma, semicolon or tab) and the decimal mark are detected. The file is read
    in pieces, so that it may be larger than the memory, and all rows are checked.

    Raises
    ------
    ValueError
        If the table cannot be read; the message names the column, and the line if there is one.
    """
    columns = columns or Columns()
    if columns.sampling_interval is not None and not columns.sampling_interval > 0:
        raise ValueError(f"sampling_interval must be above 0, got {columns.sampling_interval}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)
            return _read(_File(path, columns), columns.sampling_interval, rows)
    except (pd.errors.EmptyDataError, pd.errors.ParserError, pd.errors.ParserWarning) as error:
        long = isinstance(error, pd.errors.ParserWarning)
        reason = "lines longer than the heading" if long else str(error).strip()
        raise ValueError(
            f"{path} is not a table: {reason}. With decimal commas, the separator must be a "
            "semicolon or a tab, or the numbers in quotes"
        ) from error


def _read(file: _File, interval: float | None, rows: int) -> Log:
    clock, kept, read = _Clock(interval), pd.DataFrame(), 0
    with tqdm(unit="row", unit_scale=True, desc="reading", delay=PROGRESS_AFTER) as progress:
        for table in file.pieces():
            times = table.pop(file.time) if file.time else None
            spread = table if times is None else clock.spread(times, table)
            kept = pd.concat([kept, spread[-rows:]])[-rows:] if read else spread[-rows:]
            read += len(table)
            progress.update(len(table))
    if clock.interval is None or not read:
        raise ValueError(
            f"{file.path} is too short: {read} rows, and hundreds are needed, while the flow "
            "moves"
        )
    notes = ["The flow is in %: read % wherever t/h is said."] if file.in_percent else []
    notes += clock.notes
    if read > rows:
        notes.append(f"Of the {read:,} rows, the last {rows:,} are used (--rows).")
    flow, temperature, *others = kept.columns
    log = Log(
        _held(kept[flow]),
        kept[temperature].to_numpy(),
        clock.interval,
        notes,
        {name: _held(kept[name]) for name in others},
    )
    notes += _missing({"flow": log.flow, "temperature": log.temperature, **log.disturbances})
    return log


class _File:
    """A file with a heading: its separator, decimal mark, columns and units."""

    def __init__(self, path: Path, columns: Columns) -> None:
        self.path = path
        try:
            with path.open(encoding="utf-8-sig", errors="replace") as file:
                heading, *lines = itertools.islice(file, 50)
        except ValueError as error:
            raise ValueError(f"{path} is empty") from error
        except OSError as error:
            raise ValueError(f"{path} cannot be read: {error.strerror}") from error
        separator = next((mark for mark in ";\t" if mark in heading), ",")
        comma = r'"-?\d+,\d+"' if separator == "," else r"\d,\d"
        self._format: dict[str, Any] = {
            "sep": separator,
            "decimal": "," if any(re.search(comma, line) for line in lines) else ".",
            "encoding": "utf-8-sig",
            "encoding_errors": "replace",
            "skipinitialspace": True,
            "skip_blank_lines": False,
            "index_col": False,  # pandas warns of fields beyond the heading
        }
        wanted = [("flow", columns.flow), ("temperature", columns.temperature)]
        wanted += [("disturbance", each) for each in columns.disturbance]
        if columns.sampling_interval is None:
            wanted.append(("time", columns.time))
        names = [str(name) for name in pd.read_csv(path, nrows=0, **self._format).columns]
        found = [self._find(name, names, option) for option, name in wanted]
        if len(set(found)) < len(found):
            raise ValueError(f"each column can be one thing only, got {', '.join(found)}")
        self._scales = {
            name: UNITS[option][_unit(name, option, columns)] if option in UNITS else (1.0, 0.0)
            for name, (option, _) in zip(found, wanted, strict=True)
        }
        self.in_percent = _unit(found[0], "flow", columns) == "%"
        self.time = found[-1] if wanted[-1][0] == "time" else None

    def _find(self, name: str, names: Sequence[str], option: str) -> str:
        """Return the column with a name; if none matches, ignore case and units in brackets."""
        if name in names:
            return name
        alike = [n for n in names if re.sub(r"[\[(].*", "", n).strip().lower() == name.lower()]
        if len(alike) != 1:
            what = "no column" if not alike else "several columns"
            raise ValueError(
                f"{self.path} has {what} {name!r}; it has {', '.join(map(repr, names))}. Name "
                f"the right one with --{option}"
                + (", or give --sampling-interval" if option == "time" else "")
            )
        return alike[0]

    def pieces(self) -> Iterator[pd.DataFrame]:
        """Yield the file piece by piece: flow, temperature, disturbances and time, if any."""
        with pd.read_csv(self.path, chunksize=CHUNK, **self._format) as chunks:
            for chunk in chunks:
                yield pd.DataFrame({name: self._numbers(chunk[name]) for name in self._scales})

    def _numbers(self, column: Any) -> Any:
        """Return a column in the units of the plant."""
        is_time = column.name == self.time
        factor, offset = self._scales[column.name]
        texts = column
        if not pd.api.types.is_numeric_dtype(column) and self._format["decimal"] == ",":
            texts = column.astype(str).str.replace(",", ".")  # pandas has left it all as text
        values = pd.to_numeric(texts, errors="coerce").astype(np.float64)
        if is_time and values.isna().any():
            # In dates with points, the day comes first.
            iso = column.astype(str).str.replace(DAY_FIRST, r"\3-\2-\1", regex=True)
            dates = pd.to_datetime(iso, errors="coerce", format="ISO8601", utc=True)
            if dates.notna().all():
                return (dates - pd.Timestamp(0, tz="UTC")) / pd.Timedelta(seconds=1)
        bad = ~(values.abs() < LARGEST) & (column.notna() | is_time)
        if bad.any():
            number, advice = "a number", ". Leave the cell empty where it is not known"
            if is_time:
                number += ", or a date such as 2026-01-31T12:00:00 or 31.01.2026 12:00:00"
                advice = ""
            raise ValueError(
                f"{self.path}, line {bad.idxmax() + 2}: {column.name} must be {number}, got "
                f"{str(column[bad.idxmax()])!r}{advice}"
            )
        return factor * values + offset


class _Clock:
    """Spreads rows over equal time steps, with empty rows in the gaps."""

    def __init__(self, interval: float | None) -> None:
        self.interval = interval
        self.notes: list[str] = []
        self._last = pd.Series(dtype=np.float64)

    def spread(self, times: pd.Series[float], table: pd.DataFrame) -> pd.DataFrame:
        """Return the values of a piece, one row per sample."""
        known = pd.concat([self._last, times])
        self._last = known.iloc[-1:]
        steps = known.diff().iloc[1:]
        if not len(steps):
            return table
        if (steps <= 0).any():
            row = (steps <= 0).idxmax()
            raise ValueError(
                f"line {row + 2}: the time must increase, and goes from {known[row - 1]:g} s "
                f"by {steps[row]:g} s. Sort the rows, and leave out those that are there "
                "twice; or give --sampling-interval if the times are wrong"
            )
        if self.interval is None:
            self.interval = float(f"{steps.median():.6g}")
        ratio = steps / self.interval
        whole = ratio.round().clip(lower=1.0)
        uneven = (ratio - whole).abs() > UNEVEN
        if uneven.any():
            row = uneven.idxmax()
            raise ValueError(
                f"line {row + 2}: the time steps are unequal, {steps[row]:g} s here where most "
                f"are {self.interval:g} s. Resample the log to equal steps, or give "
                "--sampling-interval if the times are wrong"
            )
        for row, count in whole[whole > 1].items():
            rows = f"{count - 1:.0f} rows are" if count > 2 else "1 row is"
            if len(self.notes) < 3:
                self.notes.append(f"Before line {row + 2}, {rows} missing.")
            elif len(self.notes) == 3:
                self.notes.append("More rows are missing later.")
        # The first row of the file has no step before it.
        counts = whole.clip(upper=LONGEST_GAP).reindex(table.index, fill_value=1.0)
        places = counts.cumsum().astype(int) - 1
        return table.set_axis(places).reindex(range(places.iloc[-1] + 1))


def _unit(name: str, quantity: str, columns: Columns) -> str:
    """Return the unit given by an option or by brackets in the heading."""
    units = UNITS[quantity]
    bracket = re.search(r"[\[(]\s*([^\])]*?)\s*[\])]\s*$", name)
    said = bracket.group(1) if bracket else next(iter(units))
    unit: str = getattr(columns, f"{quantity}_unit") or said
    if unit not in units:
        raise ValueError(
            f"the unit of {name!r} must be one of {', '.join(units)}, got {unit!r}. Say it "
            f"with --{quantity}-unit"
        )
    return unit


def _missing(columns: dict[str, Array]) -> list[str]:
    """Return a note on missing values; a ValueError is raised if they are too many."""
    counts = {name: int(np.isnan(each).sum()) for name, each in columns.items()}
    rows = len(columns["flow"])
    for name, count in counts.items():
        least = LEAST_TEMPERATURES if name == "temperature" else LEAST_KNOWN * rows
        if count and rows - count < min(least, rows):
            raise ValueError(
                f"{count} of {rows} rows have no {name}: too many are missing. Name another "
                "column, or take the rows in which it is known"
            )
    said = " and ".join(f"{count} {name}s" for name, count in counts.items() if count)
    note = f"{said} are missing (NaN); rows that need them are left out of the fit."
    return [note] if said else []


def _held(series: pd.Series[float]) -> Array:
    """Return a flow with its gaps filled where it is the same on both sides.

    All gaps are filled if it is recorded at regular intervals of several rows.
    """
    before, after = series.ffill(), series.bfill()
    steps = np.diff(np.flatnonzero(series.notna()))
    if not (len(steps) and np.min(steps) > 1 and np.mean(steps == steps[0]) > 0.95):
        before = series.fillna(before.where(before == after))
    return np.asarray(before, np.float64)
