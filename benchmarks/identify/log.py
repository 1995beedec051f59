"""Read a recorded log as columns of numbers in equal steps, and say what was read."""

from __future__ import annotations

import io
import re
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from benchmarks.identify.options import Columns

Array = NDArray[np.float64]

FEWEST, MOST = 100, 20_000  # rows; of a longer log, the last ones are used
LONGEST_GAP = 20  # rows
SECONDS = {"ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0, "D": 86400.0}
_UNIT = re.compile(r"\s*[\[(]\s*([^\])]+?)\s*[\])]\s*$")  # in brackets, at the end of a heading


@dataclass(frozen=True)
class Log:
    """A recorded log with one row a sample."""

    flow: Array
    """From the time of its row on."""
    temperature: Array
    """At the time of its row; NaN where it is unknown."""
    sampling_interval: float
    """s."""
    disturbances: dict[str, Array] = field(default_factory=dict)
    """Other measured inputs, by column."""
    flow_unit: str = "t/h"
    """Of the flow, for reports."""
    temperature_unit: str = "°C"
    """Of the temperature."""
    notes: tuple[str, ...] = ()
    """What was read, and what was done about numbers that are missing."""


def read_log(path: Path, columns: Columns | None = None) -> Log:
    """Read a table with a heading.

    The separator (comma, semicolon or tab) and the decimal mark are detected.

    Raises
    ------
    ValueError
        If the table cannot be read; the message names the column, and the line if there is one.
    """
    columns = columns or Columns()
    table, decimal = _table(path)
    options = "time", "flow", "temperature"
    names = [_heading(table, option, getattr(columns, option)) for option in options]
    time, flow, temperature = names
    names += [_heading(table, "disturbance", each) for each in columns.disturbance]
    if len(set(names)) < len(names):
        raise ValueError(f"each column can be one thing only, got {', '.join(names)}")
    interval, places = _sampled(_times(table[time], decimal, columns.time_unit))
    kept = pd.DataFrame({name: _numbers(table[name], decimal) for name in names[1:]})
    kept = kept.set_index(places).reindex(range(places[-1] + 1))[-MOST:]
    notes = [f"Read {len(table):,} rows, one every {interval:g} s; {len(kept):,} are used."]
    for name, count in kept.isna().sum().items():
        done = "are left out of the fit" if name == temperature else "are the values before"
        notes += [f"{count} values of {name!r} are missing, and {done}."] * bool(count)
        if len(kept) - count < max(FEWEST, len(kept) / 2):
            raise ValueError(f"{count} of {len(kept)} values of {name!r} are missing: too many")
    held = kept.ffill().bfill()
    return Log(
        held[flow].to_numpy(np.float64), kept[temperature].to_numpy(np.float64), interval,
        {name: held[name].to_numpy(np.float64) for name in names[3:]},
        columns.flow_unit or _unit(flow, "t/h"),
        columns.temperature_unit or _unit(temperature, "°C"), tuple(notes),
    )  # fmt: skip


def _table(path: Path) -> tuple[pd.DataFrame, str]:
    """Return a file's table and its decimal mark."""
    try:
        text = path.read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}") from error
    heading, *lines = text[:10_000].splitlines() or [""]
    separator = next((mark for mark in ";\t" if mark in heading), ",")
    # With commas between the columns, a number with a decimal comma stands in quotes.
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
        raise ValueError(
            f"{path} is not a table: {str(error).strip()}. With decimal commas, the separator "
            "must be a semicolon or a tab, or the numbers in quotes"
        ) from error
    if len(table) < FEWEST:
        raise ValueError(f"the log is too short: {len(table)} rows, and hundreds are needed")
    return table.set_axis([str(name) for name in table.columns], axis=1), decimal


def _heading(table: pd.DataFrame, option: str, name: str) -> str:
    """Return the heading that a user names, with its unit or without."""
    for each in map(str, table):
        if name in (each, _UNIT.sub("", each)):
            return each
    raise ValueError(
        f"the log has no column {name!r}; it has {', '.join(map(repr, table))}. Name the right "
        f"one with --{option}"
    )


def _unit(name: str, default: str) -> str:
    """Return the unit that stands in a heading, if any."""
    bracket = _UNIT.search(name)
    return bracket.group(1) if bracket else default


def _numbers(column: pd.Series[Any], decimal: str) -> pd.Series[Any]:
    """Return a column as numbers; a ValueError names the line of what is none."""
    texts = column
    if not pd.api.types.is_numeric_dtype(column) and decimal == ",":
        texts = column.astype(str).str.replace(",", ".")  # pandas has left it all as text
    values = pd.to_numeric(texts, errors="coerce").astype(np.float64)
    bad = ~(values.abs() < 1e30) & column.notna()  # so that squares are finite
    if bad.any():
        raise ValueError(
            f"line {bad.to_numpy().argmax() + 2}: {column.name} must be a number, got "
            f"{str(column[bad].iloc[0])!r}. Leave the cell empty where it is not known"
        )
    return values


def _times(column: pd.Series[Any], decimal: str, unit: str | None) -> Array:
    """Return times in seconds, of numbers or dates."""
    if column.isna().any():
        raise ValueError(f"line {column.isna().to_numpy().argmax() + 2}: there is no time")
    if not pd.api.types.is_numeric_dtype(column):
        # In the one form the year comes first, in the other the day.
        first = str(column.iloc[0])[:4].isdigit()
        form: dict[str, Any] = {"format": "ISO8601"} if first else {"dayfirst": True}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of a form that is not known
            dates = pd.to_datetime(column, errors="coerce", utc=True, **form)
        if dates.notna().all():
            seconds = (dates - dates.iloc[0]) / pd.Timedelta(seconds=1)
            return np.asarray(seconds, np.float64)
    unit = unit or _unit(str(column.name), "s")
    if unit not in SECONDS:
        raise ValueError(
            f"the unit of the times must be {', '.join(SECONDS)}, got {unit!r}: say --time-unit"
        )
    return SECONDS[unit] * _numbers(column, decimal).to_numpy()


def _sampled(times: Array) -> tuple[float, NDArray[np.intp]]:
    """Return the sampling interval, and the number of the sample of each row."""
    steps = np.diff(times)
    usual = float(np.median(steps))
    # A row may come a quarter of a sample early or late, so that a step may err by half of one.
    interval = float(f"{np.mean(steps[np.abs(steps / usual - 1.0) < 0.5]):.6g}")
    whole = np.maximum(np.round(steps / interval), 1.0)
    late = pd.Series(np.cumsum(steps / interval - whole))
    late -= late.rolling(25, center=True, min_periods=1).median()
    for bad, what in (
        (steps <= 0.0, "times must increase. Sort the rows, and leave out what is there twice"),
        (whole > LONGEST_GAP, "rows are missing before it. Divide the log there"),
        (late.abs() > 0.35, f"most steps are {interval:g} s. Resample the log to equal ones"),
        (steps < 1e-4, "if the times are days, say --time-unit D"),
    ):
        if bad.any():
            row = int(np.argmax(bad))
            raise ValueError(f"line {row + 3}: a time step of {steps[row]:g} s: {what}")
    return interval, np.r_[0, np.cumsum(whole)].astype(np.intp)
