"""Draw the figures of an identification."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.identify.guards import LAGS, autocorrelation, band, chance
from benchmarks.identify.model import Model
from benchmarks.identify.plant import settling
from benchmarks.lib.drawing import COLOURS, drawn

SHOWN = 3_000  # samples that are drawn, the last ones of a log: more would blur


def plot_log(model: Model, path: Path) -> None:
    """Draw the log, and the model's simulation of it."""
    log, shown = model.log, slice(-SHOWN, None)
    minutes = (np.arange(len(log.flow)) * log.sampling_interval / 60.0)[shown]
    title = "The temperature as recorded, and as the model simulates it from the flow"
    with drawn(path, 5, title) as figure:
        above, below = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [3, 2]})
        recorded, simulated = log.temperature[shown], model.simulated[shown]
        above.plot(minutes, recorded, color="0.5", linewidth=1, label="recorded")
        above.plot(minutes, simulated, color=COLOURS[1], label="model, without noise")
        above.set_ylabel(f"temperature ({log.temperature_unit})")
        above.margins(y=0.2)  # room for the legend
        held_out = minutes[model.held_out_rows[shown]]
        for axes, label in ((above, "held out: the model is judged here"), (below, None)):
            axes.axvspan(
                held_out[0], held_out[-1], color=COLOURS[5], alpha=0.15, linewidth=0,
                label=label,
            )  # fmt: skip
        above.legend(loc="upper center", ncols=3)
        below.step(minutes, log.flow[shown], where="post", color=COLOURS[0], linewidth=1)
        zone = model.estimates["dead_zone"].value
        if zone:
            below.axhspan(
                model.operating_flow - zone, model.operating_flow + zone,
                color="0.5", alpha=0.15, linewidth=0, label="dead zone",
            )  # fmt: skip
            below.margins(y=0.2)
            below.legend(loc="upper left")
        below.set(ylabel=f"flow ({log.flow_unit})", xlabel="time (min)")


def plot_residuals(model: Model, path: Path) -> None:
    """Draw the prediction errors and their autocorrelation."""
    correlation, limit = autocorrelation(model.errors), chance(model.errors)
    errors = model.errors[-SHOWN:]
    minutes = np.arange(len(model.errors))[-SHOWN:] * model.plant.sampling_interval / 60.0
    title = "Errors of predictions one sample ahead, which should be white noise"
    with drawn(path, 3, title) as figure:
        left, right = figure.subplots(1, 2)
        left.plot(minutes, errors, color=COLOURS[0], linewidth=0.6)
        left.set(xlabel="time (min)", ylabel=f"prediction error ({model.log.temperature_unit})")
        right.bar(np.arange(1, LAGS + 1), correlation, width=0.5, color=COLOURS[0])
        right.axhspan(
            -limit, limit, color="0.5", alpha=0.2, linewidth=0, label="by chance, 95 %"
        )
        right.set(xlabel="lag (samples)", ylabel="autocorrelation")
        right.legend(loc="upper right")


def plot_step(model: Model, path: Path) -> None:
    """Draw the step response with its 95 % band, until it has settled."""
    samples = min(round(1.2 * settling(model.plant)), SHOWN) + 1
    low, high = band(model, samples)
    minutes = np.arange(samples) * model.plant.sampling_interval / 60.0
    flow, temperature = model.log.flow_unit, model.log.temperature_unit
    title = f"Response of the temperature to a step of the flow by 1 {flow}"
    with drawn(path, 3.8, title) as figure:
        axes = figure.subplots()
        axes.fill_between(
            minutes, low, high, color=COLOURS[0], alpha=0.25, linewidth=0,
            label="95 % of what the log leaves open",
        )  # fmt: skip
        axes.plot(minutes, model.plant.step_response(samples), color=COLOURS[0], label="model")
        axes.set(xlabel="time after the step (min)", ylabel=f"temperature ({temperature})")
        axes.legend()
