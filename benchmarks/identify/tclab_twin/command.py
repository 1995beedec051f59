"""Identify and control TCLab's digital twin, a plant from another project.

Run `python -m benchmarks.identify.tclab_twin` after `pip install tclab`. The lab is a small
heater with a sensor, for teaching; its package simulates it with four internal temperatures, a
sensor resolution of 0.32 degC, and noise. Heater 1, in percent, stands for the flow. (28) is
identified from steps of the heater, and the controllers tuned from it run on the twin, beside
the PI tuning taught in courses with this lab.
"""

from __future__ import annotations

import contextlib
import io
import random

import numpy as np
import tclab  # type: ignore[import-untyped, unused-ignore]
from numpy.typing import NDArray
from rich.console import Console

from agents import Controller, PIController
from benchmarks.controllers.engineered import nn_smith
from benchmarks.identify.fit import identify
from benchmarks.identify.log import Log
from benchmarks.identify.model import Model
from benchmarks.identify.options import Knowledge
from benchmarks.identify.plant import plant_arguments
from benchmarks.identify.tclab_twin.options import Options
from benchmarks.identify.tuning import recommended
from mptc_gym import Parameters

INTERVAL = 4.0  # s
HEATER = 40.0  # %, the operating point
LOW, HIGH = -HEATER, 100.0 - HEATER  # the heater's limits, % from the operating point
SETTLING = 1200.0  # s at the operating point before anything is recorded
LEVELS = (55.0, 30.0, 65.0, 45.0, 25.0, 50.0, 35.0, 60.0)  # heater powers of the experiment, %
HELD = 100  # samples for which each is held
SETPOINTS = (8.0, -6.0, 4.0, -8.0)  # degC from the operating point
EACH = 200  # samples for which each set point is held

# Kc = 6 %/degC and tau_I = 75 s, without derivative action: the PI controller in the PID lesson
# of the course that came with the hardware (J. D. Hedengren, APMonitor), and widely used since.
COURSE = PIController(
    kp=-6.0, ki=-6.0 * INTERVAL / 75.0, anti_windup=True, u_min=LOW, u_max=HIGH
)


class Twin:
    """TCLab's digital twin as a plant in deviations from an operating point.

    The clock is advanced step by step, so that a run takes milliseconds and is reproducible.
    The seed is that of the sensor's noise.
    """

    def __init__(self, seed: int) -> None:
        random.seed(seed)  # the twin draws from Python's own generator
        with contextlib.redirect_stdout(io.StringIO()):  # it prints a greeting
            self._lab = tclab.setup(connected=False)(synced=False)
        self._time = 0.0
        self.step(0.0, SETTLING)
        self.rest = float(np.mean([self._lab.T1 for _ in range(20)]))

    def temperature(self) -> float:
        """Return the measured temperature, degC from the operating point."""
        return float(self._lab.T1) - self.rest

    def step(self, command: float, seconds: float = INTERVAL) -> None:
        """Hold a heater power, % from the operating point, for a time."""
        self._lab.Q1(HEATER + command)
        self._time += seconds
        self._lab.update(self._time)


def experiment(seed: int = 0) -> Log:
    """Move the heater in steps, and return the log."""
    twin = Twin(seed)
    commands = np.repeat(LEVELS, HELD) - HEATER
    temperatures = np.empty(len(commands))
    for k, command in enumerate(commands):
        temperatures[k] = twin.temperature()
        twin.step(command)
    return Log(HEATER + commands, twin.rest + temperatures, INTERVAL)


def model_of(log: Log) -> Model:
    """Return the model identified from a log. The heater has no dead zone."""
    known = Knowledge(
        longest_delay=20, applied=True, u_min=LOW, u_max=HIGH, operating_flow=HEATER
    )
    return identify(log, known)


def controllers(model: Model) -> dict[str, Controller]:
    """Return the controllers tuned from the model, and the course's."""
    found = {name: each.controller for name, each in recommended(model).items() if each}
    told = nn_smith(Parameters(**plant_arguments(model)))
    return {**found, "nn-smith": told, "PI, course": COURSE}


def run(controller: Controller, seed: int = 1) -> NDArray[np.float64]:
    """Return set point, temperature and heater power as deviations, one row per sample.

    As in the environment, row k holds the heater power from k on, and its result at k + 1.
    """
    twin = Twin(seed)
    controller.reset()
    setpoints = np.repeat(SETPOINTS, EACH)
    rows, temperature = [], twin.temperature()
    for setpoint, following in zip(setpoints, [*setpoints[1:], setpoints[-1]], strict=True):
        controller.act([setpoint, 0.0, 0.0, setpoint - temperature])
        command = float(np.clip(controller.command, LOW, HIGH))
        twin.step(command)
        temperature = twin.temperature()
        rows.append((following, temperature, command))
    return np.array(rows)


def execute(_options: Options, console: Console) -> str:
    """Print the identified model, and the results of the controllers on the twin."""
    model = model_of(experiment())
    for name in ("delay", "gain", "time_constant"):
        found = model.estimates[name]
        span = f"95 %: {found.low:.3g} to {found.high:.3g}"
        console.print(f"{name:14s} {found.value:8.3g}   {span}")
    console.print("controller      mean |e| (°C)   heater travel (%)")
    for name, controller in controllers(model).items():
        setpoint, temperature, heater = run(controller).T
        error = np.abs(setpoint - temperature).mean()
        travel = np.abs(np.diff(heater, prepend=0.0)).sum()
        console.print(f"{name:14s} {error:13.3f} {travel:19.0f}")
    return "The flow stands for the power of heater 1, in percent."
