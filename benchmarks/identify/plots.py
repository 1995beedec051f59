"""Draw the figures of an identification."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from benchmarks.controllers.step_test import StepTest
from benchmarks.identify.margins import Loop
from benchmarks.identify.model import Model
from benchmarks.lib.drawing import COLOURS, colours, drawn
from benchmarks.lib.statistics import ENDS

LAGS = 40  # largest lag of the autocorrelation, samples
LONGEST = 5_000  # longest step response that is drawn, samples
SHOWN = 3_000  # rows of a log that are drawn: more would blur


def plot_log(model: Model, path: Path) -> None:
    """Draw the log, and the model's simulation of it."""
    log = model.log
    stop = min(len(log.flow), SHOWN)
    minutes = np.arange(stop) * log.sampling_interval / 60.0
    with drawn(path, 10, 6) as figure:
        above, below = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [3, 2]})
        above.plot(minutes, log.temperature[:stop], color="0.5", linewidth=1, label="recorded")
        simulated = model.simulated[:stop]
        above.plot(minutes, simulated, color=COLOURS[1], label="model, without noise")
        above.set_ylabel("temperature (°C)")
        above.margins(y=0.15)  # room for the legend
        above.legend(loc="upper right", ncols=2)
        below.step(minutes, log.flow[:stop], where="post", color=COLOURS[0], linewidth=1)
        zone = model.estimates["dead_zone"].value
        if zone:
            below.axhspan(
                model.operating_flow - zone, model.operating_flow + zone,
                color="0.5", alpha=0.15, linewidth=0, label="dead zone",
            )  # fmt: skip
            below.margins(y=0.2)
            below.legend(loc="upper right")
        below.set_ylabel("flow (t/h)")
        below.set_xlabel("time (min)")


def plot_residuals(model: Model, path: Path) -> float:
    """Draw the prediction errors and their autocorrelation up to `LAGS`.

    Returns
    -------
    float
        The share of autocorrelations outside the 95 % band of white noise.
    """
    known = np.isfinite(model.errors)
    centred = np.where(known, model.errors - np.mean(model.errors[known]), 0.0)
    pairs = [np.sum(centred[lag:] * centred[: len(centred) - lag]) for lag in range(LAGS + 1)]
    correlation = np.array(pairs[1:]) / pairs[0]
    chance = 1.96 / np.sqrt(known.sum())
    errors = model.errors[:SHOWN]
    minutes = np.arange(len(errors)) * model.plant.sampling_interval / 60.0
    with drawn(path, 10, 3.6) as figure:
        left, right = figure.subplots(1, 2)
        left.plot(minutes, errors, color=COLOURS[0], linewidth=0.6)
        left.set(xlabel="time (min)", ylabel="prediction error (°C)")
        right.bar(np.arange(1, LAGS + 1), correlation, width=0.5, color=COLOURS[0])
        right.axhspan(
            -chance, chance, color="0.5", alpha=0.2, linewidth=0, label="by chance, 95 %"
        )
        right.set(xlabel="lag (samples)", ylabel="autocorrelation")
        right.legend(loc="upper right")
    return float(np.mean(np.abs(correlation) > chance))


def plot_step(model: Model, tested: StepTest, path: Path) -> None:
    """Draw the step response with its 95 % band, and its first-order model."""
    length = tested.delay + 6.0 * tested.time_constant
    samples = min(int(np.ceil(length / model.plant.sampling_interval)), LONGEST) + 1
    response = model.plant.step_response(samples)
    with np.errstate(over="ignore", invalid="ignore"):  # from unstable plants
        possible = np.array([plant.step_response(samples) for plant in model.possible])
    low, high = np.nanquantile(possible, ENDS, axis=0, method="nearest")
    times = np.arange(samples) * model.plant.sampling_interval
    since = np.maximum(times - tested.delay + model.plant.sampling_interval, 0.0)
    first_order = np.where(
        times >= tested.delay, -tested.gain * np.expm1(-since / tested.time_constant), 0.0
    )
    with drawn(path, 8, 4) as figure:
        axes = figure.subplots()
        axes.fill_between(
            times / 60, low, high, color=COLOURS[0], alpha=0.25, linewidth=0,
            label="95 % of what the log leaves open",
        )  # fmt: skip
        axes.plot(times / 60, response, color=COLOURS[0], label="model")
        axes.plot(
            times / 60, first_order, "--", color=COLOURS[1],
            label="first order with delay",
        )  # fmt: skip
        axes.set(xlabel="time after the step (min)", ylabel="temperature (°C per t/h)")
        axes.legend()


def plot_margins(loops: Mapping[str, Loop], path: Path) -> None:
    """Draw the frequency responses of named loops around -1, and their sensitivities."""
    palette = colours(list(loops))
    turn = np.linspace(0.0, 2.0 * np.pi, 200)
    with drawn(path, 10, 4.2) as figure:
        plane, sensitivity = figure.subplots(1, 2)
        for name, loop in loops.items():
            values, color = loop.response, palette[name]
            plane.plot(values.real, values.imag, color=color, label=name)
            sensitivity.loglog(loop.frequency, 1.0 / np.abs(1.0 + values), color=color)
        for peak, style in ((1.6, "--"), (2.0, ":")):
            plane.plot(
                -1 + np.cos(turn) / peak, np.sin(turn) / peak, style, color="0.4",
                linewidth=1, label=f"Ms = {peak:g}",
            )  # fmt: skip
        plane.plot(-1, 0, "k+")
        plane.set(xlim=(-2.2, 0.8), ylim=(-1.5, 1.5), aspect="equal")
        plane.set(xlabel="Re L", ylabel="Im L", title="the loop around -1")
        plane.legend(fontsize="small", loc="upper left")
        sensitivity.axhline(1.0, color="0.4", linewidth=1)
        sensitivity.set_ylim(bottom=0.02)
        sensitivity.set(xlabel="frequency (rad/s)", title="amplification of a disturbance |S|")
