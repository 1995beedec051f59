"""Fit a plant to a log of flows and temperatures: `python -m benchmarks.identify --help`."""

from __future__ import annotations

import codecs
import io
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.lib.command import Finite, Folder, blame, command, options
from benchmarks.lib.errors import UsageError
from benchmarks.lib.provenance import origin
from benchmarks.lib.results import results_folder
from benchmarks.lib.storage import write_json
from mptc_gym import Parameters

if TYPE_CHECKING:
    import pandas as pd

    from benchmarks.loop.identification import Fit, Log

FEWEST_ROWS = 100  # smallest number of rows in a log, so that the fit can find the delay
# Largest number of rows in a fit, to limit time and memory. Of a longer log, only the last rows
# are fitted.
MOST_ROWS = 10_000
LONGEST_GAP = 20  # longest time between two rows, in sampling intervals
MOST_MISSING = 0.2  # largest share of the values in a column that may be missing
# Matches one to three digits and then groups of three digits, each behind a point or a comma.
# The comma in 1,480 may be a decimal mark, or may separate thousands.
THOUSANDS = r"[+-]?[1-9]\d{0,2}([.,]\d{3})+"
# Finds the second number of a date such as 31.12.2025, 31/12/2025 or 12/31/2025.
SECOND_OF_DATE = r"^\d{1,2}[./-](\d{1,2})[./-]"
CAPTION = "The log as it was recorded, and as the model simulates it from the flow"


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Fit a plant to a recorded log of flows and temperatures.

    A row of the log has a time, the temperature at this time, and the flow that is commanded
    from this time on.
    """

    log: Path = field(kw_only=False)
    """CSV file with the log, whose first line has the names of the columns."""
    out: Folder = Path("results/identify")
    time: str = "time"
    """Name of the column of times, which are in seconds or are dates."""
    flow: str = "flow"
    """Name of the column of flows."""
    temperature: str = "temperature"
    """Name of the column of temperatures."""
    disturbance: tuple[str, ...] = ()
    """Name of the column of a measured disturbance (repeatable)."""
    applied: bool = False
    """The flow was measured behind the valve: the fit has no dead zone."""
    operating_flow: Finite | None = None
    """Flow at the operating point, the centre of the dead zone (default: the fit finds it)."""
    u_min: Finite | None = None
    """Smallest possible flow, minus the operating flow (default: the smallest flow of the log,
    minus the operating flow)."""
    u_max: Finite | None = None
    """Largest possible flow, minus the operating flow (default: the largest flow of the log,
    minus the operating flow)."""


def work(options: Options) -> str:
    """Fit a plant to a log, write the results, and return the last message for the user."""
    # SciPy reads this variable when SciPy is imported. With small matrices, several threads are
    # slower than one thread, as the threads wait for each other.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

    from benchmarks.lib.report import Section, write_report  # imported here, as it is slow
    from benchmarks.loop.identification import (
        estimates,
        explained_share,
        identify,
        possible_zones,
    )

    provenance = origin()
    log = read_log(options)
    zones = possible_zones(log.flow, options.operating_flow, applied=options.applied)
    fit = identify(log, zones)
    intervals = estimates(fit)
    explained = explained_share(fit)
    arguments = plant_arguments(fit, options)
    ranges = arguments | argument_ranges(intervals, arguments)
    with blame("the environment cannot be such a plant"):
        Parameters(**ranges)
    title = (
        f"A flow that is larger by 1 changes the temperature of {options.log.name} by "
        f"{fit.unknowns.gain:+.3g} after a delay of "
        f"{fit.unknowns.delay * log.sampling_interval:.3g} s"
    )
    with results_folder(options.out) as folder:
        write_json(folder / "plant.json", arguments)
        write_json(folder / "ranges.json", ranges)
        draw(fit, title, folder / "identify.png")
        text = [f"Warning: {sentence}" for sentence in doubts(fit, intervals, explained)]
        text += findings(fit, explained, arguments, options)
        section = Section("", text, table_of(intervals), pictures={"identify.png": CAPTION})
        write_report(folder, title, [section], provenance)
    return f"The plant and the report are in {options.out}/"


def read_log(options: Options) -> Log:
    """Return the log in the CSV file `options.log`, with the missing values filled in.

    Of a log with more than `MOST_ROWS` samples, only the last `MOST_ROWS` samples are returned.
    A missing temperature is interpolated between the rows before and after. A missing flow or
    disturbance gets the latest earlier value or, before the first value of its column, the
    first value. A `UsageError` says why a log cannot be used.
    """
    import pandas as pd  # imported here, as it is slow

    from benchmarks.loop.identification import Log

    table, separator = read_table(options.log)
    names = [options.flow, options.temperature, *options.disturbance]
    for name in [options.time, *names]:
        if name not in table:
            columns = ", ".join(map(repr, table))
            raise UsageError(
                f"the log must have a column {name!r}, but the columns are {columns}. Name the "
                "columns with --time, --flow, --temperature and --disturbance"
            )
    if len({options.time, *names}) < len(names) + 1:
        raise UsageError(
            "--time, --flow, --temperature and --disturbance must name different columns, got "
            f"{', '.join([options.time, *names])}"
        )
    samples, interval = sample_numbers(read_times(table[options.time], separator))
    numbers = pd.DataFrame({name: read_numbers(table[name], separator) for name in names})
    # Samples that are missing in the log become rows without values.
    numbers = numbers.set_axis(samples).reindex(range(samples[-1] + 1))[-MOST_ROWS:]
    for name in names:
        share = numbers[name].isna().mean()
        if share > MOST_MISSING:
            raise UsageError(
                f"at most {100 * MOST_MISSING:.0f} % of the values in the column {name!r} may "
                f"be missing, got {100 * share:.0f} %"
            )
    filled = numbers.ffill().bfill()
    temperature = numbers[options.temperature].interpolate(limit_direction="both")
    filled[options.temperature] = temperature
    for name in (options.flow, options.temperature):
        if np.ptp(filled[name]) <= 1e-9 * filled[name].abs().max():
            raise UsageError(f"the column {name!r} must have at least two different values")
    flow = filled[options.flow].to_numpy()
    centre = options.operating_flow
    if centre is not None and np.abs(flow - centre).min() > np.ptp(flow):
        raise UsageError(
            f"--operating-flow must be near the flows of the log, which are {flow.min():g} to "
            f"{flow.max():g}, got {centre:g}"
        )
    disturbances = filled[[*options.disturbance]].to_numpy()
    missing_flows = float(numbers[options.flow].isna().mean())
    return Log(flow, temperature.to_numpy(), disturbances, interval, missing_flows)


def read_table(path: Path) -> tuple[pd.DataFrame, str]:
    """Return the table in a CSV file, and the character that separates the columns.

    The values of the table are strings, and NaN for empty cells. The separator is a semicolon
    or a tab if the first line of the file contains one, and otherwise a comma. A `UsageError`
    is raised if the file cannot be read, is not a table, or has fewer than `FEWEST_ROWS` rows.
    """
    import pandas as pd

    try:
        text = decoded(path.read_bytes()).rstrip()
        heading = text.partition("\n")[0]
        separator = next((mark for mark in ";\t" if mark in heading), ",")
        table = pd.read_csv(
            io.StringIO(text), sep=separator, dtype=str, skipinitialspace=True,
            skip_blank_lines=False,
        )  # fmt: skip
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror}") from error
    except (pd.errors.EmptyDataError, pd.errors.ParserError) as error:
        raise UsageError(f"{path} must be a table: {str(error).strip()}") from error
    # If rows are longer than the heading, pandas takes the first column as the index.
    if not isinstance(table.index, pd.RangeIndex):
        raise UsageError(
            f"no row of {path} may have more cells than the first row. Write numbers with "
            "decimal commas in quotes, or separate the columns by semicolons or tabs"
        )
    if len(table) < FEWEST_ROWS:
        raise UsageError(f"the log must have at least {FEWEST_ROWS} rows, got {len(table)}")
    return table.apply(lambda column: column.str.strip()), separator


def decoded(content: bytes) -> str:
    """Return the text of a file in UTF-8, in UTF-16 with a byte order mark, or in Windows-1252.

    Spreadsheets write Windows-1252 in western Europe, for instance in the heading "Temp °C".
    """
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return content.decode("utf-16", errors="replace")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("cp1252", errors="replace")


def read_numbers(column: pd.Series[str], separator: str) -> pd.Series[float]:
    """Return the numbers in a column of strings, with NaN for empty cells.

    A `UsageError` names the first line whose text is not a number of a magnitude below 1e30. A
    `UsageError` is also raised if the points or commas in the column probably separate
    thousands, as in 1,480. `separator` is the character between the columns of the CSV file.
    """
    import pandas as pd

    numbers = pd.to_numeric(column.str.replace(",", "."), errors="coerce").astype(np.float64)
    # Where commas separate the columns, a point is a decimal point.
    marks = "," if separator == "," else ".,"
    has_mark = column.str.contains(f"[{marks}]", na=False)
    marked = column[has_mark]
    looks_like_thousands = bool(has_mark.any() and marked.str.fullmatch(THOUSANDS).all())
    if separator != ",":
        # If semicolons or tabs separate the columns, a point or a comma in a number is often a
        # decimal mark. The points or commas probably separate thousands if the numbers with
        # points or commas then continue the range of all other numbers: 850, 900, 1.100.
        sizes = numbers.abs()
        smallest_with_thousands = 1000.0 * sizes[has_mark].min()
        looks_like_thousands &= bool(smallest_with_thousands < 10.0 * sizes[~has_mark].max())
    if looks_like_thousands:
        raise UsageError(
            f"line {marked.index[0] + 2}: {column.name} must not have separators of thousands, "
            f"got {marked.iloc[0]!r}. If the points or commas are decimal marks, write more or "
            "fewer than three decimals"
        )
    # The square of a number beyond 1e30 might not be finite.
    is_bad = ~(numbers.abs() < 1e30) & column.notna()
    refuse(column, is_bad, "a number, or empty if the value is missing")
    return numbers


def read_times(column: pd.Series[str], separator: str) -> NDArray[np.float64]:
    """Return the times of a column of numbers (s) or dates, in seconds, shape (rows,).

    Dates are converted to seconds since the first row. If more than half of the cells are
    numbers, all cells must be numbers; otherwise, all cells must be dates. A `UsageError` names
    the first line whose cell is empty or has another text. `separator` is the character between
    the columns of the CSV file.
    """
    import pandas as pd

    numbers = pd.to_numeric(column.str.replace(",", "."), errors="coerce")
    if numbers.count() > len(column) / 2:
        times = read_numbers(column, separator)
    else:
        is_iso = str(column.iloc[0])[:4].isdigit()  # ISO 8601 begins with the year
        form: Any = "ISO8601" if is_iso else "mixed"
        # Dates in other forms are taken to begin with the day, unless the second number of a
        # date is too large for a month.
        second_numbers = column.str.extract(SECOND_OF_DATE, expand=False).astype(np.float64)
        day_first = not is_iso and not (second_numbers > 12.0).any()
        dates = pd.to_datetime(
            column, errors="coerce", utc=True, format=form, dayfirst=day_first
        )
        times = (dates - dates.iloc[0]).dt.total_seconds()
    refuse(column, times.isna(), "a number or a date, such as 2025-12-31 12:00")
    return np.asarray(times, np.float64)


def refuse(column: pd.Series[str], is_bad: pd.Series[bool], allowed: str) -> None:
    """Raise a `UsageError` that names the first line in which `is_bad` is true, if any.

    `allowed` says what the column must contain, such as "a number".
    """
    if is_bad.any():
        line = int(np.argmax(is_bad)) + 2
        text = column[is_bad].iloc[0]
        raise UsageError(f"line {line}: {column.name} must be {allowed}, got {text!r}")


def sample_numbers(times: NDArray[np.float64]) -> tuple[NDArray[np.int64], float]:
    """Return the sample number of each row, counted from 0, and the sampling interval, s.

    A gap in the rows is a gap in the sample numbers. `times` has the time of each row, s, shape
    (rows,). A `UsageError` is raised if the times do not increase, if a row is more than 0.4
    sampling intervals early or late, if two rows belong to one sample, or if two successive
    rows are more than `LONGEST_GAP` sampling intervals apart.
    """
    steps = np.diff(times)
    is_usual = np.abs(steps / np.median(steps) - 1.0) < 0.5
    interval = float(f"{np.mean(steps[is_usual]):.6g}")
    exact_samples = (times - times[0]) / interval
    samples = np.round(exact_samples)
    is_irregular = np.abs(exact_samples - samples)[1:] > 0.4
    is_irregular |= np.diff(samples) < 1.0  # two rows in one sample
    gap = (
        f"at most {LONGEST_GAP} sampling intervals may lie between two rows. Divide the log at "
        "the gap. If the dates begin with the month, write dates such as 2025-12-31"
    )
    for is_bad, advice in (
        (steps <= 0.0, "times must increase. Sort the rows, and remove repeated rows"),
        (steps > LONGEST_GAP * interval, gap),
        (is_irregular, f"most time steps are {interval:g} s. Resample the log"),
    ):
        if is_bad.any():
            row = int(np.argmax(is_bad))
            raise UsageError(
                f"line {row + 3} comes {steps[row]:g} s after the line before, but {advice}"
            )
    return samples.astype(np.int64), interval


def doubts(fit: Fit, intervals: pd.DataFrame, explained: float) -> list[str]:
    """Return warnings for the report: a sentence for each reason why a fit may be wrong.

    `intervals` is the table that the function `estimates` returns, and `explained` is the share
    of the temperature's variance that the model explains, a result of `explained_share`.
    """
    sentences = []
    log = fit.log
    if not can_be_checked(log):
        sentences.append(
            "The flow is constant in the last third of the log, so the model could not be "
            "checked on new rows."
        )
    elif explained < 0.5:
        sentences.append(
            f"The model explains only {100 * max(explained, 0.0):.0f} % of the variance "
            "of the temperature in the last third of the log: the plant has changed, or "
            "something other than the flow has changed the temperature."
        )
    if not is_white(fit.errors):
        sentences.append(
            "The prediction errors are not white noise: the model cannot describe the plant or "
            "the disturbances exactly, and the 95 % intervals are too narrow."
        )
    # `possible_zones` returns two dead zones if the flow has fewer than three values.
    if len(fit.zones) == 2:
        sentences.append("The flow had fewer than three values: no dead zone can be found.")
    if intervals.low["gain"] <= 0.0 <= intervals.high["gain"]:
        sentences.append(
            "The interval of the gain contains 0: the sign of the gain is unknown."
        )
    # The limits of sound logs differ by a factor of less than two.
    if intervals.high["time_constant"] > 4.0 * intervals.low["time_constant"]:
        sentences.append(
            "The interval of the time constant is wide: the plant may have more lags than the "
            "model, or the log shows no undisturbed response. Do not use ranges.json."
        )
    if log.missing_flows > 0.01:
        sentences.append(
            f"{100 * log.missing_flows:.0f} % of the flows are missing and were replaced by "
            "the flow of the row before: the delay and its interval are not reliable if the "
            "flow changes in most rows."
        )
    # Temperatures of boilers and heat exchangers are not recorded ten times a second.
    if log.sampling_interval < 0.1:
        sentences.append(
            f"The sampling interval is {log.sampling_interval:g} s: the times are perhaps in "
            "another unit than seconds."
        )
    return sentences + doubts_about_sensor(log.temperature)


def can_be_checked(log: Log) -> bool:
    """Return whether the flow changes in the last third of a log."""
    return bool(np.ptp(log.flow[-(len(log.flow) // 3) :]) > 0.0)


def is_white(errors: NDArray[np.float64]) -> bool:
    """Return whether successive prediction errors, shape (blocks,), look like white noise.

    The result is true if at least three quarters of the autocorrelations of the errors, at lags
    from 1 to 30 blocks, are small enough to be due to chance, or at most 0.1 in magnitude.
    """
    correlations = np.correlate(errors, errors, "full")[len(errors) :][:30] / (errors @ errors)
    # By chance, the magnitudes of about 1 % of the autocorrelations of n errors are larger than
    # 2.5 / sqrt(n).
    # Autocorrelations up to 0.1 do no harm, even if they are not due to chance.
    is_large = np.abs(correlations) > max(0.1, 2.5 / np.sqrt(len(errors)))
    return bool(np.mean(is_large) <= 0.25)


def doubts_about_sensor(temperature: NDArray[np.float64]) -> list[str]:
    """Return a warning for each sign that temperatures, shape (rows,), are not measurements."""
    sentences = []
    moves = np.diff(temperature)
    span = np.ptp(temperature)
    is_straight = np.abs(np.diff(moves)) < 1e-6 * span
    is_moving = np.abs(moves[1:]) > 1e-4 * span
    if np.mean(is_straight & is_moving) > 1.0 / 3.0:
        sentences.append(
            "The temperature lies on straight lines between few values, as a historian that "
            "compresses data stores it: the delay and the 95 % intervals are not reliable."
        )
    changes = np.flatnonzero(np.r_[True, moves != 0.0, True])
    longest = int(np.diff(changes).max())  # number of rows in succession with one value
    if longest > max(20, len(temperature) / 20):
        sentences.append(
            f"The temperature is frozen: {longest} rows in succession have the same value."
        )
    # Single wrong readings, such as 0 or -9999, lie outside the range of 98 % of all readings.
    low, high = np.quantile(temperature, [0.01, 0.99])
    is_outlier = np.abs(temperature - (low + high) / 2.0) > 3.0 * (high - low)
    if 0 < np.sum(is_outlier) < len(temperature) / 100.0:
        sentences.append(
            f"{np.sum(is_outlier)} temperatures lie far outside the range of the others: "
            f"remove values that are not measurements, such as {temperature[is_outlier][0]:g}."
        )
    return sentences


def plant_arguments(fit: Fit, options: Options) -> dict[str, Any]:
    """Return the arguments of the environment `MiddlePoint-v0` for the plant of a fit.

    The limits of the flow in the result are deviations from the centre of the dead zone, t/h.
    If the plant cannot follow the environment's default set point, the result has a set point
    with a smaller amplitude, a longer period, or both.
    """
    from benchmarks.loop.identification import polynomials

    defaults = Parameters()
    delay = round(fit.unknowns.delay)
    a, b, c, noise_variance = polynomials(fit, delay)
    flow = fit.log.flow - fit.zone.centre
    u_min = float(flow.min()) if options.u_min is None else options.u_min
    u_max = float(flow.max()) if options.u_max is None else options.u_max
    smaller_limit, larger_limit = sorted([-u_min, u_max])
    # The set point changes its sign, so the limit closer to 0 decides how large the set point
    # can be. But with a limit that is very close to 0, the set point would hardly change.
    usable_limit = larger_limit if is_one_sided(u_min, u_max) else smaller_limit
    gain = abs(fit.unknowns.gain)
    settling = delay + round(4.0 * (fit.unknowns.slow + fit.unknowns.fast))  # samples
    return {
        "a": a.tolist(),
        "b": b.tolist(),
        "c": c.tolist(),
        "delay": delay,
        "dead_zone": fit.zone.half_width,
        "u_min": u_min,
        "u_max": u_max,
        "noise_variance": noise_variance,
        "sampling_interval": fit.log.sampling_interval,
        "setpoint_amplitude": min(0.6 * (gain * usable_limit), defaults.setpoint_amplitude),
        "setpoint_period": max(2 * settling, defaults.setpoint_period),
        "temperature_span": max(1.5 * (gain * larger_limit), defaults.temperature_span),
    }


def is_one_sided(u_min: float, u_max: float) -> bool:
    """Return whether one limit of the flow is much closer to 0 than the other limit.

    The limits `u_min` and `u_max`, t/h, are deviations from the operating flow.
    """
    return min(-u_min, u_max) < 0.2 * max(-u_min, u_max)


def argument_ranges(
    intervals: pd.DataFrame, arguments: dict[str, Any]
) -> dict[str, list[float]]:
    """Return 95 % intervals of arguments of the environment, as ranges [low, high] by name.

    An argument whose interval has the length 0 is left out. `intervals` is the table that the
    function `estimates` returns, and `arguments` is a result of `plant_arguments`.
    """
    limits = intervals[["low", "high"]].T
    largest_flow = max(-arguments["u_min"], arguments["u_max"])
    gain_factors = limits.gain / intervals.value["gain"]
    # The environment divides 1 - p, where p is the slowest pole of the plant, by the time
    # constant factor, which must be at least 1 - p.
    rates = 1.0 - np.exp(-arguments["sampling_interval"] / intervals.loc["time_constant"])
    lag_factors = np.clip(
        rates["value"] / rates[["low", "high"]], 1.000001 * rates["value"], 10.0
    )
    ranges = {
        "delay": [round(delay) for delay in limits.delay],
        "dead_zone": limits.dead_zone.clip(upper=0.99 * largest_flow).tolist(),
        "gain_factor": sorted(gain_factors.clip(0.1, 10.0)),
        "time_constant_factor": lag_factors.tolist(),
    }
    return {name: pair for name, pair in ranges.items() if pair[0] < pair[1]}


def findings(
    fit: Fit, explained: float, arguments: dict[str, Any], options: Options
) -> list[str]:
    """Return the paragraphs of the report that describe a fit and the plant.

    `explained` is the share of the temperature's variance that the model explains, a result of
    `explained_share`, and `arguments` is a result of `plant_arguments`.
    """
    log, centre = fit.log, fit.zone.centre
    text = []
    if can_be_checked(log):
        text.append(
            f"The model explains {100 * max(explained, 0.0):.1f} % of the variance of the "
            "temperature in the last third of the log, when it is fitted to the first two "
            "thirds and simulates the last third from the flow and the measured disturbances."
        )
    text += [
        f"The log has {len(log.flow):,} samples of {log.sampling_interval:g} s.",
        "The delay is in samples, the time constant in seconds, the dead zone (half of its "
        "width) in the unit of the flow, and the gain in the unit of the temperature per unit "
        "of the flow.",
        f"The operating point is a flow of {centre:.4g}, at which the temperature is "
        f"{fit.operating_temperature:.4g}. The flow can be between "
        f"{centre + arguments['u_min']:.4g} and {centre + arguments['u_max']:.4g}. The numbers "
        "in plant.json are deviations from the operating point.",
    ]
    if fit.unknowns.fast > 0.0:
        fast = log.sampling_interval * fit.unknowns.fast
        text.append(
            "The plant has two lags. The table has the larger time constant; the smaller time "
            f"constant is {fast:.3g} s."
        )
    if fit.load_steps:
        minutes = [log.sampling_interval * row / 60.0 for row in sorted(fit.load_steps)]
        times = ", ".join(f"{minute:.0f}" for minute in minutes)
        text.append(
            "The model has steps of an unmeasured load at these times after the first row: "
            f"{times} min."
        )
    if is_one_sided(arguments["u_min"], arguments["u_max"]):
        text.append(
            "Warning: the flow hardly moves to one side of the operating point. Set the limits "
            "of the valve with --u-min and --u-max before you compare controllers; otherwise, "
            "no controller can follow half of the set points."
        )
    if options.disturbance:
        names = ", ".join(options.disturbance)
        text.append(f"The plant in plant.json does not respond to {names}.")
    text.append(
        "The following command compares controllers on the plant: python -m "
        f"benchmarks.compare --plant {options.out / 'plant.json'}"
    )
    return text


def table_of(intervals: pd.DataFrame) -> pd.DataFrame:
    """Return a plant's estimated parameters and 95 % intervals as a table of strings."""
    texts = intervals.map("{:.4g}".format)
    texts["95 % interval"] = "[" + texts.low + ", " + texts.high + "]"
    texts.insert(0, "", texts.index.str.replace("_", " "))
    return texts.drop(columns=["low", "high"])


