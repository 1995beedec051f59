"""Reads a recorded log, and says what is wrong with it."""

from __future__ import annotations

import csv
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

Array = NDArray[np.float64]

# By unit: factor to the units of the plant (s, t/h, degC), and what is added then.
TIME_UNITS = {"s": (1.0, 0.0), "ms": (1e-3, 0.0), "min": (60.0, 0.0), "h": (3600.0, 0.0)}
FLOW_UNITS = {"t/h": (1.0, 0.0), "kg/s": (3.6, 0.0), "kg/h": (1e-3, 0.0), "%": (1.0, 0.0)}
TEMPERATURE_UNITS = {
    "degC": (1.0, 0.0),
    "°C": (1.0, 0.0),
    "C": (1.0, 0.0),
    "K": (1.0, -273.15),
    "degF": (5 / 9, -160 / 9),
    "°F": (5 / 9, -160 / 9),
    "F": (5 / 9, -160 / 9),
}
CHUNK = 200_000  # rows that are read at once
MOST_ROWS = 20_000  # that are kept by default, the latest
PROGRESS_AFTER = 1.0  # s
UNEVEN = 0.1  # of the sampling interval: what a time step may be off
LONGEST_GAP = 2_000  # rows that a gap is filled with: beyond, what came before is forgotten
MOST_MISSING = 0.5  # share of the rows


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
    """

    flow: Array
    temperature: Array
    sampling_interval: float
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Columns:
    """Where a log holds what, and in which units.

    Attributes
    ----------
    time, flow, temperature
        Names of columns.
    sampling_interval
        s, in place of the times; None to read them.
    time_unit, flow_unit, temperature_unit
        None for what the heading says in brackets, and s, t/h and degC if it says nothing.
    """

    time: str = "time"
    flow: str = "flow"
    temperature: str = "temperature"
    sampling_interval: float | None = None
    time_unit: str | None = None
    flow_unit: str | None = None
    temperature_unit: str | None = None


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
        for table in layout.tables():
            read += len(table)
            kept.append(clock.spread(table, first_line=read - len(table) + 2))
            while len(kept) > 1 and sum(map(len, kept)) - len(kept[0]) >= rows:
                kept.popleft()
            progress.update(len(table))
    if clock.interval is None:
        raise ValueError(f"{path} is too short: {read} rows tell no sampling interval")
    flow, temperature = np.concatenate(kept)[-rows:].T
    notes = list(clock.notes)
    if read > rows:
        notes.append(f"Of the {read:,} rows, the last {rows:,} are used (--rows).")
    notes += _missing(flow, temperature)
    return Log(_held(flow), temperature, clock.interval, notes)


class _Layout:
    """Separator, decimal mark, columns and units of a file."""

    def __init__(self, path: Path, columns: Columns) -> None:
        self.path = path
        try:
            with path.open(encoding="utf-8-sig", errors="replace") as file:
                lines = [line for line, _ in zip(file, range(50), strict=False)]
        except OSError as error:
            raise ValueError(f"{path} cannot be read: {error.strerror}") from error
        if not lines:
            raise ValueError(f"{path} is empty")
        self.separator = next((mark for mark in ";\t" if mark in lines[0]), ",")
        comma = r'"-?\d+,\d+"' if self.separator == "," else r"\d,\d"
        self.decimal = "," if any(re.search(comma, line) for line in lines[1:]) else "."
        names = [str(name) for name in self._read(nrows=0).columns]
        for number, fields in enumerate(csv.reader(lines, delimiter=self.separator), 1):
            if any(field.strip() for field in fields[len(names) :]):
                raise ValueError(
                    f"{path}, line {number}: {len(fields)} fields where the heading has "
                    f"{len(names)}. With decimal commas, the separator must be a semicolon "
                    "or a tab, or the numbers in quotes"
                )
        wanted = [columns.flow, columns.temperature]
        units: list[tuple[dict[str, tuple[float, float]], str | None, str, str]] = [
            (FLOW_UNITS, columns.flow_unit, "t/h", "flow"),
            (TEMPERATURE_UNITS, columns.temperature_unit, "degC", "temperature"),
        ]
        if columns.sampling_interval is None:
            wanted.append(columns.time)
            units.append((TIME_UNITS, columns.time_unit, "s", "time"))
        found = [
            self._find(name, names, option)
            for name, (*_, option) in zip(wanted, units, strict=True)
        ]
        if len(set(found)) < len(found):
            raise ValueError(f"each column can be one thing only, got {', '.join(found)}")
        self.names = found
        self.scales = [_scale(name, *unit) for name, unit in zip(found, units, strict=True)]

    def _read(self, **options: Any) -> Any:
        return pd.read_csv(
            self.path,
            sep=self.separator,
            decimal=self.decimal,
            encoding="utf-8-sig",
            encoding_errors="replace",
            skipinitialspace=True,
            skip_blank_lines=False,
            index_col=False,
            **options,
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

    def tables(self) -> Iterator[Array]:
        """Return the file piece by piece: flow, temperature and time if there is one."""
        line = 2
        try:
            with self._read(chunksize=CHUNK) as chunks:
                for chunk in chunks:
                    values = [
                        factor * self._numbers(chunk[name], line, is_time=i == 2) + offset
                        for i, (name, (factor, offset)) in enumerate(
                            zip(self.names, self.scales, strict=True)
                        )
                    ]
                    line += len(chunk)
                    yield np.column_stack(values)
        except pd.errors.ParserError as error:
            raise ValueError(f"{self.path} is not a table: {error}") from error

    def _numbers(self, column: Any, line: int, *, is_time: bool) -> Array:
        numbers = column if pd.api.types.is_numeric_dtype(column) else None
        if numbers is None and is_time:
            dates = pd.to_datetime(column, errors="coerce", format="ISO8601", utc=True)
            if dates.notna().all():
                since = (dates - pd.Timestamp(0, tz="UTC")) / pd.Timedelta(seconds=1)
                seconds: Array = since.to_numpy(dtype=np.float64)
                return seconds
        if numbers is None:
            numbers = pd.to_numeric(column, errors="coerce")
        values: Array = numbers.to_numpy(dtype=np.float64, na_value=np.nan)
        bad = np.flatnonzero(~np.isfinite(values) & column.notna().to_numpy())
        if is_time and not len(bad):
            bad = np.flatnonzero(np.isnan(values))
        if len(bad):
            allowed = (
                "a number, or a date such as 2026-01-31T12:00:00" if is_time else "a number"
            )
            raise ValueError(
                f"{self.path}, line {line + bad[0]}: {column.name} must be {allowed}, got "
                f"{str(column.iloc[bad[0]])!r}"
            )
        return values


class _Clock:
    """Turns times into rows at equal distances, with empty ones where there are gaps."""

    def __init__(self, interval: float | None) -> None:
        self.interval = interval
        self.notes: list[str] = []
        self._last: float | None = None

    def spread(self, table: Array, first_line: int) -> Array:
        """Return flow and temperature, a row a sample."""
        if table.shape[1] == 2:
            return table
        times = table[:, 2]
        steps = np.diff(times) if self._last is None else np.diff(times, prepend=self._last)
        if not len(steps):
            self._last = float(times[-1]) if len(times) else self._last
            return table[:, :2]
        line = first_line + (1 if self._last is None else 0)  # of the row after the first step
        back = np.flatnonzero(steps <= 0)
        if len(back):
            raise ValueError(
                f"line {line + back[0]}: the time must increase, and goes from "
                f"{times[len(times) - len(steps) + back[0]] - steps[back[0]]:g} s by "
                f"{steps[back[0]]:g} s"
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
        gaps = np.flatnonzero(whole > 1)
        for gap in gaps[:3]:
            missing = int(whole[gap]) - 1
            self.notes.append(
                f"Before line {line + gap}, {missing} row{'s' * (missing > 1)} "
                f"{'are' if missing > 1 else 'is'} missing."
            )
        if len(gaps) > 3:
            self.notes.append(f"So are some before {len(gaps) - 3} more lines.")
        self._last = float(times[-1])
        if not len(gaps):
            return table[:, :2]
        counts = np.minimum(whole, LONGEST_GAP).astype(np.intp)
        start = np.zeros(len(times) - len(steps), np.intp)
        places = np.cumsum(np.concatenate([start, counts]))
        first = 0 if len(times) > len(steps) else 1  # a gap before the first row of a piece
        result = np.full((int(places[-1]) + 1 - first, 2), np.nan)
        result[places - first] = table[:, :2]
        return result


def _scale(
    name: str,
    units: dict[str, tuple[float, float]],
    given: str | None,
    default: str,
    option: str,
) -> tuple[float, float]:
    bracket = re.search(r"[\[(]\s*([^\])]*?)\s*[\])]\s*$", name)
    unit = given or (bracket.group(1) if bracket else default)
    if unit not in units:
        raise ValueError(
            f"the unit of {name!r} must be one of {', '.join(units)}, got {unit!r}. Say it "
            f"with --{option}-unit"
        )
    return units[unit]


def _missing(flow: Array, temperature: Array) -> list[str]:
    counts = {
        "flow": int(np.isnan(flow).sum()),
        "temperature": int(np.isnan(temperature).sum()),
    }
    for name, count in counts.items():
        if count > MOST_MISSING * len(flow):
            raise ValueError(
                f"{count} of {len(flow)} rows have no {name}: too many are missing"
            )
    if not any(counts.values()):
        return []
    return [
        f"{counts['temperature']} temperatures and {counts['flow']} flows are missing (NaN); "
        "rows that need them are left out of the fit."
    ]


def _held(flow: Array) -> Array:
    """Return the flow with its gaps closed where it is the same on both sides."""
    series = pd.Series(flow)
    before, after = series.ffill(), series.bfill()
    filled = series.where(series.notna() | (before != after), before)
    return np.asarray(filled, np.float64)
