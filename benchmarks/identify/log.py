"""Read a recorded log, and say what was read and what is wrong with it."""

from __future__ import annotations

import io
import re
import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from benchmarks.identify.__main__ import Columns

Array = NDArray[np.float64]

LEAST_SAMPLES = 100  # of flow and temperature: a tenth of what makes a good log
_UNIT = re.compile(r"\s*[\[(]\s*([^\])]+?)\s*[\])]\s*$")  # in brackets, at the end of a heading


@dataclass(frozen=True)
class Log:
    """A recorded log, one row per sample. NaN stands for what is unknown."""

    flow: Array  # from the time of its row on
    temperature: Array  # at the time of its row
    sampling_interval: float  # s
    notes: list[str] = field(default_factory=list)  # remarks for the user about the log
    # Other measured inputs, by column, from the times of their rows on.
    disturbances: dict[str, Array] = field(default_factory=dict)
    others: dict[str, Array] = field(default_factory=dict)  # all other columns of numbers
    flow_error: float = 0.0  # standard error of the flow
    flow_unit: str = "t/h"
    temperature_unit: str = "°C"

    def mended(self, note: str, **changes: Any) -> Log:
        """Return the log with changes, and a note that describes them."""
        return replace(self, notes=[*self.notes, note], **changes)


def read_log(path: Path, columns: Columns | None = None, rows: int = 20_000) -> Log:
    """Read a table with a heading, and keep its latest rows.

    The separator (comma, semicolon or tab) and the decimal mark are detected.

    Raises
    ------
    ValueError
        If the table cannot be read; the message names the column, and the line if there is one.
    """
    columns = columns or Columns()
    interval = columns.sampling_interval
    if interval is not None and not interval > 0:
        raise ValueError(f"sampling_interval must be above 0, got {interval}")
    table, decimal = _table(path)
    columns = _found(columns, list(table.columns))
    inputs = dict.fromkeys(columns.disturbance, "disturbance")
    options = {columns.flow: "flow", columns.temperature: "temperature", **inputs}
    if not interval:
        options[columns.time] = "time"
    for name, option in options.items():
        if name not in table.columns:
            advice = ", or give --sampling-interval if there are no times" * (option == "time")
            raise ValueError(
                f"the log has no column {name!r}; it has "
                f"{', '.join(map(repr, table.columns))}. Name the right one with "
                f"--{option}{advice}"
            )
    if len(options) < 2 + len(columns.disturbance) + (not interval):
        raise ValueError(f"each column can be one thing only, got {', '.join(options)}")
    others = table.drop(columns=list(options)).select_dtypes("number").astype(np.float64)
    used = [name for name, option in options.items() if option != "time"]
    kept = pd.DataFrame({name: _numbers(table[name], decimal) for name in used})
    kept, notes = pd.concat([kept, others], axis=1), list[str]()
    if not interval:
        times, unit = _times(table[columns.time], decimal, columns.time_unit)
        interval, places = _sampled(times, notes)
        kept = kept.set_index(places).reindex(range(places[-1] + 1))
        notes.insert(0, f"The times are {unit}.")
    if len(kept) > rows:
        notes.append(f"Of the {len(kept):,} rows, the last {rows:,} are used (--rows).")
        kept = kept[-rows:]
    log = Log(
        _held(kept[columns.flow]),
        kept[columns.temperature].to_numpy(),
        float(interval),
        disturbances={name: _held(kept[name]) for name in columns.disturbance},
        others={str(name): _held(kept[name]) for name in others},
        flow_unit=columns.flow_unit or _unit(columns.flow) or "t/h",
        temperature_unit=columns.temperature_unit or _unit(columns.temperature) or "°C",
    )
    read = (
        f"Read {len(table):,} rows: the flow from {columns.flow!r}, {log.flow_unit}; the "
        f"temperature from {columns.temperature!r}, {log.temperature_unit}; a row every "
        f"{log.sampling_interval:g} s."
    )
    missing = _missing({"flow": log.flow, "temperature": log.temperature, **log.disturbances})
    return replace(log, notes=[read, *notes, *missing])


def _table(path: Path) -> tuple[pd.DataFrame, str]:
    """Return a file's table and its decimal mark."""
    try:
        text = path.read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}") from error
    if not text:
        raise ValueError(f"{path} is empty")
    heading, *lines = text[:10_000].splitlines()
    separator = next((mark for mark in ";\t" if mark in heading), ",")
    comma = r'"-?\d+,\d+"' if separator == "," else r"\d,\d"
    decimal = "," if any(re.search(comma, line) for line in lines) else "."
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)
            table = pd.read_csv(
                io.StringIO(text), sep=separator, decimal=decimal, skipinitialspace=True,
                skip_blank_lines=False, index_col=False, low_memory=False,
            )  # fmt: skip
    except (pd.errors.EmptyDataError, pd.errors.ParserError, pd.errors.ParserWarning) as error:
        long = isinstance(error, pd.errors.ParserWarning)
        reason = "lines longer than the heading" if long else str(error).strip()
        raise ValueError(
            f"{path} is not a table: {reason}. With decimal commas, the separator must be a "
            "semicolon or a tab, or the numbers in quotes"
        ) from error
    if not len(table):
        raise ValueError(f"{path} is too short: it has no rows, and hundreds are needed")
    return table.set_axis([str(name) for name in table.columns], axis=1), decimal


