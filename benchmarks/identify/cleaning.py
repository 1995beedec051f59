"""Mends what recorders do to a log: two rates, noise on a held flow, spikes."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pandas as pd
from numpy.lib.stride_tricks import sliding_window_view

from benchmarks.identify.armax import Array, Flags
from benchmarks.identify.log import Log

SPIKE = 8.0  # robust deviations that a sample must stick out from its neighbours
STANDSTILL = 20  # samples in a row with the same temperature, of one that else moves
MOST_SPIKES = 0.03  # share of the rows
JUMP = 8.0  # deviations of its noise, from which a change of a held flow is surely a step
STEP = 5.0  # standard errors, from which a difference of means is one
SHORTEST_HOLD = 10  # samples
RATES = range(2, 61)  # rows for each temperature


def at_one_rate(log: Log) -> Log:
    """Return the log at the rate of its temperatures, if only every n-th row has one."""
    known = np.flatnonzero(np.isfinite(log.temperature))
    if len(known) < 2 or 2 * len(known) > len(log.temperature) + 1:
        return log
    rate = int(np.median(np.diff(known)))
    first = int(np.bincount(known % rate).argmax()) if rate in RATES else 0
    if rate not in RATES or np.mean(known % rate == first) < 0.95:
        return log

    def mean(values: Array) -> Array:
        """Return means from each temperature to the next."""
        means: Array = sliding_window_view(values, rate)[first::rate].mean(axis=1)
        return means

    note = (
        f"Only one row in {rate} has a temperature. The log is fitted at these rows, "
        f"{rate * log.sampling_interval:g} s apart, with the mean of the flow between them."
    )
    return Log(
        mean(log.flow),
        log.temperature[first : len(log.flow) - rate + 1 : rate],
        rate * log.sampling_interval,
        [*log.notes, note],
        {name: mean(each) for name, each in log.disturbances.items()},
    )


def without_noise_of_held_flow(log: Log) -> Log:
    """Return the log with the means of the flow while it is held, if it is held, but noisy."""
    flow = log.flow
    moves = np.diff(flow)
    known = moves[np.isfinite(moves)]
    spread = 1.4826 * float(np.median(np.abs(known))) / np.sqrt(2.0) if len(known) else 0.0
    if spread == 0.0:  # it stands still in most samples
        return log
    steps = _steps(flow, spread)
    holds = np.split(flow, steps)
    long = [len(hold) for hold in holds if len(hold) >= SHORTEST_HOLD]
    means = np.concatenate([np.full(len(hold), hold.mean()) for hold in holds])
    left = flow - means
    left = left[np.isfinite(left)]
    if len(steps) < 3 or sum(long) < 0.9 * len(flow) or len(left) < 2 or not left.any():
        return log
    # What a controller or a hand does is not white; what a transmitter adds is.
    together = np.corrcoef(left[1:], left[:-1])[0, 1]
    if abs(together) > 0.2 or np.std(left) > 0.25 * np.nanstd(flow):
        return log
    noise = float(np.std(left))
    note = (
        f"The flow is held for stretches and has noise of {noise:.2g} t/h, which is "
        "taken as the flow meter's: the means of the stretches are used."
    )
    error = noise / math.sqrt(float(np.median(long)))
    return replace(log, flow=means, flow_error=error, notes=[*log.notes, note])


def _steps(flow: Array, spread: float) -> list[int]:
    """Return where a flow with white noise steps.

    By binary segmentation (A. J. Scott and M. Knott, Biometrics 30, 1974, 507-512): a stretch
    is parted where the means before and after differ most for their errors, until none do.
    """
    moves = np.diff(flow)
    found = (np.flatnonzero(~(np.abs(moves) < JUMP * spread)) + 1).tolist()
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
    """Return the log without temperatures of a sensor that was stuck, and moves elsewhere."""
    temperature = log.temperature
    ends = np.concatenate([[True], np.diff(temperature) != 0.0])
    run = np.cumsum(ends) - 1
    lengths = np.bincount(run)
    still = lengths >= STANDSTILL
    if not still.any() or still.all() or np.mean(lengths[~still] == 1) < 0.9:
        return log  # a coarse sensor, or none that stood still
    stuck = still[run] & ~ends  # the first of each may be right
    note = (
        f"In {int(stuck.sum())} rows the temperature stands still to the last digit, and moves "
        "elsewhere: they are left out, as those of a sensor that was stuck."
    )
    return replace(
        log, temperature=np.where(stuck, np.nan, temperature), notes=[*log.notes, note]
    )


def without_jump(log: Log, row: int, height: float) -> Log:
    """Return the log with a jump taken from all later temperatures, and a note."""
    note = (
        f"At sample {row + 1} the temperature jumps by {height:.3g} °C, which no flow "
        "explains: it is subtracted from there on. See whether the sensor was changed."
    )
    temperature = log.temperature - np.where(np.arange(len(log.flow)) >= row, height, 0.0)
    return replace(log, temperature=temperature, notes=[*log.notes, note])


def protrusion(log: Log) -> Array:
    """Return how far temperatures stick out from those before and after, in deviations.

    It is 0 for all but the furthest ones, of which `MOST_SPIKES` may be above `SPIKE`.
    """
    series = pd.Series(log.temperature)
    apart = (series - series.rolling(7, center=True, min_periods=3).median()).abs()
    known = np.unique(log.temperature[np.isfinite(log.temperature)])
    finest = float(np.min(np.diff(known))) if len(known) > 1 else 0.0
    scale = max(1.4826 * float(np.nanmedian(apart)), finest, 1e-3 * float(np.ptp(known)))
    found = apart.fillna(0.0).to_numpy(dtype=np.float64) / max(scale, 1e-300)
    least = np.sort(found)[-max(int(MOST_SPIKES * len(found)), 1)]
    return np.where(found >= max(least, SPIKE), found, 0.0)


def without(log: Log, spikes: Flags) -> Log:
    """Return the log with these temperatures missing, and a note."""
    if not spikes.any():
        return log
    count = int(spikes.sum())
    rows = ", ".join(str(row + 1) for row in np.flatnonzero(spikes)[:5])
    more = ", ..." if count > 5 else ""
    note = (
        f"{count} {'spikes' if count > 1 else 'spike'} of the temperature "
        f"{'are' if count > 1 else 'is'} left out (samples {rows}{more})."
    )
    temperature = np.where(spikes, np.nan, log.temperature)
    return replace(log, temperature=temperature, notes=[*log.notes, note])
