"""Identify the plant of a recorded log: `python -m benchmarks.identify --help`."""

from __future__ import annotations

import io
import os
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from benchmarks.lib.command import Finite, Folder, command, options
from benchmarks.lib.errors import UsageError
from benchmarks.lib.provenance import origin
from benchmarks.lib.results import results_folder
from benchmarks.lib.storage import write_json
from mptc_gym import Parameters
from mptc_gym.parameters import slowest_pole

if TYPE_CHECKING:
    import pandas as pd

    from benchmarks.lib.report import Section
    from benchmarks.loop.identification import Identified, Log

# Threads for small matrices only wait for each other. OpenBLAS reads it when it is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

Array = NDArray[np.float64]

FEWEST, MOST = 100, 20_000  # rows of a log; of a longer one, the last rows are used
LONGEST_GAP = 20  # samples
LARGEST = 1e30  # numbers in a log; the square of a larger one might not be finite
# One to three digits, and then groups of three: 1,480 may be 1.48 or 1480.
THOUSANDS = r"[+-]?[1-9]\d{0,2}([.,]\d{3})+"


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Fit a plant to a recorded log, for the environment and for `compare --plant`.

    The log is a table with a heading; each row holds the temperature at its time and the flow
    commanded from that time on.
    """

    log: Path = field(kw_only=False)
    """The log, a CSV file."""
    out: Folder = Path("results/identify")
    time: str = "time"
    """Column of the times, numbers or dates."""
    flow: str = "flow"
    """Column of the flow."""
    temperature: str = "temperature"
    """Column of the temperature."""
    disturbance: tuple[str, ...] = ()
    """Column of a measured disturbance (repeatable)."""
    time_unit: Literal["ms", "s", "min", "h", "D"] = "s"
    """Unit of the times, unless these are dates; D are days."""
    flow_unit: str = "t/h"
    """Unit of the flow, for the report."""
    temperature_unit: str = "°C"
    """Unit of the temperature, for the report."""
    applied: bool = False
    """The flow was measured behind the valve, so that there is no dead zone to be found."""
    operating_flow: Finite | None = None
    """Flow at the operating point, the centre of the dead zone (default: found by the fit)."""
    u_min: Finite | None = None
    """Smallest flow, from the operating point (default: the log's)."""
    u_max: Finite | None = None
    """Largest flow, from the operating point (default: the log's)."""


def work(options: Options) -> str:
    """Identify a plant from a log and write the results."""
    from benchmarks.lib.report import write_report  # here: slow to import, as the next one
    from benchmarks.loop.identification import identify

    provenance = origin()
    log = read_log(options)
    plant = identify(log, options.operating_flow, applied=options.applied)
    arguments = plant_arguments(plant, options)
    ranges = arguments | plant_ranges(plant, arguments)
    check_arguments(arguments)
    check_arguments(ranges)
    title = finding(plant, options)
    with results_folder(options.out) as folder:
        write_json(folder / "plant.json", arguments)
        write_json(folder / "ranges.json", ranges)
        draw(plant, options, title, folder / "identify.png")
        write_report(folder, title, report(plant, options, arguments), provenance)
    return f"The plant and the report are in {options.out}/"


def read_log(options: Options) -> Log:
    """Read a log; `UsageError` names the column and the line of what cannot be used."""
    from benchmarks.loop.identification import Log

    table = read_table(options.log)
    names = [options.time, options.flow, options.temperature, *options.disturbance]
    if len(set(names)) < len(names):
        raise UsageError(f"a column can have one meaning only, got {', '.join(names)}")
    for name in names:
        if name not in table:
            columns = ", ".join(map(repr, table))
            raise UsageError(
                f"the log has no column {name!r}; it has {columns}. Name the right ones with "
                "--time, --flow, --temperature and --disturbance"
            )
    interval, samples = sampled(times(table[options.time], options.time_unit))
    numbers = table[names[1:]].apply(to_numbers)
    rows = numbers.set_index(samples).reindex(np.arange(samples[-1] + 1))[-MOST:]
    for name, count in zip(names[1:], rows.isna().sum(), strict=True):
        if len(rows) - count < max(FEWEST, len(rows) / 2.0):
            raise UsageError(f"{count} of {len(rows)} values of {name!r} are missing")
    held = rows.ffill().bfill()
    flow = held[options.flow].to_numpy()
    for name in (options.flow, options.temperature):
        if np.ptp(held[name]) <= 1e-9 * held[name].abs().max():
            raise UsageError(f"{name!r} is constant: the log does not show a response")
    operating_flow, span = options.operating_flow, np.ptp(flow)
    if operating_flow is not None and not (
        flow.min() - span <= operating_flow <= flow.max() + span
    ):
        raise UsageError(
            f"operating_flow must be near the flows of the log, {flow.min():g} to "
            f"{flow.max():g}, got {operating_flow:g}"
        )
    disturbances = held[[*options.disturbance]].to_numpy()
    return Log(flow, rows[options.temperature].to_numpy(), interval, disturbances)


def read_table(path: Path) -> pd.DataFrame:
    """Return the table of a file as texts, with None in empty cells.

    The separator may be a comma, a semicolon or a tab.
    """
    import pandas as pd  # here: slow to import

    try:
        text = path.read_text(encoding="utf-8-sig", errors="replace")
        heading = text.partition("\n")[0]
        separator = next((mark for mark in ";\t" if mark in heading), ",")
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)  # of too many cells
            table = pd.read_csv(
                io.StringIO(text), sep=separator, dtype=str, skipinitialspace=True,
                skip_blank_lines=False, index_col=False,
            )  # fmt: skip
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror}") from error
    except (pd.errors.EmptyDataError, pd.errors.ParserError, pd.errors.ParserWarning) as error:
        raise UsageError(
            f"{path} is not a table: {str(error).strip()}. With decimal commas, the separator "
            "must be a semicolon or a tab, or the numbers in quotes"
        ) from error
    if len(table) < FEWEST:
        raise UsageError(f"the log has {len(table)} rows; it must have at least {FEWEST}")
    # Where commas separate the columns, a point is a decimal point.
    table.attrs["marks"] = "," if separator == "," else ".,"
    return table


