"""Draw the figures of an identification."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from benchmarks.identify.guards import LAGS, autocorrelation, band, chance
from benchmarks.identify.model import Model
from benchmarks.identify.plant import settling
from benchmarks.lib.drawing import COLOURS, colours, drawn
from benchmarks.loop.margins import Loop

LONGEST = 5_000  # longest step response that is drawn, samples
SHOWN = 3_000  # rows of a log that are drawn: more would blur


def plot_log(model: Model, path: Path) -> None:
    """Draw the log, and the model's simulation of it."""
    log = model.log
    stop = min(len(log.flow), SHOWN)
    minutes = np.arange(stop) * log.sampling_interval / 60.0
    with drawn(path, 5) as figure:
        above, below = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [3, 2]})
        above.plot(minutes, log.temperature[:stop], color="0.5", linewidth=1, label="recorded")
        simulated = model.simulated[:stop]
        above.plot(minutes, simulated, color=COLOURS[1], label="model, without noise")
        above.set_ylabel(f"temperature ({log.temperature_unit})")
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
        below.set_ylabel(f"flow ({log.flow_unit})")
        below.set_xlabel("time (min)")


def plot_residuals(model: Model, path: Path) -> None:
    """Draw the prediction errors and their autocorrelation."""
    correlation, limit = autocorrelation(model.errors), chance(model.errors)
    errors = model.errors[:SHOWN]
    minutes = np.arange(len(errors)) * model.plant.sampling_interval / 60.0
    with drawn(path, 3) as figure:
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
    samples = min(round(1.2 * settling(model.plant)), LONGEST) + 1
    low, high = band(model, samples)
    minutes = np.arange(samples) * model.plant.sampling_interval / 60.0
    with drawn(path, 3.8) as figure:
        axes = figure.subplots()
        axes.fill_between(
            minutes, low, high, color=COLOURS[0], alpha=0.25, linewidth=0,
            label="95 % of what the log leaves open",
        )  # fmt: skip
        axes.plot(minutes, model.plant.step_response(samples), color=COLOURS[0], label="model")
        unit = f"{model.log.temperature_unit} per {model.log.flow_unit}"
        axes.set(xlabel="time after the step (min)", ylabel=f"temperature ({unit})")
        axes.legend()


def plot_margins(loops: Mapping[str, Loop], path: Path) -> None:
    """Draw the frequency responses of named loops around -1, and their sensitivities."""
    palette = colours(list(loops))
    turn = np.linspace(0.0, 2.0 * np.pi, 200)
    with drawn(path, 3.5) as figure:
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
