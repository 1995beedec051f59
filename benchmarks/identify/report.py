"""What an identification found, and what it means for control, as sections of a report."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.controllers.engineered import simc_pi, smith
from benchmarks.controllers.step_test import step_test
from benchmarks.identify import plots
from benchmarks.identify.log import Log
from benchmarks.identify.model import Interval, Model
from benchmarks.identify.plant import explained, plant_arguments
from benchmarks.lib.report import Section
from benchmarks.limits import least_possible
from benchmarks.limits.programme import NotSolvedError
from benchmarks.margins import Loop, Margins, margins, plot_margins
from benchmarks.metrics import mean_error, reversals, travel
from benchmarks.rollout import make_plants, rollout
from mptc_gym import Parameters

UNITS = {
    "delay": "samples",
    "dead_zone": "t/h",
    "gain": "°C per t/h",
    "time_constant": "s",
    "noise_variance": "°C²",
}
RUNS, SAMPLES, SEED = 20, 1200, 0  # of the controllers on the identified plant


def report(log: Log, model: Model, out: Path) -> list[Section]:
    """Draw the pictures, and return what there is to say.

    Parameters
    ----------
    log
        What was recorded.
    model
        What was found.
    out
        Where to write the pictures.
    """
    arguments = plant_arguments(model)
    parameters = Parameters(**arguments)
    tested = step_test(parameters)
    plots.plot_log(log, model, out / "log.png")
    plots.plot_residuals(model, out / "residuals.png")
    plots.plot_step(model, tested, out / "step.png")
    return [
        _found(log, model),
        _simulated(log, model),
        _residuals(model),
        Section(
            "Step response",
            [
                f"A step test would show a gain of {tested.gain:g} °C per t/h, a time constant "
                f"of {tested.time_constant:g} s and a delay of {tested.delay:g} s, the sample "
                "that any input takes to show included."
            ],
            pictures=["step.png"],
        ),
        _controllers(parameters, out),
        _on_the_plant(arguments),
    ]


def _found(log: Log, model: Model) -> Section:
    text = [
        "All numbers are deviations from the operating point: a flow of "
        f"{model.operating_flow:g} t/h, at which the temperature is "
        f"{model.operating_temperature:.4g} °C. The flow was between "
        f"{model.operating_flow + model.u_min:g} and {model.operating_flow + model.u_max:g} "
        "t/h.",
        f"A, B and C have the orders {model.orders.a}, {model.orders.b} and {model.orders.c}. "
        "Brackets are 95 % intervals.",
        *log.notes,
        *model.notes,
    ]
    rows = [
        (name.replace("_", " "), f"{each.value:.4g}", brackets(each), UNITS.get(name, ""))
        for name, each in model.estimates.items()
    ]
    return Section(
        "What the log shows", text, pd.DataFrame(rows, columns=["", "value", "95 %", "unit"])
    )


def brackets(interval: Interval) -> str:
    """Return an interval as text."""
    return f"[{interval.low:.4g}, {interval.high:.4g}]"


def _simulated(log: Log, model: Model) -> Section:
    share = 100 * explained(model, log)
    return Section(
        "The log and the model",
        [
            "The model is given the flow, and starts from the first temperatures; it is not "
            f"corrected later. It explains {share:.1f} % of the temperature's variance."
        ],
        pictures=["log.png"],
    )


def _residuals(model: Model) -> Section:
    known = int(np.isfinite(model.errors).sum())
    correlation = plots.autocorrelation(model.errors)[1:]
    beyond = np.mean(np.abs(correlation) > 1.96 / math.sqrt(known))
    verdict = (
        "no more than chance would have"
        if beyond <= 0.15
        else "more than chance would have: the noise or the dynamics are not of this form"
    )
    return Section(
        "What the model leaves",
        [
            "The errors of predictions one sample ahead would be white noise if the model were "
            f"right. Of their first {len(correlation)} autocorrelations, {100 * beyond:.0f} % "
            f"are beyond the band of chance (5 % expected): {verdict}."
        ],
        pictures=["residuals.png"],
    )


def tuned(parameters: Parameters) -> dict[str, Any]:
    """Return the controllers that are tuned from a step test of the plant, by name."""
    return {"PI, SIMC": simc_pi(parameters), "Smith": smith(parameters)}


def _controllers(parameters: Parameters, out: Path) -> Section:
    controllers = tuned(parameters)
    plot_margins(
        {name: Loop.of(agent, parameters) for name, agent in controllers.items()},
        out / "margins.png",
    )
    rows = [
        (name, f"{agent.kp:.4g}", f"{agent.ki:.4g}", *shown(margins(agent, parameters)))
        for name, agent in controllers.items()
    ]
    columns = ["controller", "Kp (t/h per °C)", "Ki (t/h per °C and sample)", *HEADINGS]
    return Section(
        "Controllers tuned from the step test",
        [
            "u = -Kp e - Ki (sum of e). SIMC's PI has its closed-loop time constant at the "
            "delay, the Smith predictor at half the plant's time constant. The margins are "
            "those of the loop while no limit and no dead zone is met: by which factor the "
            "gain may rise, and by how much phase and delay may shift, before it is unstable. "
            "Ms is the most that the loop amplifies a disturbance; 1.4 to 2 is usual."
        ],
        pd.DataFrame(rows, columns=columns),
        ["margins.png"],
    )


HEADINGS = ("gain margin", "phase margin (°)", "delay margin (s)", "Ms")


def shown(found: Margins) -> tuple[str, ...]:
    """Return margins as cells of a table, under `HEADINGS`."""
    if not found.stable:
        return ("not stable", "", "", "")
    return (
        f"{found.gain:.2f}",
        f"{found.phase:.1f}",
        f"{found.delay:.0f}",
        f"{found.sensitivity:.2f}",
    )


def _on_the_plant(arguments: dict[str, Any]) -> Section:
    parameters = Parameters(**arguments)
    period = parameters.setpoint_period
    samples = max(SAMPLES, 2 * period)
    rows = []
    try:
        anyone, unaware = (
            least_possible(samples=samples, kind=kind, folder=None, **arguments).value
            for kind in ("preview", "reference")
        )
        bound = (
            f"The least possible mean error is {unaware:.4g} °C if a change of the set point "
            f"is news and finds the plant settled, and {anyone:.4g} °C for a controller that "
            "knows it beforehand."
        )
    except NotSolvedError as error:
        unaware = math.nan
        bound = f"The least possible mean error is not known: {error}."
    for name, agent in tuned(parameters).items():
        run = rollout(make_plants(RUNS, samples, **arguments), agent, samples, SEED)
        mean = float(mean_error(run).mean())
        moves = travel(run).mean()
        turns = reversals(run.applied, parameters.sampling_interval).mean()
        rows.append(
            (name, f"{mean:.4g}", f"{mean / unaware:.2f}", f"{moves:.0f}", f"{turns:.2f}")
        )
    columns = [
        "controller", "mean |e| (°C)", "of the least possible", "valve travel (t/h)",
        "reversals a minute",
    ]  # fmt: skip
    return Section(
        "On the identified plant",
        [
            f"A square wave of ±{parameters.setpoint_amplitude:g} °C over {samples} samples, "
            f"with the noise of the log, {RUNS} runs. {bound} More controllers: `python -m "
            "benchmarks.compare --plant plant.json`."
        ],
        pd.DataFrame(rows, columns=columns),
    )
