"""Read a recorded log as columns of numbers in equal steps, and say what was read."""

from __future__ import annotations

import io
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.identify.__main__ import Options
from benchmarks.identify.fit import Array

FEWEST, MOST = 100, 20_000  # rows; of a longer log, the last ones are used


@dataclass(frozen=True)
class Log:
    """A recorded log with one row a sample."""

    flow: Array  # from the time of its row on
    temperature: Array  # at the time of its row; NaN where it is unknown
    sampling_interval: float  # s
    disturbances: dict[str, Array] = field(default_factory=dict)  # by column
    notes: tuple[str, ...] = ()  # what was read, and what was missing
    given: Options = field(default_factory=lambda: Options(Path()))  # columns and units


def read_log(given: Options) -> Log:
    """Read a table with a heading; a ValueError names the column and the line of what is bad.

    The separator may be a comma, a semicolon or a tab, the decimal mark a point or a comma.
    """
    table, temperature = _table(given.log), given.temperature
    names = [given.time, given.flow, temperature, *given.disturbance]
    if len(set(names)) < len(names):
        raise ValueError(f"each column can be one thing only, got {', '.join(names)}")
    for name in names:
        if name not in table:
            raise ValueError(
                f"the log has no column {name!r}; it has {', '.join(map(repr, table))}. Name "
                "the right ones with --time, --flow, --temperature and --disturbance"
            )
    interval, places = _sampled(_times(table[given.time], given.time_unit))
    numbers = table[names[1:]].apply(_numbers)
    kept = numbers.set_index(places).reindex(np.arange(places[-1] + 1.0))[-MOST:]
    notes = [f"Read {len(table):,} rows, one every {interval:g} s; {len(kept):,} are used."]
    for column, count in kept.isna().sum().items():
        notes += [f"{count} values of {column!r} are missing."] * bool(count)
        if len(kept) - count < max(FEWEST, len(kept) / 2):
            raise ValueError(
                f"{count} of {len(kept)} values of {column!r} are missing: too many"
            )
    held = {name: column.to_numpy() for name, column in kept.ffill().bfill().items()}
    flow, others = held[given.flow], {name: held[name] for name in given.disturbance}
    return Log(flow, kept[temperature].to_numpy(), interval, others, tuple(notes), given)


def _table(path: Path) -> pd.DataFrame:
    """Return a file's table of texts."""
    try:
        text = path.read_text(encoding="utf-8-sig", errors="replace")
        separator = next((mark for mark in ";\t" if mark in text.partition("\n")[0]), ",")
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)  # of too many cells
            table = pd.read_csv(
                io.StringIO(text), sep=separator, dtype=str, skipinitialspace=True,
                skip_blank_lines=False, index_col=False,
            )  # fmt: skip
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}") from error
    except (pd.errors.EmptyDataError, pd.errors.ParserError, pd.errors.ParserWarning) as error:
        raise ValueError(
            f"{path} is not a table: {str(error).strip()}. With decimal commas, the separator "
            "must be a semicolon or a tab, or the numbers in quotes"
        ) from error
    if len(table) < FEWEST:
        raise ValueError(f"the log is too short: {len(table)} rows, and hundreds are needed")
    return table


def _numbers(column: pd.Series[str]) -> pd.Series[float]:
    """Return texts as numbers; a ValueError names the line of what is none."""
    values = pd.to_numeric(column.str.replace(",", "."), errors="coerce").astype(np.float64)
    _check(column, ~(values.abs() < 1e30) & column.notna(), "a number")  # its square is finite
    return values


def _times(column: pd.Series[str], unit: Any) -> Array:
    """Return times in seconds, of numbers or dates."""
    numbers = pd.to_numeric(column.str.replace(",", "."), errors="coerce")
    if numbers.count() > len(column) / 2:
        _check(column, numbers.isna(), "a number or a date")
        return pd.Timedelta(1, unit).total_seconds() * numbers.to_numpy(np.float64)
    # In the one form of dates the year comes first, in the other the day.
    form: Any = "ISO8601" if str(column.iloc[0])[:4].isdigit() else None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of a form that is not known
        dates = pd.to_datetime(
            column, errors="coerce", utc=True, format=form, dayfirst=not form
        )
    _check(column, dates.isna(), "a date")
    return np.asarray((dates - dates.iloc[0]) / pd.Timedelta(seconds=1), np.float64)


def _check(column: pd.Series[str], bad: pd.Series[bool], needed: str) -> None:
    """Raise a ValueError that names the first line that is bad."""
    if bad.any():
        raise ValueError(
            f"line {bad.to_numpy().argmax() + 2}: {column.name} must be {needed}, got "
            f"{str(column[bad].iloc[0])!r}. Leave other cells empty where nothing is known"
        )


def _sampled(times: Array) -> tuple[float, Array]:
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
        (whole > 20, "rows are missing before it. Divide the log there"),
        (late.abs() > 0.35, f"most steps are {interval:g} s. Resample the log to equal ones"),
        (steps < 1e-4, "if the times are days, say --time-unit D"),
    ):
        if bad.any():
            row = int(np.argmax(bad))
            raise ValueError(f"line {row + 3}: a time step of {steps[row]:g} s: {what}")
    return interval, np.r_[0.0, np.cumsum(whole)]