def _found(columns: Columns, headings: list[str]) -> Columns:
    """Return columns by their whole headings, where they are named without the unit."""

    def heading(name: str) -> str:
        with_unit = [each for each in headings if _UNIT.sub("", each) == name]
        return with_unit[0] if name not in headings and len(with_unit) == 1 else name

    return replace(
        columns,
        time=heading(columns.time),
        flow=heading(columns.flow),
        temperature=heading(columns.temperature),
        disturbance=tuple(map(heading, columns.disturbance)),
    )


def _unit(name: str) -> str:
    """Return the unit that stands in a heading, if any."""
    bracket = _UNIT.search(name)
    return bracket.group(1) if bracket else ""


def _numbers(column: pd.Series[Any], decimal: str, *, is_time: bool = False) -> Any:
    texts = column
    if not pd.api.types.is_numeric_dtype(column) and decimal == ",":
        texts = column.astype(str).str.replace(",", ".")  # pandas has left it all as text
    values = pd.to_numeric(texts, errors="coerce").astype(np.float64)
    bad = ~(values.abs() < 1e30) & (column.notna() | is_time)  # so that squares are finite
    if bad.any():
        number, advice = "a number", ". Leave the cell empty where it is not known"
        if is_time:
            number, advice = "a number or a date such as 2026-01-31T12:00:00", ""
        raise ValueError(
            f"line {bad.to_numpy().argmax() + 2}: {column.name} must be {number}, got "
            f"{str(column[bad].iloc[0])!r}{advice}"
        )
    return values


def _times(column: pd.Series[Any], decimal: str, unit: str | None) -> tuple[Array, str]:
    """Return times in seconds, and their unit."""
    if not pd.api.types.is_numeric_dtype(column):
        forms: list[Any] = [{"format": "ISO8601"}, {"dayfirst": True}]
        for form in forms:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # of a format that is not known
                dates = pd.to_datetime(column, errors="coerce", utc=True, **form)
            if dates.notna().all():
                seconds = (dates - dates.iloc[0]) / pd.Timedelta(seconds=1)
                return np.asarray(seconds, np.float64), "dates"
    unit = unit or _unit(str(column.name)) or "s"
    try:
        factor = pd.Timedelta(1, unit=unit).total_seconds()  # type: ignore[arg-type]
    except ValueError as error:
        raise ValueError(
            f"the unit of the times must be ms, s, min, h or D, got {unit!r}: say --time-unit"
        ) from error
    return factor * _numbers(column, decimal, is_time=True).to_numpy(), f"in {unit}"


def _sampled(times: Array, notes: list[str]) -> tuple[float, NDArray[np.intp]]:
    """Return the sampling interval, and the number of the sample of each row."""
    steps = np.diff(times)
    if not len(steps):
        raise ValueError("the log is too short: it has 1 row, and hundreds are needed")
    if (steps <= 0).any():
        row = int(np.argmax(steps <= 0))
        raise ValueError(
            f"line {row + 3}: the time must increase, and goes from {times[row]:g} s by "
            f"{steps[row]:g} s. Sort the rows, and leave out those that are there twice"
        )
    usual = float(np.median(steps))
    if usual < 1e-4:
        raise ValueError(
            f"the rows are {usual:.3g} s apart: if the times are days, as in a spreadsheet, "
            "say --time-unit D"
        )
    interval = float(f"{np.mean(steps[np.abs(steps / usual - 1.0) < 0.5]):.6g}")
    ratio = steps / interval
    whole = np.maximum(np.round(ratio), 1.0)
    # How early or late the rows are, in samples, beside those around them: an interval that is
    # not exact does not count, and a gap of five samples or more may be of any length.
    late = pd.Series(np.cumsum(np.where(whole >= 5, 0.0, ratio - whole)))
    late -= late.rolling(25, center=True, min_periods=1).median()
    off = late.abs() > 0.35  # a quarter, and a margin for the rounding of the times
    if off.any():
        row = int(np.argmax(off))
        raise ValueError(
            f"line {row + 3}: the time steps are unequal, {steps[row]:g} s here where most are "
            f"{interval:g} s. Resample the log to equal steps"
        )
    gaps = np.flatnonzero(whole > 1)
    notes += [
        f"Before line {row + 3}, {whole[row] - 1:.0f} rows are missing." for row in gaps[:3]
    ]
    if len(gaps) > 3:
        notes.append("More rows are missing later.")
    # Over a gap of 2,000 rows the past is forgotten: a longer one need not be filled.
    places = np.cumsum(np.minimum(whole, 2_000)).astype(np.intp)
    return interval, np.concatenate([[0], places])


def _missing(columns: dict[str, Array]) -> list[str]:
    """Return a note on missing values; a ValueError is raised if they are too many."""
    counts = {name: int(np.isnan(each).sum()) for name, each in columns.items()}
    rows = len(columns["flow"])
    for name, count in counts.items():
        least = LEAST_SAMPLES if name == "temperature" else rows / 2
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