def to_numbers(column: pd.Series[str]) -> pd.Series[float]:
    """Return texts as numbers; `UsageError` names the line of a text that is none."""
    import pandas as pd

    marked = column[column.str.contains(f"[{column.attrs['marks']}]", na=False)]
    if len(marked) and marked.str.fullmatch(THOUSANDS).all():
        raise UsageError(
            f"line {marked.index[0] + 2}: {column.name} looks like thousands: "
            f"{marked.iloc[0]!r}. Write the numbers without separators of thousands, or, if "
            "these are decimals, with another number of digits behind the decimal mark"
        )
    numbers = pd.to_numeric(column.str.replace(",", "."), errors="coerce").astype(np.float64)
    refuse(column, ~(numbers.abs() < LARGEST) & column.notna(), "a number")
    return numbers


def times(column: pd.Series[str], unit: Any) -> Array:
    """Return the times of a column of numbers or dates, in seconds."""
    import pandas as pd

    numbers = pd.to_numeric(column.str.replace(",", "."), errors="coerce")
    if numbers.count() > len(column) / 2:
        refuse(column, numbers.isna(), "a number or a date")
        seconds = pd.Timedelta(1, unit).total_seconds()
        return np.asarray(seconds * to_numbers(column).to_numpy(), np.float64)
    # Dates of ISO 8601 begin with the year, all others with the day.
    form: Any = "ISO8601" if str(column.iloc[0])[:4].isdigit() else None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of a form that pandas has to guess
        dates = pd.to_datetime(
            column, errors="coerce", utc=True, format=form, dayfirst=form is None
        )
    refuse(column, dates.isna(), "a date")
    return np.asarray((dates - dates.iloc[0]) / pd.Timedelta(seconds=1), np.float64)


