"""Identify the plant of a recorded log: `python -m benchmarks.identify --help`."""

from __future__ import annotations

import io
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.lib.command import Finite, Folder, command, options
from benchmarks.lib.errors import UsageError
from benchmarks.lib.provenance import origin
from benchmarks.lib.results import results_folder
from benchmarks.lib.storage import write_json
from mptc_gym import Parameters

if TYPE_CHECKING:
    import pandas as pd

    from benchmarks.loop.identification import Fit, Log

FEWEST_ROWS = 100  # of a log; a shorter log hardly shows a delay and a lag
MOST_ROWS = 10_000  # that are used: the last rows of a longer log, to limit time and memory
LONGEST_GAP = 20  # sampling intervals between two rows; longer gaps are not interpolated
MOST_MISSING = 0.2  # largest share of the values of a column that may be missing
# Matches texts of one to three digits and then groups of three digits: in the text 1,480, the
# comma may be a decimal mark or may separate thousands.
THOUSANDS = r"[+-]?[1-9]\d{0,2}([.,]\d{3})+"
CAPTION = "The log as it was recorded, and as the model simulates it from the flow"


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
    """Column of the times, in seconds or as dates."""
    flow: str = "flow"
    """Column of the flow."""
    temperature: str = "temperature"
    """Column of the temperature."""
    disturbance: tuple[str, ...] = ()
    """Column of a measured disturbance (repeatable)."""
    applied: bool = False
    """The flow was measured behind the valve: the fit has no dead zone."""
    operating_flow: Finite | None = None
    """Flow at the operating point, the centre of the dead zone (default: the fit finds it)."""
    u_min: Finite | None = None
    """Smallest flow minus the operating flow (default: the smallest flow of the log)."""
    u_max: Finite | None = None
    """Largest flow minus the operating flow (default: the largest flow of the log)."""


def work(options: Options) -> str:
    """Identify the plant of a log, write the plant and a report, and return a closing line."""
    # SciPy reads this variable when SciPy is imported. With small matrices, several threads are
    # slower than one thread, as the threads wait for each other.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

    from benchmarks.lib.report import Section, write_report  # here: slow to import, as below
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
    try:
        Parameters(**ranges)
    except ValueError as error:
        raise UsageError(f"the environment cannot be such a plant: {error}") from error
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
    """Return the log in the file that the options name, with all gaps filled.

    A missing temperature is interpolated between its neighbours. A missing flow or disturbance
    gets the value of the row before. A `UsageError` is raised if the log cannot be used; the
    message says why.
    """
    from benchmarks.loop.identification import Log

    table = read_table(options.log)
    names = [options.flow, options.temperature, *options.disturbance]
    for name in [options.time, *names]:
        if name not in table:
            columns = ", ".join(map(repr, table))
            raise UsageError(
                f"the log has no column {name!r}; its columns are {columns}. Name the columns "
                "with --time, --flow, --temperature and --disturbance"
            )
    if len({options.time, *names}) < len(names) + 1:
        raise UsageError(f"a column is used twice: {', '.join([options.time, *names])}")
    rows, interval = row_numbers(read_times(table[options.time]))
    numbers = table[names].apply(read_numbers).set_index(rows)
    numbers = numbers.reindex(range(rows[-1] + 1))[-MOST_ROWS:]
    for name in names:
        share = numbers[name].isna().mean()
        if share > MOST_MISSING:
            raise UsageError(f"{100 * share:.0f} % of the values of {name!r} are missing")
    temperature = numbers[options.temperature].interpolate(limit_direction="both").to_numpy()
    held = numbers.ffill().bfill()
    flow = held[options.flow].to_numpy()
    for name, values in ((options.flow, flow), (options.temperature, temperature)):
        if np.ptp(values) <= 1e-9 * np.abs(values).max():
            raise UsageError(f"{name!r} is constant: the log does not show a response")
    operating_flow = options.operating_flow
    lowest, highest = flow.min() - np.ptp(flow), flow.max() + np.ptp(flow)
    if operating_flow is not None and not lowest <= operating_flow <= highest:
        raise UsageError(
            f"operating_flow must be near the flows of the log, {flow.min():g} to "
            f"{flow.max():g}, got {operating_flow:g}"
        )
    return Log(flow, temperature, held[[*options.disturbance]].to_numpy(), interval)


