"""Report what an identification found and what it means for control."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.bounds.least import least_possible
from benchmarks.bounds.linear_program import NotSolvedError
from benchmarks.identify import plots
from benchmarks.identify.guards import LAGS, autocorrelation, chance
from benchmarks.identify.model import Model
from benchmarks.identify.plant import plant_arguments
from benchmarks.identify.tuning import Recommended
from benchmarks.lib.report import Section
from mptc_gym import Parameters

LABELS = {"pi-simc": "PI (SIMC)", "smith": "Smith"}


def report(model: Model, found: list[Recommended], out: Path) -> list[Section]:
    """Draw the figures into a folder, and return the sections of the report."""
    plots.plot_log(model, out / "log.png")
    plots.plot_residuals(model, out / "residuals.png")
    plots.plot_step(model, out / "step.png")
    beyond = 100 * (abs(autocorrelation(model.errors)) > chance(model.errors)).mean()
    white = (
        "The errors of predictions one sample ahead would be white noise if the model were "
        f"right. Of their first {LAGS} autocorrelations, {beyond:.0f} % are beyond the band of "
        "chance (5 % expected)."
    )
    return [
        _found(model, found),
        Section("The log and the model", pictures={"log.png": "The log and the model"}),
        Section("Prediction errors", [white], pictures={"residuals.png": "Prediction errors"}),
        Section("Step response", pictures={"step.png": "Step response"}),
        *([_controllers(model, found)] if found else []),
    ]


def recommendations(model: Model, found: list[Recommended]) -> dict[str, Any]:
    """Return the content of `controllers.json`."""
    listed = [
        {
            "controller": each.name,
            "kp": each.kp,
            "ti": each.ti,
            "action": _action(each),
            "sampling_interval": each.told.sampling_interval,
            **(_smith(model, each) if each.name == "smith" else {}),
        }
        for each in found
    ]
    return {"recommended": listed, "warnings": model.warnings}


def _smith(model: Model, each: Recommended) -> dict[str, Any]:
    """Return what a Smith predictor is told besides its gains."""
    return {"model": vars(each.told), "dead_zone": model.estimates["dead_zone"].value}


def _action(each: Recommended) -> str:
    return "reverse" if each.kp > 0.0 else "direct"


def headline(model: Model) -> list[str]:
    """Return whether a model may be used, and how much it explains."""
    share, rival = (f"{100 * max(each, 0.0):.1f} %" for each in model.held_out)
    known = "".join(f" and {name}" for name in model.known)
    warned = [f"**Nothing is recommended.** {' '.join(model.warnings)}"] * bool(model.warnings)
    return [
        *warned,
        "Fitted to the first two thirds of the moves, the model explains "
        f"{share} of the temperature's variance in the rest of the log, by simulation from the "
        f"flow{known}; a finite impulse response explains {rival}. A straight line, for the "
        "slow disturbance, is taken from both.",
    ]


def _units(model: Model) -> tuple[str, str]:
    return model.log.flow_unit, model.log.temperature_unit


def _typed(model: Model, each: Recommended) -> str:
    """Return a controller as it is typed into a control system."""
    (flow, temperature), told = _units(model), each.told
    inside = (
        f" It acts on the error minus what its model foresees: {told.gain:g} {temperature} per "
        f"{flow}, {told.time_constant:g} s, a delay of {told.delay:g} s. It is told a dead "
        f"zone of {model.estimates['dead_zone'].value:.3g} {flow}."
    ) * (each.name == "smith")
    return (
        f"Recommended: {LABELS[each.name]} with Kp = {each.kp:.4g} {flow} per {temperature} "
        f"and Ti = {each.ti:.3g} s, {_action(each)} acting.{inside}"
    )


def _found(model: Model, found: list[Recommended]) -> Section:
    (flow, temperature), rest, orders = _units(model), model.operating_flow, model.orders
    units = {
        "delay": "samples", "dead_zone": flow, "gain": f"{temperature} per {flow}",
        "time_constant": "s", "noise_variance": f"{temperature}²",
    }  # fmt: skip
    rows = [
        (name, f"{each.value:.4g}", f"[{each.low:.4g}, {each.high:.4g}]", units[name])
        for name, each in model.estimates.items()
    ]
    text = [
        *headline(model),
        *(_typed(model, each) for each in found),
        *model.notes,
        f"All numbers are deviations from the operating point: a flow of {rest:g} {flow}, at "
        f"which the temperature is {model.operating_temperature:.4g} {temperature}. The flow "
        f"was between {rest + model.u_min:g} and {rest + model.u_max:g} {flow}.",
        f"A, B and C have the orders {orders.a}, {orders.b} and {orders.c}"
        f"{', with a random walk' if orders.walk else ''}. Brackets are 95 % intervals. The "
        "noise variance is that of all noise together; `plant.json` splits it.",
        *(
            f"{name} is a known disturbance with a gain of {each.gain:.4g} {temperature} a "
            f"unit and a delay of {each.delay} samples. `plant.json` does not have it."
            for name, each in model.known.items()
        ),
    ]
    table = pd.DataFrame(rows, columns=["", "value", "95 %", "unit"])
    return Section("What the log shows", text, table.replace("_", " ", regex=True))


def _controllers(model: Model, found: list[Recommended]) -> Section:
    (flow, temperature), arguments = _units(model), plant_arguments(model)
    least, bound = _bound(arguments, found[0].samples, temperature)
    text = [
        "u is Kp times the sum of r - y and its integral over time divided by Ti, where u is "
        f"the flow, {flow}, r the set point and y the temperature, {temperature}, all from "
        "the operating point. Reverse acting: the flow falls when the temperature rises; "
        "direct acting: it rises. Where the action is a setting of its own, type Kp without "
        "its sign.",
        *(
            f"{LABELS[each.name]} is de-tuned: its closed loop is {each.slowed:.2g} times "
            "slower than by the rule, for Ms to be at most 2 with 95 % of the plants that the "
            "log leaves possible."
            for each in found if each.slowed > 1.0
        ),
        "By rule, SIMC's PI has its closed-loop time constant at the delay, Smith's predictor "
        "at half the plant's. The margins hold while no limit and no dead zone is met: by what "
        "factor the gain may rise, and by how much phase and delay may shift, until the loop "
        "is unstable. Ms is the most that the loop amplifies a disturbance; 95 % of the "
        "possible plants stay below the second number."
        + " Around set points that need a flow within the dead zone the loops cycle."
        * (model.estimates["dead_zone"].value > 0.0),
        "The mean |e| is that of a square wave of "
        f"±{Parameters(**arguments).setpoint_amplitude:g} {temperature} over "
        f"{found[0].samples} samples on the identified plant, with the noise of the log, the "
        f"same for all controllers, {found[0].error.runs} runs; brackets are 95 % intervals. "
        f"{bound} More controllers: `python -m benchmarks.compare --plant plant.json`.",
    ]  # fmt: skip
    rows = []
    for each in found:
        margins = each.loop.margins
        rows.append({
            "controller": LABELS[each.name],
            "gain margin": f"{margins.gain:.2f}",
            "phase margin (°)": f"{margins.phase:.1f}",
            "delay margin (s)": f"{margins.delay:.0f}",
            "Ms": f"{margins.sensitivity:.2f} to {each.worst:.2f}",
            f"mean |e| ({temperature})": f"{each.error:.4g}",
            "of the least possible": f"{each.error.scaled(1.0 / least):.2f}" if least else "",
            f"valve travel ({flow})": f"{each.travel:.0f}",
        })  # fmt: skip
    return Section("Recommended controllers", text, pd.DataFrame(rows))


def _bound(arguments: dict[str, Any], samples: int, unit: str) -> tuple[float, str]:
    """Return the least possible mean error, 0 if unknown, and a sentence about it."""
    if samples > 6_000:  # it would take minutes
        return 0.0, f"For {samples} samples, the least possible mean error is not computed."
    try:
        bound = least_possible(samples=samples, folder=None, **arguments)
    except (NotSolvedError, ValueError) as error:
        return 0.0, f"The least possible mean error is not known: {error}."
    return bound.value, f"The least possible mean error is {bound.value:.4g} {unit}."