def refuse(column: pd.Series[str], is_bad: pd.Series[bool], allowed: str) -> None:
    """Raise a `UsageError` that names the first line that is bad."""
    if is_bad.any():
        line = int(np.argmax(is_bad)) + 2
        raise UsageError(
            f"line {line}: {column.name} must be {allowed}, got {column[is_bad].iloc[0]!r}. "
            "Leave the cells of missing values empty"
        )


def sampled(seconds: Array) -> tuple[float, NDArray[np.int64]]:
    """Return the sampling interval (s), and the number of the sample of each row.

    A row may come a third of a sample early or late.
    """
    steps = np.diff(seconds)
    median = float(np.median(steps))
    interval = float(f"{np.mean(steps[np.abs(steps / median - 1.0) < 0.5]):.6g}")
    samples = np.round((seconds - seconds[0]) / interval)
    lateness = (seconds - seconds[0]) / interval - samples
    for is_bad, advice in (
        (steps <= 0.0, "times must increase. Sort the rows, and remove repeated ones"),
        (steps > LONGEST_GAP * interval, "rows are missing before it. Divide the log there"),
        (np.diff(samples) < 1.0, f"most steps are {interval:g} s. Resample the log"),
        (np.abs(lateness[1:]) > 0.4, f"most steps are {interval:g} s. Resample the log"),
        (steps < 1e-4, "if the times are days, say --time-unit D"),
    ):
        if is_bad.any():
            row = int(np.argmax(is_bad))
            raise UsageError(f"line {row + 3}: a time step of {steps[row]:g} s: {advice}")
    return interval, samples.astype(np.int64)


def doubts(plant: Identified, options: Options) -> list[str]:
    """Return why the plant may be wrong, in a sentence each."""
    from benchmarks.loop.identification import distinct_flows

    log, gain = plant.fit.log, plant.estimates["gain"]
    flows = distinct_flows(log.flow)
    temperature = log.temperature[np.isfinite(log.temperature)]
    moves = np.diff(temperature)
    is_straight = (np.abs(np.diff(moves)) < 1e-6 * np.ptp(temperature)) & (
        np.abs(moves[1:]) > 1e-4 * np.ptp(temperature)
    )
    changes = np.flatnonzero(np.r_[True, moves != 0.0, True])
    longest = int(np.diff(changes).max())
    conditions = {
        "The model explains only "
        f"{max(100 * plant.explained, 0):.0f} % of the temperature in the last third of the "
        "log: the plant changes, or something else moves it.": plant.explained < 0.5,
        "The prediction errors are not white noise: the plant or its disturbances are not of "
        "the model's form, and the intervals are too narrow.": not plant.is_white,
        f"The flow had only {flows} values: a dead zone cannot be found.":
        flows < 3 and not options.applied,
        "The direction in which the temperature answers is not known: the interval of the "
        "gain holds 0.": gain.low <= 0.0 <= gain.high,
        "The delay may be longer than a sixth of the log, which is as long as is looked for.":
        plant.estimates["delay"].high >= len(log.flow) / 6.0,
        "The temperature lies on straight lines between few values, as a compressing "
        "historian keeps it: the delay and the intervals are not reliable.":
        bool(np.mean(is_straight) > 1.0 / 3.0),
        f"The temperature is frozen: {longest} rows in succession have the same value.":
        longest > max(20, len(log.flow) / 20),
        "The flow follows the temperature, and nothing else moves it: in a closed loop with a "
        "constant set point, a log shows the controller and not the plant.":
        follows(log.flow, log.temperature),
    }  # fmt: skip
    return [sentence for sentence, holds in conditions.items() if holds]


