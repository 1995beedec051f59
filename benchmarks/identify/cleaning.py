"""Repair faults of a log: two rates, a stuck sensor, noise on a held flow, and spikes."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pandas as pd
from numpy.lib.stride_tricks import sliding_window_view

from benchmarks.identify.armax import Array, Orders
from benchmarks.identify.likelihood import Likelihood
from benchmarks.identify.log import Log
from benchmarks.identify.options import Knowledge

SPIKE = 8.0  # robust deviations from its neighbours beyond which a sample is suspected
STANDSTILL = 20  # equal temperatures in a row that show a stuck sensor
MOST_SPIKES = 0.03  # largest share of rows that are suspected
FLOW_JUMP = 8.0  # deviations of its noise beyond which a change of a held flow is a step
STEP = 5.0  # standard errors beyond which a difference of means is a step
SHORTEST_HOLD = 10  # samples
RATES = range(2, 61)  # rows per temperature
TO_FORESEE = Orders(2, 6, 2)  # B is long, so that a fast response does not look like a spike
OUTLYING = 6.0  # robust deviations of prediction errors beyond which a suspect is a spike
PLAIN = 24.0  # deviations beyond which a suspect without a prediction is a spike


def cleaned(log: Log, knowledge: Knowledge) -> Log:
    """Return the log ready to be fitted, with a note on each repair."""
    log = without_noise_of_held_flow(_at_one_rate(without_standstill(log)))
    return _without_spikes(log, knowledge)


def _at_one_rate(log: Log) -> Log:
    """Return the log at the rate of its temperatures, if only every n-th row has one."""
    known = np.flatnonzero(np.isfinite(log.temperature))
    if len(known) < 2 or 2 * len(known) > len(log.temperature) + 1:
        return log
    rate = int(np.median(np.diff(known)))
    first = int(np.bincount(known % rate).argmax())
    if rate not in RATES or np.mean(known % rate == first) < 0.95:
        return log

    def mean(values: Array) -> Array:
        """Return the means from each temperature to the next."""
        means: Array = sliding_window_view(values, rate)[first::rate].mean(axis=1)
        return means

    interval = rate * log.sampling_interval
    return log.mended(
        f"Only one row in {rate} has a temperature. The log is fitted at these rows, "
        f"{interval:g} s apart, with the mean of the flow between them.",
        flow=mean(log.flow),
        temperature=log.temperature[first : len(log.flow) - rate + 1 : rate],
        sampling_interval=interval,
        disturbances={name: mean(each) for name, each in log.disturbances.items()},
    )


def deviation(values: Array) -> float:
    """Return a standard deviation of values around 0 that is robust to outliers."""
    return 1.4826 * float(np.nanmedian(np.abs(values)))


def without_noise_of_held_flow(log: Log) -> Log:
    """Return the log with a held but noisy flow replaced by its mean over each hold."""
    flow = log.flow
    moves = np.diff(flow)
    spread = deviation(moves) / math.sqrt(2.0) if np.isfinite(moves).any() else 0.0
    if spread == 0.0:  # the flow is constant in most samples
        return log
    holds = np.split(flow, _steps(flow, spread))
    long = [len(hold) for hold in holds if len(hold) >= SHORTEST_HOLD]
    means = np.concatenate([np.full(len(hold), hold.mean()) for hold in holds])
    left = flow - means
    left = left[np.isfinite(left)]
    if len(holds) < 4 or sum(long) < 0.9 * len(flow) or len(left) < 2 or not left.any():
        return log
    # The moves of a controller or an operator are not white; the noise of a transmitter is.
    together, noise = np.corrcoef(left[1:], left[:-1])[0, 1], float(np.std(left))
    if abs(together) > 0.2 or noise > 0.25 * np.nanstd(flow):
        return log
    return log.mended(
        f"The flow is held for stretches and has noise of {noise:.2g} {log.flow_unit}, which "
        "is taken as the flow meter's: the means of the stretches are used.",
        flow=means,
        flow_error=noise / math.sqrt(float(np.median(long))),
    )


def _steps(flow: Array, spread: float) -> list[int]:
    """Return the rows at which a flow with white noise steps.

    Binary segmentation (A. J. Scott and M. Knott, Biometrics 30, 1974, 507-512): a stretch is
    split where the means before and after differ most in standard errors, until none differ.
    """
    moves = np.diff(flow)
    found = (np.flatnonzero(~(np.abs(moves) < FLOW_JUMP * spread)) + 1).tolist()
    open_ones = list(itertools.pairwise([0, *found, len(flow)]))
    while open_ones:
        start, stop = open_ones.pop()
        part, before = flow[start:stop], np.arange(1, stop - start)
        sums = np.cumsum(part - part.mean())[:-1]
        scores = np.abs(sums) / np.sqrt(before * before[::-1] / len(part))
        if len(scores) and scores.max() > STEP * spread:
            place = start + 1 + int(scores.argmax())
            found.append(place)
            open_ones += [(start, place), (place, stop)]
    return sorted(found)


def without_standstill(log: Log) -> Log:
    """Return the log without the temperatures of a sensor that was stuck for a while."""
    temperature = log.temperature
    ends = np.concatenate([[True], np.diff(temperature) != 0.0])
    run = np.cumsum(ends) - 1
    lengths = np.bincount(run)
    still = lengths >= STANDSTILL
    if not still.any() or still.all() or np.mean(lengths[~still] == 1) < 0.9:
        return log  # a coarse sensor, or one that was never stuck
    stuck = still[run] & ~ends  # the first of each run may be right
    return log.mended(
        f"In {int(stuck.sum())} rows the temperature stands still to the last digit, and moves "
        "elsewhere: they are left out, as those of a sensor that was stuck.",
        temperature=np.where(stuck, np.nan, temperature),
    )


def _protrusion(log: Log) -> Array:
    """Return how far temperatures stick out from their neighbours, in robust deviations.

    It is 0 for all but the largest, a share of `MOST_SPIKES`, and for those below `SPIKE`.
    """
    series = pd.Series(log.temperature)
    apart = (series - series.rolling(7, center=True, min_periods=3).median()).abs()
    known = np.unique(log.temperature[np.isfinite(log.temperature)])
    finest = float(np.min(np.diff(known))) if len(known) > 1 else 0.0
    scale = max(deviation(apart.to_numpy()), finest, 1e-3 * float(np.ptp(known)))
    found = apart.fillna(0.0).to_numpy(dtype=np.float64) / max(scale, 1e-300)
    least = np.sort(found)[-max(int(MOST_SPIKES * len(found)), 1)]
    return np.where(found >= max(least, SPIKE), found, 0.0)


def _without_spikes(log: Log, knowledge: Knowledge) -> Log:
    """Return the log without its spikes: suspects that no response to the flow explains."""
    apart = _protrusion(log)
    found = apart > 0.0
    if not found.any():
        return log
    likelihood = Likelihood(log, knowledge)
    errors = np.abs(likelihood.errors(likelihood.first_fits([TO_FORESEE])[0]))
    # The first rows have no prediction: they count as spikes if all other suspects do. The
    # second sample of a spike may be predicted from the first.
    outlying, known = errors > OUTLYING * deviation(errors), np.isfinite(errors)
    outlying |= ~known & (apart > PLAIN) & bool(outlying[found & known].all())
    runs = np.cumsum(np.diff(found, prepend=False))
    spikes = found & np.isin(runs, runs[found & outlying])
    rows = [str(row + 1) for row in np.flatnonzero(spikes)]
    if not rows:
        return log
    what = "spikes of the temperature are" if len(rows) > 1 else "spike of the temperature is"
    shown = ", ".join([*rows[:5], *["..."] * (len(rows) > 5)])
    return log.mended(
        f"{len(rows)} {what} left out (samples {shown}).",
        temperature=np.where(spikes, np.nan, log.temperature),
    )