def read_table(path: Path) -> pd.DataFrame:
    """Return the table in a CSV file as texts, with NaN in empty cells.

    Columns are separated by semicolons or tabs if the first line of the file has one, and
    otherwise by commas. A `UsageError` is raised if the file is not such a table or has fewer
    than `FEWEST_ROWS` rows. The entry "marks" of the table's `attrs` has the possible decimal
    marks.
    """
    import pandas as pd  # here: slow to import

    try:
        text = path.read_text(encoding="utf-8-sig", errors="replace")
        heading = text.partition("\n")[0]
        separator = next((mark for mark in ";\t" if mark in heading), ",")
        table = pd.read_csv(
            io.StringIO(text), sep=separator, dtype=str, skipinitialspace=True,
            skip_blank_lines=False,
        )  # fmt: skip
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror}") from error
    except (pd.errors.EmptyDataError, pd.errors.ParserError) as error:
        raise UsageError(f"{path} is not a table: {str(error).strip()}") from error
    for name in table:
        table[name] = table[name].str.strip()
    if not isinstance(table.index, pd.RangeIndex):
        raise UsageError(
            f"{path} has rows with more cells than the heading has names. Numbers with decimal "
            "commas must be in quotes, or separated by semicolons or tabs"
        )
    if len(table) < FEWEST_ROWS:
        raise UsageError(f"the log has {len(table)} rows; it must have at least {FEWEST_ROWS}")
    # Where commas separate the columns, a point is a decimal point.
    table.attrs["marks"] = "," if separator == "," else ".,"
    return table


def read_numbers(column: pd.Series[str]) -> pd.Series[float]:
    """Return the numbers of a column of texts, with NaN for empty cells.

    `column` is a column of `read_table`. A `UsageError` names the line of the first text that
    is not a number. A `UsageError` is also raised if all texts with a decimal mark have three
    digits behind the mark, as in "1,480", because the mark may separate thousands.
    """
    import pandas as pd

    marked = column[column.str.contains(f"[{column.attrs['marks']}]", na=False)]
    if len(marked) and marked.str.fullmatch(THOUSANDS).all():
        raise UsageError(
            f"line {marked.index[0] + 2}: {column.name} looks like thousands: "
            f"{marked.iloc[0]!r}. Write the numbers without separators of thousands. If these "
            "are decimals, write another number of digits behind the decimal mark"
        )
    numbers = pd.to_numeric(column.str.replace(",", "."), errors="coerce").astype(np.float64)
    # The square of a larger number might not be finite.
    refuse(column, ~(numbers.abs() < 1e30) & column.notna(), "a number")
    return numbers


def read_times(column: pd.Series[str]) -> NDArray[np.float64]:
    """Return the times of a column of numbers (s) or dates, in seconds, shape (rows,).

    `column` is a column of `read_table`. Dates become seconds since the first row. A
    `UsageError` names the line of the first text that is neither a number nor a date.
    """
    import pandas as pd

    numbers = pd.to_numeric(column.str.replace(",", "."), errors="coerce")
    if numbers.count() > len(column) / 2:
        refuse(column, numbers.isna(), "a number or a date")
        return np.asarray(read_numbers(column), np.float64)
    # Dates of ISO 8601 begin with the year, all others with the day.
    is_iso = str(column.iloc[0])[:4].isdigit()
    form: Any = "ISO8601" if is_iso else "mixed"
    dates = pd.to_datetime(column, errors="coerce", utc=True, format=form, dayfirst=not is_iso)
    refuse(column, dates.isna(), "a date")
    return np.asarray((dates - dates.iloc[0]).dt.total_seconds())


def refuse(column: pd.Series[str], is_bad: pd.Series[bool], allowed: str) -> None:
    """Raise a `UsageError` if a column of the log has texts that cannot be read.

    Parameters
    ----------
    column
        The column of texts.
    is_bad
        Whether each text cannot be read. The message names the first line where this is true.
    allowed
        What a text must be, such as "a number", for the message.
    """
    if is_bad.any():
        line = int(np.argmax(is_bad)) + 2
        raise UsageError(
            f"line {line}: {column.name} must be {allowed}, got {column[is_bad].iloc[0]!r}. "
            "Leave the cells of missing values empty"
        )


