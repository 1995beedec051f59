"""Fit a plant to the log of a bump test, for the option `--plant` of the benchmarks.

    python benchmarks/examples/fit_plant.py log.csv plant.json --dead-zone 5 --u-min 0 --u-max 9
    python -m benchmarks.compare --plant plant.json --agents pi-simc smith dahlin

In a bump test, an operator moves the flow by hand a few times, and waits after each move until
the temperature has nearly settled. The log is a CSV file with three columns:

- `time`: the time of the row, s, with the same interval between all rows;
- `flow`: the flow that is commanded from the time of the row on, t/h, as a deviation from the
  middle of the dead zone;
- `temperature`: the temperature at the time of the row, degC.

The model is equation (28) of the paper with one lag, whose pole is p, and with a delay of d
samples. The applied flow u_a is 0 inside the dead zone, and otherwise the commanded flow within
the limits, as in equation (29)::

    y(k) = p y(k-1) + gain (1 - p) u_a(k-1-d),  p = exp(-sampling interval / time constant)
    temperature(k) = offset + y(k)
"""

import csv
import json
from pathlib import Path

import cyclopts
import numpy as np
import pandas as pd
from cyclopts.types import ExistingFile, NonExistentFile
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.signal import lfilter

from mptc_gym import Parameters
from mptc_gym.plant.actuator import applied_flow

Array = NDArray[np.float64]
# The longest delay that a fit tries, samples. If the delay of a plant has more samples, the log
# has more rows than a fit needs: keep every tenth row.
LONGEST_DELAY = 200


def read_log(file: Path) -> pd.DataFrame:
    """Return a log, or exit with a message that says why it cannot be fitted."""
    with file.open(encoding="utf-8", newline="") as lines:
        lengths = [len(row) for row in csv.reader(lines)]
    if max(lengths, default=0) > lengths[0]:  # as with decimal commas
        raise SystemExit(
            f"{file}: row {lengths.index(max(lengths)) + 1} has more columns than the headings"
        )
    try:
        log = pd.read_csv(
            file, usecols=["time", "flow", "temperature"], dtype=float, na_filter=False
        )
    except ValueError as error:
        raise SystemExit(
            f"{file} must have the columns time, flow and temperature, separated by commas, "
            f"with a number in each row: {error}"
        ) from error
    intervals = np.diff(log.time)
    if (intervals <= 0.0).any():
        raise SystemExit(f"{file}: times must ascend, so the oldest row must be the first")
    if np.ptp(intervals) > 0.1 * np.median(intervals):
        raise SystemExit(
            f"{file}: times must be equidistant, but are from {intervals.min():g} s to "
            f"{intervals.max():g} s apart, the latter after {log.time[intervals.argmax()]:g} s"
        )
    return log


def regress(applied: Array, temperature: Array, delay: int, pole: float) -> tuple[Array, Array]:
    """Fit gain and offset to a log, for a given delay in samples and a given pole p.

    Before the first row of the log, the plant was at rest with any constant flow.

    Returns
    -------
    factors : array of shape (3,)
        Gain, degC per t/h; temperature at rest with a flow of 0 minus the temperature at rest
        before the first row, degC; and the temperature at rest before the first row, degC.
    errors : array of shape (rows,)
        Temperatures of the model minus those of the log, degC.
    """
    # The applied flow, and a step at the first row, which ends the flow before the first row.
    # Both act delay + 1 rows later. The columns of `signals` belong to the three factors.
    inputs = np.pad([applied, np.ones_like(applied)], ((0, 0), (delay + 1, 0)))
    responses = lfilter([1.0 - pole], [1.0, -pole], inputs[:, : len(applied)])
    signals = np.stack([*responses, np.ones_like(applied)], axis=1)
    factors = np.linalg.lstsq(signals, temperature, rcond=None)[0]
    return factors, signals @ factors - temperature