def draw(fit: Fit, title: str, path: Path) -> None:
    """Draw a log and the temperature that a fitted model simulates, in the PNG file `path`."""
    from benchmarks.lib.pictures import COLOURS, DEAD_ZONE, open_picture

    log = fit.log
    minutes = log.sampling_interval * np.arange(len(log.flow)) / 60.0
    with open_picture(path, 4.6, title) as figure:
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=[3, 2])
        above.plot(minutes, log.temperature, color="0.5", lw=1, label="recorded")
        fitted = slice(fit.first_row, None)
        above.plot(minutes[fitted], fit.simulated[fitted], color=COLOURS[1], label="model")
        for number, row in enumerate(fit.load_steps):
            label = "step of a load" if number == 0 else None
            above.axvline(minutes[row], color="0.5", ls=":", label=label)
        above.set_ylabel("temperature")
        above.legend(loc="upper left", ncols=3)
        above.margins(y=0.2)  # room for the legend
        below.step(minutes, log.flow, where="post", color=COLOURS[0], lw=1)
        if fit.zone.half_width > 0.0:
            lower_edge = fit.zone.centre - fit.zone.half_width
            upper_edge = fit.zone.centre + fit.zone.half_width
            below.axhspan(lower_edge, upper_edge, label="dead zone", **DEAD_ZONE)
            below.legend(loc="upper left")
        below.set(xlabel="time (min)", ylabel="flow")


main = command("identify", Options, work)

if __name__ == "__main__":
    raise SystemExit(main(None))