def row_numbers(seconds: NDArray[np.float64]) -> tuple[NDArray[np.int64], float]:
    """Return the sample of each row, counted from the first row, and the sampling interval.

    The samples are integers, shape (rows,), and the sampling interval is in s. `seconds` has
    the times of the rows, s, shape (rows,). A `UsageError` is raised if times do not increase,
    if a row comes more than 0.4 sampling intervals early or late, or if 20 or more rows in
    succession are missing.
    """
    steps = np.diff(seconds)
    is_usual = np.abs(steps / np.median(steps) - 1.0) < 0.5
    interval = float(f"{np.mean(steps[is_usual]):.6g}")
    samples = (seconds - seconds[0]) / interval
    lateness = np.abs(samples - np.round(samples))
    regular = f"most time steps are {interval:g} s. Resample the log"
    for is_bad, advice in (
        (steps <= 0.0, "times must increase. Sort the rows, and remove repeated ones"),
        (steps > LONGEST_GAP * interval, "rows are missing before it. Divide the log there"),
        (np.diff(np.round(samples)) < 1.0, regular),
        (lateness[1:] > 0.4, regular),
    ):
        if is_bad.any():
            row = int(np.argmax(is_bad))
            raise UsageError(f"line {row + 3}: a time step of {steps[row]:g} s: {advice}")
    return np.round(samples).astype(np.int64), interval


