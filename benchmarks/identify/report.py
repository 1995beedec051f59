"""Identify a plant from a log, and write the plant, its controllers and a report."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.identify.__main__ import Options
from benchmarks.identify.advice import MOST_SENSITIVE, Recommended, recommended
from benchmarks.identify.log import read_log
from benchmarks.identify.model import Model, identify
from benchmarks.identify.plant import plant_arguments, plant_ranges
from benchmarks.lib.drawing import COLOURS, drawn
from benchmarks.lib.report import Section, provenance_line, show, write_report
from benchmarks.lib.statistics import ENDS
from benchmarks.lib.storage import UsageError, origin, out_folder, write_json

LABELS = {"pi-simc": "PI (SIMC)", "smith": "Smith"}
SHOWN = 4_000  # rows that are drawn, the last ones of a log: more would blur
UNSAFE = (
    f"However slow a controller is made, Ms is above {MOST_SENSITIVE} with one in twenty of "
    "the plants that the log leaves possible. Record a longer log, with larger steps."
)


def execute(options: Options) -> str:
    """Identify a plant from a log and write the results."""
    made, began = origin(), time.process_time()
    out = out_folder(options.out)
    try:
        log = read_log(options.log, options.columns)
        model = identify(log, options.knowledge)
        plant, ranges = plant_arguments(model), plant_ranges(model)
    except ValueError as error:
        raise UsageError(str(error)) from error
    found = recommended(model, smith=options.smith)
    if not found and not model.warnings:
        model.warnings.append(UNSAFE)
    draw(model, out / "identify.png")
    write_json(out / "plant.json", plant)
    write_json(out / "ranges.json", ranges)
    write_json(out / "controllers.json", controllers(model, found))
    sections = report(model, found)
    title = f"The plant of {options.log.name}"
    write_report(out, title, sections, provenance_line("identify", made))
    show(sections)
    seconds = time.process_time() - began
    return (
        f"{seconds:.1f} s of processor time. The plant, the ranges and the report are in {out}/"
    )


def controllers(model: Model, found: list[Recommended]) -> dict[str, Any]:
    """Return the content of `controllers.json`."""
    flow, temperature = model.log.flow_unit, model.log.temperature_unit
    rest = model.operating_flow
    shared = {
        "sampling_interval": model.log.sampling_interval,
        "units": {
            "kp": f"{flow} per {temperature}", "ti": "s",
            "flow": flow, "temperature": temperature,
        },
        "operating_point": {"flow": rest, "temperature": model.operating_temperature},
        "limits": {"low": rest + model.u_min, "high": rest + model.u_max},
    }  # fmt: skip
    listed = [
        {
            "controller": each.name,
            "kp": each.kp,
            "ti": each.ti,
            "action": _action(each),
            **shared,
            "model": each.told,
            "arguments": each.arguments,
        }
        for each in found
    ]
    return {"recommended": listed, "warnings": model.warnings}


def _action(each: Recommended) -> str:
    return "reverse" if each.kp > 0.0 else "direct"


def report(model: Model, found: list[Recommended]) -> list[Section]:
    """Return the sections of the report."""
    flow, temperature, rest = (
        model.log.flow_unit,
        model.log.temperature_unit,
        model.operating_flow,
    )
    units = {
        "delay": "samples", "dead_zone": flow, "gain": f"{temperature} per {flow}",
        "time_constant": "s",
    }  # fmt: skip
    rows = [
        (name.replace("_", " "), f"{value:.4g}", f"[{low:.4g}, {high:.4g}]", units[name])
        for name, (value, low, high) in model.estimates.items()
    ]
    warned = [f"**Nothing is recommended.** {' '.join(model.warnings)}"] * bool(model.warnings)
    text = [
        *warned,
        f"Fitted to the first two thirds of the log, the model explains "
        f"{100 * max(model.explained[0], 0.0):.1f} % of the temperature's variance in the "
        "last, by simulation from the flow. A straight line, for what is slow, is taken from "
        "both.",
        *(_typed(model, each) for each in found),
        *model.notes,
        f"All numbers are deviations from the operating point: a flow of {rest:g} {flow}, at "
        f"which the temperature is {model.operating_temperature:.4g} {temperature}. The flow "
        f"can be between {rest + model.u_min:g} and {rest + model.u_max:g} {flow}. Brackets "
        "are 95 % intervals.",
    ]
    table = pd.DataFrame(rows, columns=["", "value", "95 %", "unit"])
    return [
        Section("What the log shows", text, table),
        Section(
            "The log and the model",
            pictures={"identify.png": "The log, the model and the response to a step"},
        ),
        *([_loops(model, found)] if found else []),
    ]


def _typed(model: Model, each: Recommended) -> str:
    """Return a controller as it is typed into a control system."""
    flow, temperature, told = model.log.flow_unit, model.log.temperature_unit, each.told
    inside = (
        f" It acts on the error minus what its model foresees: {told['gain']:.4g} "
        f"{temperature} per {flow}, {told['time_constant']:.4g} s, a delay of "
        f"{told['delay']:.4g} s."
    ) * (each.name == "smith")
    return (
        f"Recommended: {LABELS[each.name]} with Kp = {each.kp:.4g} {flow} per {temperature} "
        f"and Ti = {each.ti:.3g} s, {_action(each)} acting.{inside}"
    )


def _loops(model: Model, found: list[Recommended]) -> Section:
    text = [
        "u is Kp times the sum of r - y and its integral over time divided by Ti, where u is "
        "the flow, r the set point and y the temperature, all from the operating point. "
        "Reverse acting: the flow falls when the temperature rises; direct acting: it rises. "
        "Where the action is a setting of its own, type Kp without its sign. "
        "`agents.PIController` has the opposite sign: its arguments are in controllers.json.",
        "Ms is the most that the loop amplifies a disturbance while no limit and no dead zone "
        "is met: with the model, and with 95 % of the plants that the log leaves possible, "
        "their delay a fifth longer and shorter among them."
        + " Around set points that need a flow within the dead zone the loops cycle."
        * (model.estimates["dead_zone"].value > 0.0),
        "More controllers: `python -m benchmarks.compare --plant plant.json`.",
    ]  # fmt: skip
    rows = [
        {
            "controller": LABELS[each.name],
            "Ms": f"{each.sensitivity:.2f} to {each.worst:.2f}",
            "delay margin (s)": f"{each.delay_margin:.0f}",
            "slower than by the rule": f"{each.slowed:.2f} times",
        }
        for each in found
    ]
    return Section("Recommended controllers", text, pd.DataFrame(rows))


def draw(model: Model, path: Path) -> None:
    """Draw the log with the model's simulation of it, and the step response with its band."""
    log, shown, h = model.log, slice(-SHOWN, None), model.log.sampling_interval
    minutes = (np.arange(len(log.flow)) * h / 60.0)[shown]
    title = "The log as recorded and as the model simulates it, and its response to a step"
    with drawn(path, 5, title) as figure:
        places = figure.subplot_mosaic([["y", "y"], ["u", "step"]], height_ratios=[3, 2])
        places["y"].plot(minutes, log.temperature[shown], color="0.5", lw=1, label="recorded")
        places["y"].plot(minutes, model.simulated[shown], color=COLOURS[1], label="model")
        places["y"].set(xlabel="time (min)", ylabel=f"temperature ({log.temperature_unit})")
        places["y"].legend(loc="upper left", ncols=2)
        places["y"].margins(y=0.2)  # room for the legend
        places["u"].step(minutes, log.flow[shown], where="post", color=COLOURS[0], lw=1)
        zone = model.estimates["dead_zone"].value
        if zone:
            ends = model.operating_flow - zone, model.operating_flow + zone
            places["u"].axhspan(*ends, color="0.5", alpha=0.15, lw=0, label="dead zone")
            places["u"].legend(loc="upper left")
        places["u"].set(xlabel="time (min)", ylabel=f"flow ({log.flow_unit})")
        samples = int((model.plant.delay + 5.0 * model.plant.slowest) / h) + 2
        after, ones = np.arange(samples) * h / 60.0, np.ones(samples)
        band = np.quantile([each.simulated(ones, h) for each in model.possible], ENDS, axis=0)
        places["step"].fill_between(after, *band, color=COLOURS[0], alpha=0.25, lw=0)
        places["step"].plot(after, model.plant.simulated(ones, h), color=COLOURS[0])
        unit = f"{log.temperature_unit} per {log.flow_unit}"
        places["step"].set(xlabel="time after the step (min)", ylabel=unit)
