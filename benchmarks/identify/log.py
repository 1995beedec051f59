"""Reads a recorded log, and says what is wrong with it."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from tqdm import tqdm

from benchmarks.identify.options import Columns

Array = NDArray[np.float64]
Units = dict[str, tuple[float, float]]

# By unit: factor to the units of the plant (s, t/h, degC), and what is added then.
TIME_UNITS: Units = {"s": (1.0, 0.0), "ms": (1e-3, 0.0), "min": (60.0, 0.0), "h": (3600.0, 0.0)}
FLOW_UNITS: Units = dict.fromkeys(("t/h", "%"), (1.0, 0.0))
FLOW_UNITS |= {"kg/s": (3.6, 0.0), "kg/h": (1e-3, 0.0)}
TEMPERATURE_UNITS: Units = dict.fromkeys(("degC", "°C", "C"), (1.0, 0.0))
TEMPERATURE_UNITS |= {"K": (1.0, -273.15)}
TEMPERATURE_UNITS |= dict.fromkeys(("degF", "°F", "F"), (5 / 9, -160 / 9))

DAY_FIRST = r"^(\d\d)\.(\d\d)\.(\d{4})\b"
CHUNK = 200_000  # rows that are read at once
MOST_ROWS = 20_000  # that are kept by default, the latest
PROGRESS_AFTER = 1.0  # s
UNEVEN = 0.1  # of the sampling interval: what a time step may be off
LONGEST_GAP = 2_000  # rows that a gap is filled with: beyond, what came before is forgotten
LARGEST = 1e30  # of a number: its square must be one, too
LEAST_KNOWN = 0.5  # share of the flows
LEAST_TEMPERATURES = 100


@dataclass(frozen=True)
class Log:
    """What was recorded, one row a sample. NaN is what is not known.

    Attributes
    ----------
    flow
        From the time of its row on, t/h.
    temperature
        At the time of its row, degC.
    sampling_interval
        s.
    notes
        What the user should know about the log.
    disturbances
        Other inputs that were measured, from the times of their rows on, by their columns.
    flow_error
        Standard error of the flow, t/h.
    """

    flow: Array
    temperature: Array
    sampling_interval: float
    notes: list[str] = field(default_factory=list)
    disturbances: dict[str, Array] = field(default_factory=dict)
    flow_error: float = 0.0


def read_log(path: Path, columns: Columns | None = None, rows: int = MOST_ROWS) -> Log:
    """Read a log.

    The separator (comma, semicolon or tab) and the decimal mark are found out. The file is read
    in pieces, so that it may be larger than the memory; of a long one, the latest rows are
    kept, and all are checked.

    Parameters
    ----------
    path
        A table with a heading.
    columns
        Where what is.
    rows
        How many rows to keep.

    Raises
    ------
    ValueError
        If the table cannot be read; the message names the column, and the line if there is one.
    """
    columns = columns or Columns()
    if columns.sampling_interval is not None and not columns.sampling_interval > 0:
        raise ValueError(f"sampling_interval must be above 0, got {columns.sampling_interval}")
    layout = _Layout(path, columns)
    kept: deque[Array] = deque()
    clock = _Clock(columns.sampling_interval)
    read = 0
    with tqdm(unit="row", unit_scale=True, desc="reading", delay=PROGRESS_AFTER) as progress:
        for times, table in layout.tables():
            read += len(table)
            kept.append(clock.spread(times, table, first_line=read - len(table) + 2))
            while len(kept) > 1 and sum(map(len, kept)) - len(kept[0]) >= rows:
                kept.popleft()
            progress.update(len(table))
    if clock.interval is None or not read:
        raise ValueError(
            f"{path} is too short: {read} rows, and hundreds are needed, while the flow moves"
        )
    notes = [*layout.notes, *clock.notes]
    if read > rows:
        notes.append(f"Of the {read:,} rows, the last {rows:,} are used (--rows).")
    found = dict(zip(layout.names, np.concatenate(kept)[-rows:].T, strict=True))
    flow, temperature = (found.pop(layout.names[i]) for i in (0, 1))
    flow, disturbances = _held(flow), {name: _held(each) for name, each in found.items()}
    notes += _missing({"flow": flow, "temperature": temperature, **disturbances})
    return Log(flow, temperature, clock.interval, notes, disturbances)


class _Layout:
    """Separator, decimal mark, columns and units of a file."""

    def __init__(self, path: Path, columns: Columns) -> None:
        self.path = path
        try:
            with path.open(encoding="utf-8-sig", errors="replace") as file:
                heading, *lines = [line for line, _ in zip(file, range(50), strict=False)]
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
        }
        names = [str(name) for name in self._read(nrows=0).columns]
        wanted: list[tuple[str, Units, str | None, str, str]] = [
            (columns.flow, FLOW_UNITS, columns.flow_unit, "t/h", "flow"),
            (columns.temperature, TEMPERATURE_UNITS, columns.temperature_unit, "degC",
             "temperature"),
        ]  # fmt: skip
        wanted += [(each, {}, None, "", "disturbance") for each in columns.disturbance]
        if columns.sampling_interval is None:
            wanted.append((columns.time, TIME_UNITS, columns.time_unit, "s", "time"))
        found = [self._find(name, names, option) for name, *_, option in wanted]
        if len(set(found)) < len(found):
            raise ValueError(f"each column can be one thing only, got {', '.join(found)}")
        self._scales = {
            name: _scale(name, units, unit, default, option)
            for name, (_, units, unit, default, option) in zip(found, wanted, strict=True)
        }
        self.notes = (
            ["The flow is in %: read % wherever t/h is said."]
            if _unit(found[0], columns.flow_unit, "t/h") == "%"
            else []
        )
        self._time = found.pop() if columns.sampling_interval is None else None
        self.names = found

    def _read(self, **options: Any) -> Any:
        try:
            # Fields beyond the heading become an index, by which they are found.
            return pd.read_csv(self.path, **{**self._format, **options})
        except pd.errors.ParserError as error:
            raise self._not_a_table(error) from error

    def _not_a_table(self, error: Exception) -> ValueError:
        return ValueError(
            f"{self.path} is not a table: {str(error).strip()}. With decimal commas, "
            "the separator must be a semicolon or a tab, or the numbers in quotes"
        )

    def _find(self, name: str, names: Sequence[str], option: str) -> str:
        """Return the column of a name: exactly, or but for case and a unit in brackets."""
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

    def tables(self) -> Iterator[tuple[Array | None, Array]]:
        """Return the file piece by piece: times, s, and flow, temperature and disturbances."""
        line = 2
        try:
            with self._read(chunksize=CHUNK) as chunks:
                for chunk in chunks:
                    if not isinstance(chunk.index, pd.RangeIndex):
                        raise self._not_a_table(ValueError("lines longer than the heading"))
                    values = [self._numbers(chunk[name], line) for name in self.names]
                    times = (
                        None if self._time is None else self._numbers(chunk[self._time], line)
                    )
                    line += len(chunk)
                    yield times, np.column_stack(values)
        except pd.errors.ParserError as error:
            raise self._not_a_table(error) from error

    def _numbers(self, column: Any, line: int) -> Array:
        factor, offset = self._scales[column.name]
        is_time = column.name == self._time
        numbers = column
        if not pd.api.types.is_numeric_dtype(column):
            if is_time:
                # Where points are between the numbers, the day comes first.
                iso = column.astype(str).str.replace(DAY_FIRST, r"\3-\2-\1", regex=True)
                dates = pd.to_datetime(iso, errors="coerce", format="ISO8601", utc=True)
                if dates.notna().all():
                    since = (dates - pd.Timestamp(0, tz="UTC")) / pd.Timedelta(seconds=1)
                    return np.asarray(since, np.float64)
            numbers = pd.to_numeric(column, errors="coerce")
        values = np.asarray(numbers.to_numpy(dtype=np.float64, na_value=np.nan))
        allowed = column.isna().to_numpy() & (not is_time)
        bad = np.flatnonzero(~(np.abs(values) < LARGEST) & ~allowed)
        if len(bad):
            date = (
                ", or a date such as 2026-01-31T12:00:00 or 31.01.2026 12:00:00"
                if is_time
                else ""
            )
            raise ValueError(
                f"{self.path}, line {line + bad[0]}: {column.name} must be a number{date}, got "
                f"{str(column.iloc[bad[0]])!r}"
                + ("" if is_time else ". Leave the cell empty where it is not known")
            )
        return factor * values + offset


class _Clock:
    """Turns times into rows at equal distances, with empty ones where there are gaps."""

    def __init__(self, interval: float | None) -> None:
        self.interval = interval
        self.notes: list[str] = []
        self._last: Array = np.zeros(0)

    def spread(self, times: Array | None, table: Array, first_line: int) -> Array:
        """Return the values of a piece, a row a sample."""
        if times is None:
            return table
        line = first_line + 1 - len(self._last)  # of the row after the first step
        known = np.concatenate([self._last, times])
        steps, self._last = np.diff(known), known[-1:]
        if not len(steps):
            return table
        back = np.flatnonzero(steps <= 0)
        if len(back):
            raise ValueError(
                f"line {line + back[0]}: the time must increase, and goes from "
                f"{known[back[0]]:g} s by {steps[back[0]]:g} s. Sort the rows, and leave out "
                "those that are there twice; or give --sampling-interval if the times are wrong"
            )
        if self.interval is None:
            self.interval = float(f"{np.median(steps):.6g}")
        ratio = steps / self.interval
        whole = np.maximum(np.round(ratio), 1.0)
        uneven = np.flatnonzero(np.abs(ratio - whole) > UNEVEN)
        if len(uneven):
            raise ValueError(
                f"line {line + uneven[0]}: the time steps are unequal, {steps[uneven[0]]:g} s "
                f"here where most are {self.interval:g} s. Resample the log to equal steps, or "
                "give --sampling-interval if the times are wrong"
            )
        for gap in np.flatnonzero(whole > 1):
            missing = int(whole[gap]) - 1
            rows = f"{missing} rows are" if missing > 1 else "1 row is"
            if len(self.notes) < 3:
                self.notes.append(f"Before line {line + gap}, {rows} missing.")
            elif len(self.notes) == 3:
                self.notes.append("More rows are missing later.")
        counts = np.minimum(whole, LONGEST_GAP).astype(np.intp)
        new = len(times) - len(steps)  # the first row of the file has no step before it
        places = np.concatenate([np.zeros(new, np.intp), np.cumsum(counts) - 1 + new])
        result = np.full((int(places[-1]) + 1, table.shape[1]), np.nan)
        result[places] = table
        return result


def _scale(
    name: str, units: Units, given: str | None, default: str, option: str
) -> tuple[float, float]:
    if not units:
        return 1.0, 0.0
    unit = _unit(name, given, default)
    if unit not in units:
        raise ValueError(
            f"the unit of {name!r} must be one of {', '.join(units)}, got {unit!r}. Say it "
            f"with --{option}-unit"
        )
    return units[unit]


def _unit(name: str, given: str | None, default: str) -> str:
    """Return the unit that an option or a heading's brackets say."""
    bracket = re.search(r"[\[(]\s*([^\])]*?)\s*[\])]\s*$", name)
    return given or (bracket.group(1) if bracket else default)