def doubts(fit: Fit, intervals: pd.DataFrame, explained: float) -> list[str]:
    """Return the warnings of the report: a sentence for each reason why a fit may be wrong.

    Parameters
    ----------
    fit
        The fit of the log.
    intervals
        The table of `benchmarks.loop.identification.estimates`.
    explained
        The result of `benchmarks.loop.identification.explained_share`.
    """
    log, errors = fit.log, fit.errors
    sentences = []
    last_third = log.flow[-(len(log.flow) // 3) :]
    if np.ptp(last_third) == 0.0:
        sentences.append(
            "The flow does not move in the last third of the log, so the model could not be "
            "checked there."
        )
    elif explained < 0.5:
        sentences.append(
            f"The model explains only {100 * max(explained, 0.0):.0f} % of the variance "
            "of the temperature in the last third of the log: the plant has changed, or "
            "something other than the flow has moved the temperature."
        )
    correlations = np.correlate(errors, errors, "full")[len(errors) :][:30] / (errors @ errors)
    is_large = np.abs(correlations) > max(0.1, 2.5 / np.sqrt(len(errors)))
    if np.mean(is_large) > 0.25:
        sentences.append(
            "The prediction errors are not white noise: the plant or its disturbances are not "
            "of the model's form, and the intervals are too narrow."
        )
    if len(fit.zones) == 2:
        sentences.append("The flow had fewer than three values: no dead zone can be found.")
    if intervals.low["gain"] <= 0.0 <= intervals.high["gain"]:
        sentences.append("The interval of the gain holds 0: the sign of the gain is unknown.")
    moves = np.diff(log.temperature)
    span = np.ptp(log.temperature)
    is_straight = np.abs(np.diff(moves)) < 1e-6 * span
    if np.mean(is_straight & (np.abs(moves[1:]) > 1e-4 * span)) > 1.0 / 3.0:
        sentences.append(
            "The temperature lies on straight lines between few values, as a historian that "
            "compresses data keeps it: the delay and the intervals are not reliable."
        )
    changes = np.flatnonzero(np.r_[True, moves != 0.0, True])
    longest = int(np.diff(changes).max())
    if longest > max(20, len(log.flow) / 20):
        sentences.append(
            f"The temperature is frozen: {longest} rows in succession have the same value."
        )
    return sentences


def plant_arguments(fit: Fit, options: Options) -> dict[str, Any]:
    """Return the arguments of the environment `MiddlePoint-v0` for the plant of a fit.

    Flows are deviations from the centre of the dead zone. The options can set the limits of the
    flow. If the plant cannot follow the environment's default set point, the set point has a
    smaller amplitude or a longer period.
    """
    from benchmarks.loop.identification import polynomials

    defaults = Parameters()
    delay = round(fit.unknowns.delay)
    a, b, c, noise_variance = polynomials(fit, delay)
    flow = fit.log.flow - fit.zone.centre
    u_min = float(flow.min()) if options.u_min is None else options.u_min
    u_max = float(flow.max()) if options.u_max is None else options.u_max
    # How far the flow can move the temperature to both sides, as the set point has both signs.
    reach = abs(fit.unknowns.gain) * max(-u_min, u_max)
    if not is_one_sided(u_min, u_max):
        reach = abs(fit.unknowns.gain) * min(-u_min, u_max)
    widest_reach = abs(fit.unknowns.gain) * max(-u_min, u_max)
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
        "setpoint_amplitude": min(0.6 * reach, defaults.setpoint_amplitude),
        "setpoint_period": max(2 * settling, defaults.setpoint_period),
        "temperature_span": max(1.5 * widest_reach, defaults.temperature_span),
    }


def is_one_sided(u_min: float, u_max: float) -> bool:
    """Return whether the flow can hardly move to one side of the operating flow."""
    return min(-u_min, u_max) < 0.2 * max(-u_min, u_max)


def argument_ranges(
    intervals: pd.DataFrame, arguments: dict[str, Any]
) -> dict[str, list[float]]:
    """Return the 95 % intervals of a plant as ranges of the environment's arguments.

    A range is a list [low, high]. An argument whose interval has a length of 0 is left out.

    Parameters
    ----------
    intervals
        The table of `benchmarks.loop.identification.estimates`.
    arguments
        The arguments of the environment for the plant, as `plant_arguments` returns them.
    """
    limits = intervals[["low", "high"]].T
    largest_flow = max(-arguments["u_min"], arguments["u_max"])
    gain_factors = limits.gain / intervals.value["gain"]
    # `time_constant_factor` multiplies the environment's time constant, 1 / rate samples with
    # the rate 1 - pole. The environment accepts factors above the rate.
    rates = 1.0 - np.exp(-arguments["sampling_interval"] / intervals.loc["time_constant"])
    slow_factors = np.clip(
        rates["value"] / rates[["low", "high"]], 1.000001 * rates["value"], 10.0
    )
    ranges = {
        "delay": [round(delay) for delay in limits.delay],
        "dead_zone": limits.dead_zone.clip(upper=0.99 * largest_flow).tolist(),
        "gain_factor": sorted(gain_factors.clip(0.1, 10.0)),
        "time_constant_factor": slow_factors.tolist(),
    }
    return {name: pair for name, pair in ranges.items() if pair[0] < pair[1]}


def findings(
    fit: Fit, explained: float, arguments: dict[str, Any], options: Options
) -> list[str]:
    """Return the paragraphs of the report that follow the warnings.

    Parameters
    ----------
    fit
        The fit of the log.
    explained
        The result of `benchmarks.loop.identification.explained_share`.
    arguments
        The arguments of the environment for the plant, as `plant_arguments` returns them.
    options
        The options of the command.
    """
    log, centre = fit.log, fit.zone.centre
    text = [
        f"The model explains {100 * max(explained, 0.0):.1f} % of the variance of the "
        "temperature in the last third of the log, when it is fitted to the first two thirds "
        "and simulates the last third from the flow and the measured disturbances.",
        f"The log has {len(log.flow):,} samples of {log.sampling_interval:g} s.",
        "The delay is in samples, the time constant in seconds, the dead zone (half of its "
        "width) in the unit of the flow, and the gain in the unit of the temperature per unit "
        "of the flow.",
        f"The operating point is a flow of {centre:.4g}, at which the temperature is "
        f"{fit.operating_temperature:.4g}. The flow can be between "
        f"{centre + arguments['u_min']:.4g} and {centre + arguments['u_max']:.4g}. The numbers "
        "in plant.json are deviations from the operating point.",
    ]
    if fit.load_steps:
        minutes = [log.sampling_interval * row / 60.0 for row in sorted(fit.load_steps)]
        times = ", ".join(f"{minute:.0f}" for minute in minutes)
        text.append(f"By the fit, an unmeasured load stepped {times} min after the first row.")
    if is_one_sided(arguments["u_min"], arguments["u_max"]):
        text.append(
            "Warning: the flow in the log moves hardly to one side of the operating point. Set "
            "the limits of the valve with --u-min and --u-max before you compare controllers; "
            "otherwise, they cannot follow half of the set points."
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
    """Return the identified parameters of the plant as a table of texts, for the report.

    `intervals` is the table of `benchmarks.loop.identification.estimates`.
    """
    import pandas as pd

    rows = []
    for name, (value, low, high) in intervals.iterrows():
        label = str(name).replace("_", " ")
        rows.append((label, f"{value:.4g}", f"[{low:.4g}, {high:.4g}]"))
    return pd.DataFrame(rows, columns=["", "value", "95 % interval"])


def draw(fit: Fit, title: str, path: Path) -> None:
    """Draw the temperature of a log, the simulated temperature, and the flow over time.

    The simulated temperature is that of the model in `fit`, without noise. `title` is the title
    of the picture, and `path` is the PNG file.
    """
    from benchmarks.lib.pictures import COLOURS, DEAD_ZONE, open_picture

    log = fit.log
    minutes = log.sampling_interval * np.arange(len(log.flow)) / 60.0
    with open_picture(path, 4.6, title) as figure:
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=[3, 2])
        above.plot(minutes, log.temperature, color="0.5", lw=1, label="recorded")
        after = slice(fit.first_row, None)
        above.plot(minutes[after], fit.simulated[after], color=COLOURS[1], label="model")
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
