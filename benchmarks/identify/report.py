"""Report on an identified plant, its controller and the log."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.identify.model import Model
from benchmarks.lib.pictures import COLOURS, open_picture
from benchmarks.lib.report import Section
from benchmarks.lib.statistics import ENDS

SHOWN = slice(-4_000, None)  # rows that are drawn: more would blur
TITLE = "The log as recorded and as the model simulates it, and its response to a step"
HOW = (
    "u is Kp times the sum of r - y and its integral over time divided by Ti, where u is "
    "the flow, r the set point and y the temperature, all from the operating point. Reverse "
    "acting: the flow falls when the temperature rises; direct acting: it rises. Where the "
    "action is a setting of its own, type Kp without its sign. `agents.PIController` has "
    "the opposite sign: its arguments are in controllers.json.",
    "Ms is the most that the loop amplifies a disturbance: with the model, and with 95 % of "
    "the plants that the log leaves possible, their delays a fifth longer and shorter. Around "
    "set points that need a flow within a dead zone the loop cycles.",
)


def report(model: Model, advised: dict[str, Any]) -> list[Section]:
    """Return the sections of the report; `advised` is the content of `controllers.json`."""
    given, rest = model.log.given, model.operating_flow
    flow, degree = given.flow_unit, given.temperature_unit
    units = {"delay": "samples", "dead_zone": flow, "gain": f"{degree} per {flow}"}
    rows = [
        (name.replace("_", " "), f"{at:.4g}", f"[{low:.4g}, {high:.4g}]", units.get(name, "s"))
        for name, (at, low, high) in model.estimates.items()
    ]
    advice = [
        f"Recommended: PI (SIMC) with Kp = {each['kp']:.4g} {flow} per {degree} and "
        f"Ti = {each['ti']:.3g} s, {each['action']} acting. Ms is "
        f"{each['sensitivity'][0]:.2f} to {each['sensitivity'][1]:.2f}; the loop is "
        f"{each['slowed']:.2f} times slower than by the rule."
        for each in advised["recommended"]
    ]
    text = [
        *(advice or [f"**Nothing is recommended.** {' '.join(advised['warnings'])}"]),
        "Fitted to the first two thirds of the log, the model explains "
        f"{100 * max(model.explained[0], 0.0):.1f} % of the temperature's variance in the "
        "last, by simulation from the flow, but for a straight line.",
        *model.notes,
        f"All numbers are deviations from the operating point: a flow of {rest:g} {flow}, at "
        f"which the temperature is {model.operating_temperature:.4g} {degree}. The flow can be "
        f"between {rest + model.u_min:g} and {rest + model.u_max:g} {flow}. Brackets are 95 % "
        "intervals.",
    ]
    table = pd.DataFrame(rows, columns=["", "value", "95 %", "unit"])
    shown = Section("What the log shows", text, table, {"identify.png": TITLE})
    return [shown, *[Section("How to type the controller", HOW)] * bool(advice)]


def draw(model: Model, path: Path) -> None:
    """Draw the log with the model's simulation of it, and the step response with its band."""
    log, h, plant = model.log, model.log.sampling_interval, model.plant
    flow, degree = log.given.flow_unit, log.given.temperature_unit
    minutes = (np.arange(len(log.flow)) * h / 60.0)[SHOWN]
    with open_picture(path, 5, TITLE) as figure:
        places = figure.subplot_mosaic([["y", "y"], ["u", "step"]], height_ratios=[3, 2])
        above, below, step = places.values()
        above.plot(minutes, log.temperature[SHOWN], color="0.5", lw=1, label="recorded")
        above.plot(minutes, model.simulated[SHOWN], color=COLOURS[1], label="model")
        above.set(xlabel="time (min)", ylabel=f"temperature ({degree})")
        above.legend(loc="upper left", ncols=2)
        above.margins(y=0.2)  # room for the legend
        below.step(minutes, log.flow[SHOWN], where="post", color=COLOURS[0], lw=1)
        zone = model.estimates["dead_zone"].value * np.array([-1.0, 1.0])
        below.axhspan(*(model.operating_flow + zone), color="0.9", label="dead zone")
        below.legend(loc="upper left")
        below.set(xlabel="time (min)", ylabel=f"flow ({flow})")
        ones = np.ones(int((plant.delay + 5.0 * plant.slowest) / h) + 2)
        after = np.arange(len(ones)) * h / 60.0
        band = np.quantile([each.simulated(ones, h) for each in model.possible], ENDS, axis=0)
        step.fill_between(after, *band, color=COLOURS[0], alpha=0.25, lw=0)
        step.plot(after, plant.simulated(ones, h), color=COLOURS[0])
        step.set(xlabel="time after the step (min)", ylabel=f"{degree} per {flow}")