def _missing(columns: dict[str, Array]) -> list[str]:
    counts = {name: int(np.isnan(each).sum()) for name, each in columns.items()}
    rows = len(columns["flow"])
    for name, count in counts.items():
        known = rows - count
        least = LEAST_TEMPERATURES if name == "temperature" else (1.0 - LEAST_KNOWN) * rows
        if count and known < min(least, rows):
            raise ValueError(
                f"{count} of {rows} rows have no {name}: too many are missing. Name another "
                "column, or take the rows in which it is known"
            )
    if not any(counts.values()):
        return []
    said = " and ".join(f"{count} {name}s" for name, count in counts.items() if count)
    return [f"{said} are missing (NaN); rows that need them are left out of the fit."]


def _held(flow: Array) -> Array:
    """Return a flow with its gaps closed where it is the same on both sides.

    So is that of a recorder that writes it less often than the temperature.
    """
    series = pd.Series(flow)
    before, after = series.ffill(), series.bfill()
    known = np.flatnonzero(series.notna())
    steps = np.diff(known)
    if len(steps) and np.min(steps) > 1 and np.mean(steps == steps[0]) > 0.95:
        return np.asarray(before, np.float64)
    filled = series.where(series.notna() | (before != after), before)
    return np.asarray(filled, np.float64)
