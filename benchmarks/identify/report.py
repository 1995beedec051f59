"""Report what an identification found and what it means for control."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.bounds import least_possible
from benchmarks.bounds.linear_program import NotSolvedError
from benchmarks.identify import plots
from benchmarks.identify.model import Model
from benchmarks.identify.plant import plant_arguments
from benchmarks.identify.tuning import Recommended, recommended, reduced
from benchmarks.lib.report import Section
from benchmarks.loop.metrics import mean_error, reversals, travel
from benchmarks.loop.rollout import make_plants, rollout
from mptc_gym import Parameters

UNITS = {
    "delay": "samples",
    "dead_zone": "t/h",
    "gain": "°C per t/h",
    "time_constant": "s",
    "noise_variance": "°C²",
}
RUNS, SAMPLES, SEED = 20, 1200, 0  # for the controllers on the identified plant
LONGEST = 6_000  # longest run for which the bounds are computed, samples
POOR, BEHIND = 0.5, 0.1  # least share a model should explain; most that its rival may lead by


def report(model: Model, out: Path) -> list[Section]:
    """Draw the figures into a folder, and return the sections of the report."""
    step = reduced(model.plant)
    plots.plot_log(model, out / "log.png")
    beyond = plots.plot_residuals(model, out / "residuals.png")
    plots.plot_step(model, step, out / "step.png")
    verdict = (
        "no more than chance would have"
        if beyond <= 0.15
        else "more than chance would have: the noise or the dynamics are not of this form"
    )
    tuned = {} if fault(model) else recommended(model)
    found = {name: each for name, each in tuned.items() if each}
    sections = [
        _found(model, found),
        Section(
            "The log and the model",
            ["The model is given the flow alone, over the whole log."],
            pictures=["log.png"],
        ),
        Section(
            "What the model leaves",
            [
                "The errors of predictions one sample ahead would be white noise if the model "
                f"were right. Of their first {plots.LAGS} autocorrelations, {100 * beyond:.0f} "
                f"% are beyond the band of chance (5 % expected): {verdict}."
            ],
            pictures=["residuals.png"],
        ),
        Section(
            "Step response",
            [
                f"Of first order with delay, the plant would have a gain of {step.gain:g} °C "
                f"per t/h, a time constant of {step.time_constant:g} s and a delay of "
                f"{step.delay:g} s, the sample that any input takes to show included. These "
                "come from the areas of the whole response: shorter lags and an inverse "
                "response count as delay."
            ],
            pictures=["step.png"],
        ),
    ]
    if tuned:
        sections.append(_controllers(tuned, out))
    if found:
        sections.append(_on_the_plant(found, plant_arguments(model)))
    return sections


def fault(model: Model) -> str:
    """Return why a model should not be used; empty if it may be used."""
    share, rival = model.held_out
    if share < rival - BEHIND:
        return "it explains clearly less than an impulse response does: its form does not fit"
    gain = model.estimates["gain"]
    if gain.low < 0.0 < gain.high:
        return "not even the direction is known in which the temperature answers the flow"
    if share < POOR:
        return "it leaves more than half open: the noise hides the response, or it changes"
    return ""


def headline(model: Model) -> str:
    """Return how much the model explains, and whether it should be used."""
    share, rival = (f"{100 * max(each, 0.0):.1f} %" for each in model.held_out)
    known, why = ", ".join(model.known), fault(model)
    verdict = f"**The model should not be used:** {why}. Nothing is recommended." if why else ""
    return (
        f"Fitted to the first two thirds of the log, the model explains {share} of the "
        f"temperature's variance in the last third, by simulation from the flow"
        f"{' and ' + known if known else ''}; a finite impulse response explains {rival}. A "
        f"straight line, for the slow disturbance, is taken from both. {verdict}"
    ).strip()


def _found(model: Model, found: dict[str, Recommended]) -> Section:
    interval, rest, orders = model.plant.sampling_interval, model.operating_flow, model.orders
    rows = [
        (name, f"{each.value:.4g}", f"[{each.low:.4g}, {each.high:.4g}]", UNITS.get(name, ""))
        for name, each in model.estimates.items()
    ]
    parts = [
        (name, f"{variance:.4g}", "", "°C²")
        for name, variance in model.noise.items()
        if variance and name != "noise_variance"
    ]
    text = [
        headline(model),
        *(
            f"Recommended: {name} with Kp = {each.controller.kp:.4g} t/h per °C and an "
            f"integral time of {each.controller.kp / each.controller.ki * interval:.3g} s."
            for name, each in found.items()
        ),
        *model.notes,
        f"All numbers are deviations from the operating point: a flow of {rest:g} t/h, at "
        f"which the temperature is {model.operating_temperature:.4g} °C. The flow was between "
        f"{rest + model.u_min:g} and {rest + model.u_max:g} t/h.",
        f"A, B and C have the orders {orders.a}, {orders.b} and {orders.c}"
        f"{', with a random walk' if orders.walk else ''}. Brackets are 95 % intervals.",
        *(
            f"{name} is a known disturbance with a gain of {each.gain:.4g} °C a unit and a "
            f"delay of {each.delay} samples. `plant.json` does not have it."
            for name, each in model.known.items()
        ),
    ]
    if parts:
        text.append(
            "Noise variance and C are those of all noise together; `plant.json` splits it."
        )
    table = pd.DataFrame([*rows, *parts], columns=["", "value", "95 %", "unit"])
    return Section("What the log shows", text, table.replace("_", " ", regex=True))


def _controllers(tuned: dict[str, Recommended | None], out: Path) -> Section:
    text, rows, loops = [], [], {}
    for name, each in tuned.items():
        if each is None:
            text.append(
                f"{name}: not recommended. However slow it is made, Ms is above 2 with one in "
                "twenty of the plants that the log leaves possible."
            )
            continue
        if each.slowed > 1.0:
            text.append(
                f"{name} is de-tuned: its closed loop is {each.slowed:.2g} times slower than "
                "by the rule, for Ms to be at most 2 with 95 % of the plants that the log "
                "leaves possible."
            )
        loops[name], found = each.loop, each.loop.margins
        rows.append({
            "controller": name,
            "Kp (t/h per °C)": f"{each.controller.kp:.4g}",
            "Ki (t/h per °C and sample)": f"{each.controller.ki:.4g}",
            "gain margin": f"{found.gain:.2f}",
            "phase margin (°)": f"{found.phase:.1f}",
            "delay margin (s)": f"{found.delay:.0f}",
            "Ms": f"{found.sensitivity:.2f}",
            "Ms, 95 %": f"{each.worst:.2f}",
        })  # fmt: skip
    text.append(
        "u = -Kp e - Ki (sum of e). By rule, SIMC's PI has its closed-loop time constant at "
        "the delay, the Smith predictor at half the plant's time constant. The margins are "
        "those of the loop while no limit and no dead zone is met: by which factor the gain "
        "may rise, and by how much phase and delay may shift, before it is unstable. Ms is the "
        "most that the loop amplifies a disturbance; the last column has what 95 % of the "
        "possible plants stay below."
    )
    if not loops:
        return Section("Recommended controllers", text)
    plots.plot_margins(loops, out / "margins.png")
    return Section("Recommended controllers", text, pd.DataFrame(rows), ["margins.png"])


def _on_the_plant(found: dict[str, Recommended], arguments: dict[str, Any]) -> Section:
    parameters = Parameters(**arguments)
    samples = max(SAMPLES, 2 * parameters.setpoint_period)
    unaware, bound = _bounds(arguments, samples)
    rows = []
    for name, each in found.items():
        run = rollout(make_plants(RUNS, samples, **arguments), each.controller, samples, SEED)
        mean = float(mean_error(run).mean())
        turns = reversals(run.applied, parameters.sampling_interval).mean()
        rows.append({
            "controller": name,
            "mean |e| (°C)": f"{mean:.4g}",
            "of the least possible": f"{mean / unaware:.2f}" if unaware > 0.0 else "",
            "valve travel (t/h)": f"{travel(run).mean():.0f}",
            "reversals a minute": f"{turns:.2f}",
        })  # fmt: skip
    return Section(
        "On the identified plant",
        [
            f"A square wave of ±{parameters.setpoint_amplitude:g} °C over {samples} samples, "
            f"with the noise of the log, {RUNS} runs. {bound} More controllers: `python -m "
            "benchmarks.compare --plant plant.json`. It sets these two by two points of the "
            "step response in place of areas, so that its numbers differ a little."
        ],
        pd.DataFrame(rows),
    )


def _bounds(arguments: dict[str, Any], samples: int) -> tuple[float, str]:
    """Return the least possible mean error, degC, NaN if unknown, and a sentence about it."""
    values: list[float] = []
    why = f"{samples} samples are many"
    try:
        for kind in ("preview", "reference") if samples <= LONGEST else ():
            bound = least_possible(samples=samples, kind=kind, folder=None, **arguments)
            values.append(bound.value)
    except (NotSolvedError, ValueError) as error:  # the set point changes too soon
        why = str(error)
    if not values:
        return math.nan, f"The least possible mean error is not known: {why}."
    least = f"{values[-1]:.4g} °C"
    if len(values) > 1:
        least += " for one that learns of a change when it happens, with the plant settled, "
        least += f"and {values[0]:.4g} °C"
    return values[-1], (
        f"The least possible mean error is {least} for a controller that knows the set point "
        "beforehand."
    )