def follows(flow: Array, temperature: Array) -> bool:
    """Return whether the moves of the flow are a linear function of the last temperatures."""
    columns = [temperature[2:], temperature[1:-1], temperature[:-2], flow[1:-1]]
    table = np.column_stack([*columns, np.ones(len(flow) - 2), np.diff(flow)[1:]])
    table = table[np.isfinite(table).all(axis=1)]
    regressors, moves = table[:, :-1], table[:, -1]
    errors = moves - regressors @ np.linalg.lstsq(regressors, moves, rcond=None)[0]
    return bool(np.var(errors) < 0.02 * np.var(moves))


def plant_arguments(plant: Identified, options: Options) -> dict[str, Any]:
    """Return the arguments of `MiddlePoint-v0` for the plant.

    The set point stays the environment's default where the plant can follow it; otherwise it is
    smaller and slower.
    """
    log, dynamics, defaults = plant.fit.log, plant.fit.dynamics, Parameters()
    delay = round(dynamics.delay / log.sampling_interval)
    b, a = dynamics.sampled(log.sampling_interval, delay)
    c, variance = plant.noise(a)
    flow = log.flow - plant.operating_flow
    u_min = float(flow.min()) if options.u_min is None else options.u_min
    u_max = float(flow.max()) if options.u_max is None else options.u_max
    largest, smallest = max(abs(u_min), abs(u_max)), min(abs(u_min), abs(u_max))
    gain = abs(plant.fit.gain)
    amplitude = float(f"{0.8 * gain * (smallest or largest):.2g}")
    span = float(f"{1.5 * gain * largest:.2g}")
    settling = delay + round(4.0 * (dynamics.slow + dynamics.fast) / log.sampling_interval)
    suited = {
        "setpoint_amplitude": min(amplitude, defaults.setpoint_amplitude),
        "setpoint_period": max(2 * settling, defaults.setpoint_period),
        "temperature_span": max(span, defaults.temperature_span),
    }
    return {
        "a": a.tolist(),
        "b": (plant.fit.gain * b).tolist(),
        "c": c.tolist(),
        "delay": delay,
        "dead_zone": plant.fit.zone.half_width,
        "u_min": u_min,
        "u_max": u_max,
        "noise_variance": variance,
        "sampling_interval": log.sampling_interval,
    } | {name: value for name, value in suited.items() if value != getattr(defaults, name)}


def plant_ranges(plant: Identified, arguments: dict[str, Any]) -> dict[str, list[float]]:
    """Return the 95 % intervals as ranges of the environment's arguments."""
    delay, zone, gain, time_constant = (
        plant.estimates[name] for name in ("delay", "dead_zone", "gain", "time_constant")
    )
    largest = max(-arguments["u_min"], arguments["u_max"])
    spread = 2.0 * np.sqrt(2.0 / len(plant.fit.log.flow))  # of a variance, relative to it
    factors = sorted([gain.low / gain.value, gain.high / gain.value])
    # The environment's time constant is 1 / (1 - pole) samples, and at least 1.
    rate = 1.0 - slowest_pole(arguments["a"]).real
    interval = arguments["sampling_interval"]
    low, high = (-rate / np.expm1(-interval / limit) for limit in time_constant[1:])
    ranges = {
        "delay": [round(delay.low), round(delay.high)],
        "dead_zone": [zone.low, min(zone.high, 0.99 * largest)],
        "noise_variance": [arguments["noise_variance"] * (1.0 + x) for x in (-spread, spread)],
        "gain_factor": np.clip(factors, 0.1, 10.0).tolist(),
        "time_constant_factor": [max(float(low), 1.000001 * rate), min(float(high), 10.0)],
    }
    return {name: limits for name, limits in ranges.items() if limits[0] < limits[1]}


def check_arguments(arguments: dict[str, Any]) -> None:
    """Raise a `UsageError` if the environment does not take the arguments of a plant."""
    try:
        Parameters(**arguments)
    except ValueError as error:
        raise UsageError(
            f"the environment does not have such a plant: {error}. Scale the columns of the "
            "log, and name their units with --flow-unit and --temperature-unit"
        ) from error