def fit_lag(applied: Array, temperature: Array) -> tuple[int, float]:
    """Return delay in samples and pole p that give the smallest sum of squared errors."""

    def errors(log_time_constant: Array, delay: int) -> Array:
        """Return the errors of a fit, degC; the first argument has one element."""
        pole = np.exp(-1.0 / np.exp(log_time_constant[0]))
        return regress(applied, temperature, delay, pole)[1]

    # With a longer delay than half the log, too few rows would depend on any flow.
    delays = range(min(LONGEST_DELAY + 1, len(applied) // 2))
    # The logarithm of the time constant is searched, as the time constant must be positive. The
    # search begins with a time constant of 20 samples.
    fits = [least_squares(errors, np.log([20.0]), args=(delay,)) for delay in delays]
    best_delay = int(np.argmin([fit.cost for fit in fits]))  # as the delays begin at 0
    return best_delay, float(np.exp(-1.0 / np.exp(fits[best_delay].x[0])))


def main(
    log_file: ExistingFile,
    plant_file: NonExistentFile,
    *,
    dead_zone: float,
    u_min: float,
    u_max: float,
) -> None:
    """Fit a plant to the log of a bump test, and print the numbers of the plant.

    Parameters
    ----------
    log_file
        CSV file with the columns time (s), flow (t/h) and temperature (degC).
    plant_file
        New JSON file for the plant. A picture of the log and the fit gets the same name with
        the ending `.png`.
    dead_zone
        Half width of the valve's dead zone, t/h; 0 if there is none.
    u_min, u_max
        Limits of the flow, t/h.
    """
    log = read_log(log_file)
    interval = float(np.diff(log.time).mean())
    try:
        Parameters(dead_zone=dead_zone, u_min=u_min, u_max=u_max, sampling_interval=interval)
    except ValueError as error:
        raise SystemExit(str(error)) from error
    applied = applied_flow(log.flow, dead_zone, u_min, u_max)
    if np.count_nonzero(np.diff(applied)) < 2:  # The fit could take one move for the start.
        raise SystemExit(
            f"{log_file}: the flow must move twice or more, outside the dead zone and within "
            "the limits"
        )
    temperature = log.temperature.to_numpy()
    delay, pole = fit_lag(applied, temperature)
    (gain, change, level), errors = regress(applied, temperature, delay, pole)
    # The largest steady change of the temperature within the limits of the flow fits into it.
    span = float(f"{2.0 * abs(gain) * max(abs(u_min), abs(u_max)):.2g}")
    plant = {
        "a": [1.0, -pole],
        "b": [gain * (1.0 - pole)],
        "c": [1.0],
        "delay": delay,
        "dead_zone": dead_zone,
        "u_min": u_min,
        "u_max": u_max,
        "sampling_interval": interval,
        "temperature_span": max(span, float(np.ptp(temperature))),
    }
    plant_file.write_text(json.dumps(plant, indent=1))
    signals = {
        "time (s)": log.time,
        "temperature (degC)": temperature,
        "fit (degC)": temperature + errors,
        "flow (t/h)": log.flow,
    }
    panels = pd.DataFrame(signals).plot(
        x="time (s)",
        subplots=[("temperature (degC)", "fit (degC)"), ("flow (t/h)",)],
        drawstyle="steps-post",
    )
    panels[0].figure.savefig(plant_file.with_suffix(".png"))
    if delay >= min(LONGEST_DELAY, len(log) // 2 - 1):
        print("The delay is the longest that the fit tries: the plant's delay may be longer.")
    print(
        f"gain {gain:.4g} degC per t/h, time constant {-interval / np.log(pole):.4g} s, delay "
        f"{delay} samples of {interval:g} s, temperature at flow 0 {level + change:.4g} degC\n"
        f"The fit explains {1.0 - np.var(errors) / np.var(temperature):.1%} of the variance of "
        f"the temperature. The standard deviation of the rest is {np.std(errors):.2g} degC."
    )


if __name__ == "__main__":
    cyclopts.run(main)
