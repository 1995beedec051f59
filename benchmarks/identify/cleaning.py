"""Repair faults of a log: a stuck sensor, noise on a held flow, and spikes."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pandas as pd

from benchmarks.identify.__main__ import Knowledge
from benchmarks.identify.armax import Array, Orders
from benchmarks.identify.likelihood import Likelihood
from benchmarks.identify.log import Log


def cleaned(log: Log, knowledge: Knowledge) -> Log:
    """Return the log ready to be fitted, with a note on each repair."""
    log = without_noise_of_held_flow(without_standstill(log))
    return _without_spikes(log, knowledge)


def _deviation(values: Array) -> float:
    """Return a standard deviation of values around 0 that is robust to outliers."""
    return 1.4826 * float(np.nanmedian(np.abs(values)))


def without_noise_of_held_flow(log: Log) -> Log:
    """Return the log with a held but noisy flow replaced by its mean over each hold."""
    flow = log.flow
    moves = np.diff(flow)
    spread = _deviation(moves) / math.sqrt(2.0) if np.isfinite(moves).any() else 0.0
    if spread == 0.0:  # the flow is constant in most samples
        return log
    holds = np.split(flow, _steps(flow, spread))
    long = [len(hold) for hold in holds if len(hold) >= 10]  # means of fewer are no better
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
    # Eight deviations do not occur by chance, nor do five among the means of a long log.
    found = (np.flatnonzero(~(np.abs(np.diff(flow)) < 8.0 * spread)) + 1).tolist()
    stretches = list(itertools.pairwise([0, *found, len(flow)]))
    while stretches:
        start, stop = stretches.pop()
        part, before = flow[start:stop], np.arange(1, stop - start)
        sums = np.cumsum(part - part.mean())[:-1]
        scores = np.abs(sums) / np.sqrt(before * before[::-1] / len(part))
        if len(scores) and scores.max() > 5.0 * spread:
            place = start + 1 + int(scores.argmax())
            found.append(place)
            stretches += [(start, place), (place, stop)]
    return sorted(found)


def without_standstill(log: Log) -> Log:
    """Return the log without the temperatures of a sensor that was stuck.

    A sensor is stuck where it repeats a temperature 20 times and moves elsewhere.
    """
    temperature = log.temperature
    ends = np.concatenate([[True], np.diff(temperature) != 0.0])
    run = np.cumsum(ends) - 1
    lengths = np.bincount(run)
    still = lengths >= 20
    if not still.any() or still.all() or np.mean(lengths[~still] == 1) < 0.9:
        return log  # a coarse sensor, or one that was never stuck
    stuck = still[run] & ~ends  # the first of each run may be right
    return log.mended(
        f"In {int(stuck.sum())} rows the temperature stands still to the last digit, and moves "
        "elsewhere: they are left out, as those of a sensor that was stuck.",
        temperature=np.where(stuck, np.nan, temperature),
    )


def _without_spikes(log: Log, knowledge: Knowledge) -> Log:
    """Return the log without its spikes.

    They stick out from their neighbours, and no response to the flow explains them.
    """
    series = pd.Series(log.temperature)
    apart = (series - series.rolling(7, center=True, min_periods=3).median()).abs().fillna(0.0)
    known = np.unique(log.temperature[np.isfinite(log.temperature)])
    finest = float(np.min(np.diff(known), initial=np.inf)) if len(known) > 1 else 0.0
    scale = max(_deviation(apart.to_numpy()), finest, 1e-3 * float(np.ptp(known)), 1e-300)
    # At most 3 % of the rows, those from eight deviations on.
    suspects = np.asarray(apart >= max(float(apart.quantile(0.97)), 8.0 * scale))
    if not suspects.any():
        return log
    likelihood = Likelihood(log, knowledge)
    # B is long, so that a fast response does not look like a spike.
    errors = np.abs(likelihood.errors(likelihood.first_fits([Orders(2, 6, 2)])[0]))
    # The first rows have no prediction: what sticks out much further there is a spike if all
    # other suspects are. The second sample of a spike may be predicted from the first.
    outlying, foreseen = errors > 6.0 * _deviation(errors), np.isfinite(errors)
    alone = ~foreseen & np.asarray(apart > 24.0 * scale)
    outlying |= alone & bool(outlying[suspects & foreseen].all())
    runs = np.cumsum(np.diff(suspects, prepend=False))
    spikes = suspects & np.isin(runs, runs[suspects & outlying])
    rows = [str(row + 1) for row in np.flatnonzero(spikes)]
    if not rows:
        return log
    what = "spikes of the temperature are" if len(rows) > 1 else "spike of the temperature is"
    shown = ", ".join([*rows[:5], *["..."] * (len(rows) > 5)])
    return log.mended(
        f"{len(rows)} {what} left out (samples {shown}).",
        temperature=np.where(spikes, np.nan, log.temperature),
    )