def finding(plant: Identified, options: Options) -> str:
    """Return a sentence with the gain and the delay."""
    gain, delay = plant.fit.gain, plant.fit.dynamics.delay
    return (
        f"One {options.flow_unit} more moves the temperature of {options.log.name} by "
        f"{gain:+.3g} {options.temperature_unit}, after a delay of {delay:.3g} s"
    )


def report(plant: Identified, options: Options, arguments: dict[str, Any]) -> list[Section]:
    """Return the sections of the report."""
    import pandas as pd

    from benchmarks.lib.report import Section

    log, flow, degree = plant.fit.log, options.flow_unit, options.temperature_unit
    units = {"delay": "samples", "dead_zone": flow, "gain": f"{degree} per {flow}"}
    rows = []
    for name, (value, low, high) in plant.estimates.items():
        limits = f"[{low:.4g}, {high:.4g}]"
        rows.append((name.replace("_", " "), f"{value:.4g}", limits, units.get(name, "s")))
    centre = plant.operating_flow
    text = [
        f"**{sentence}**" for sentence in doubts(plant, options)
    ] + [
        f"The model explains {100 * max(plant.explained, 0.0):.1f} % of the temperature's "
        "variance in the last third of the log, when it is fitted to the first two thirds and "
        "simulates the last one from the flow alone.",
        f"The log has {len(log.flow):,} samples of {log.sampling_interval:g} s, and "
        f"{np.isnan(log.temperature).sum()} of their temperatures are missing.",
        f"All numbers are deviations from the operating point: a flow of {centre:.4g} {flow}, "
        f"at which the temperature is {plant.operating_temperature:.4g} {degree}. The flow can "
        f"be between {centre + arguments['u_min']:.4g} and {centre + arguments['u_max']:.4g} "
        f"{flow}. Brackets are 95 % intervals.",
    ]  # fmt: skip
    if plant.fit.loads:
        starts = ", ".join(f"{start / 60.0:.0f}" for start in sorted(plant.fit.loads))
        text.append(f"Unmeasured loads seem to have changed {starts} min after the first row.")
    if not plant.may_show_zone and not options.applied:
        text.append(
            "The flow had too few values to show a dead zone: any below them is possible."
        )
    if options.disturbance:
        text.append(f"plant.json does not hold the effect of {', '.join(options.disturbance)}.")
    plant_file = options.out / "plant.json"
    text.append(
        f"`python -m benchmarks.compare --plant {plant_file}` compares controllers on it."
    )
    table = pd.DataFrame(rows, columns=["", "value", "95 %", "unit"])
    shown = "The log as it was recorded, and as the model simulates it from the flow"
    return [Section("", text, table, pictures={"identify.png": shown})]


def draw(plant: Identified, options: Options, title: str, path: Path) -> None:
    """Draw the log and the temperatures that the model simulates from its flow."""
    from benchmarks.lib.pictures import COLOURS, open_picture

    log, zone = plant.fit.log, plant.fit.zone
    minutes = log.times / 60.0
    with open_picture(path, 4.6, title) as figure:
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=[3, 2])
        above.plot(minutes, log.temperature, color="0.5", lw=1, label="recorded")
        above.plot(minutes, plant.fit.simulated, color=COLOURS[1], label="model")
        for start in plant.fit.loads:
            above.axvline(start / 60.0, color="0.5", ls=":", label="change of a load")
        above.set_ylabel(f"temperature ({options.temperature_unit})")
        below.step(minutes, log.flow, where="post", color=COLOURS[0], lw=1)
        if zone.half_width > 0.0:
            edges = zone.centre - zone.half_width, zone.centre + zone.half_width
            below.axhspan(*edges, color="0.9", label="dead zone")
            below.legend(loc="upper left")
        below.set(xlabel="time (min)", ylabel=f"flow ({options.flow_unit})")
        above.legend(loc="upper left", ncols=3)
        above.margins(y=0.2)  # room for the legend


main = command("identify", Options, work)

if __name__ == "__main__":
    raise SystemExit(main(None))
