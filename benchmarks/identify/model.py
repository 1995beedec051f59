"""Identify a plant from a log, and doubt what was found."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from benchmarks.identify.fit import Array, Fit, Plant
from benchmarks.identify.log import Log
from benchmarks.identify.search import FAULT, HYSTERESES, VALVES, Found, draws, search

TEST = (
    "The test that tells: move the flow by small steps, twice up and twice down, and then from "
    "one end to the other."
)


class Interval(NamedTuple):
    """An estimate with its 95 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Model:
    """A plant identified from a log, in deviations from the operating point as in (28)."""

    log: Log
    found: Found
    possible: list[Plant]  # drawn from all that the log leaves possible
    tested: bool  # whether the log tells what the valve does
    # `delay` (samples), `dead_zone` (t/h), `gain` (degC per t/h) and `time_constant` (s, of the
    # slowest lag).
    estimates: dict[str, Interval]
    operating_flow: float  # t/h, where u is 0
    operating_temperature: float  # degC, where y is 0
    u_min: float  # smallest flow, t/h from the operating point
    u_max: float  # largest one
    simulated: Array  # temperatures without noise, degC, one a row
    explained: tuple[float, float]  # of the last third by a fit to the others; see `held_out`

    @property
    def plant(self) -> Plant:
        """The most likely plant."""
        return self.found.best.plant

    @property
    def notes(self) -> list[str]:
        """What a user should know of the log and the fit."""
        best, valve, log = self.found.best, self.found.valve, self.log
        size, unit = f"{valve.size:.3g}", log.given.flow_unit
        if valve.name == "rate limit":
            size, unit = f"{valve.size / best.h:.3g}", f"{unit} a second"
        times = ", ".join(f"{at / 60.0:.0f}" for at in sorted(best.loads))
        remarks = {
            f"The valve seems to have a {valve.name} of {size} {unit}; plant.json can hold "
            "limits and a plain dead zone alone.": valve.name not in ("none", "dead zone"),
            f"Loads seem to have moved the temperature at {times} min.": bool(best.loads),
            f"plant.json cannot hold {', '.join(log.disturbances)}.": bool(log.disturbances),
        }
        return [*log.notes, *(each for each, holds in remarks.items() if holds)]

    @cached_property
    def warnings(self) -> list[str]:
        """Why no controller should be tuned on the model; empty if it may be used."""
        found, gain = self.found, self.estimates["gain"]
        errors, fault = found.best.solution.errors, found.faults[0]
        evident = fault.drop > FAULT
        alike = np.correlate(errors, errors, "full")[len(errors) :][:30] / (errors @ errors)
        large = np.abs(alike) > max(0.1, 2.5 / np.sqrt(len(errors)))
        bar = max(found.valve.drop - 6.0, FAULT)  # valves above it explain the log alike
        rivals = [abs(each.fit.plant.gain) for each in found.rivals if each.drop > bar]
        doubts = {
            "The log does not test the valve, as the flow had so few values. Record a dozen "
            "flows, or the flow behind the valve (--applied).": not self.tested,
            f"The valve does not seem to pass what it is told: {fault.name} of "
            f"{fault.size:.2g} {self.log.given.flow_unit}, or another fault. {TEST} If the "
            "temperature follows alike, the plant is not of the model's form.":
            evident and fault.name in HYSTERESES,
            f"The plant seems to change: {fault.name}. Identify each level, time or direction "
            "from a log of its own.": evident and fault.name not in HYSTERESES,
            "Valves of two kinds explain the log alike, and the plants behind them differ. "
            + TEST: max(rivals, default=1.0) > 1.3 * min(rivals, default=1.0),
            "Not even the direction is known in which the temperature answers. Move the flow "
            "further, a dozen times, and let it settle each time.": gain.low * gain.high <= 0.0,
            "The delay may be longer than a sixth of the log, which is not looked for: record "
            "a longer one.": self.estimates["delay"].high >= len(self.log.flow) / 6.0,
            "The model leaves more than half open: the noise hides the response, or it "
            "changes. Move the flow further, and look for other inputs (--disturbance).":
            max(self.explained) < 0.5,
            "The prediction errors are far from white: the plant or its disturbances are not "
            "of the model's form.": bool(large.mean() > 0.25),
        }  # fmt: skip
        return [sentence for sentence, holds in doubts.items() if holds]


def identify(log: Log) -> Model:
    """Return the plant of a log; a ValueError says why it does not show one at all."""
    _check(log)
    h, given, level = log.sampling_interval, log.given, float(np.nanmean(log.temperature))
    rest = resting_flow(log.flow, given.operating_flow)
    command, moved = log.flow - rest, log.temperature - level
    known = tuple(each - each[0] for each in log.disturbances.values())
    found = search(Fit(command - command[0], moved, h, known), command, applied=given.applied)
    best, plant, valve = found.best, found.best.plant, found.valve
    if plant.slowest > len(command) * h / 5.0:
        raise ValueError(
            "the log does not show where the temperature settles: record a longer one, in "
            "which the flow is held until the temperature has nearly settled"
        )
    # Of flows that differ by noise alone, one counts.
    flows = np.unique(np.round(log.flow / (0.02 * np.ptp(log.flow))))
    tested = given.applied or len(flows) >= 5
    possible, ends = draws(found, command)
    zone = _interval(valve.size if valve.name.endswith("dead zone") else 0.0, ends)
    delay = _interval(plant.delay / h, [each.delay / h for each in possible])
    estimates = {
        "delay": Interval(delay.value, max(delay.low - 0.5, 0.0), delay.high + 0.5),
        "dead_zone": zone if tested else Interval(0.0, 0.0, float(np.abs(command).max())),
        "gain": _interval(plant.gain, [each.gain for each in possible]),
        "time_constant": _interval(plant.slowest, [each.slowest for each in possible]),
    }
    end = valve.size if valve.name == "saturation" else np.inf
    start = VALVES[valve.name].passed(command, valve.size)[0]
    c = best.solution.c
    return Model(
        log, found, possible, tested, estimates, rest,
        operating_temperature=float(level + c[-1] - plant.gain * start),
        u_min=max(float(command.min()), -end) if given.u_min is None else given.u_min,
        u_max=min(float(command.max()), end) if given.u_max is None else given.u_max,
        simulated=level + replace(best, rows=1, temperature=moved).columns[0] @ c,
        explained=held_out(best),
    )  # fmt: skip


def resting_flow(flow: Array, given: float | None = None) -> float:
    """Return 0 or the first flow if it is well inside the range, else the range's middle."""
    low, high = float(flow.min()), float(flow.max())
    if given is not None and not 2.0 * low - high <= given <= 2.0 * high - low:
        raise ValueError(
            f"operating_flow must be near the flows of the log, {low:g} to {high:g}, "
            f"got {given:g}"
        )
    middle, quarter = (low + high) / 2.0, (high - low) / 4.0
    inside = [each for each in (0.0, float(flow[0])) if abs(each - middle) <= quarter]
    return [*inside, middle][0] if given is None else given


def _interval(value: float, values: list[float]) -> Interval:
    low, high = np.quantile(values, (0.025, 0.975))
    return Interval(float(value), min(float(low), value), max(float(high), value))


def _check(log: Log) -> None:
    """Raise a ValueError if no plant can be seen in a log.

    That is so if the flow's moves are a linear controller's, but for few: the least absolute
    errors of a regression on the last temperatures leave the others as outliers.
    """
    for name, values in (("flow", log.flow), ("temperature", log.temperature)):
        if not np.nanmax(values) - np.nanmin(values) > 1e-9 * np.nanmax(np.abs(values)):
            raise ValueError(f"the {name} is constant: the log does not show a response")
    u, y, span = log.flow, log.temperature, float(np.ptp(log.flow))
    table = np.column_stack([y[2:], y[1:-1], y[:-2], u[1:-1], np.ones(len(u) - 2)])
    there = np.isfinite(table).all(axis=1)
    table, moves = table[there], np.diff(u)[1:][there]
    weight = np.ones(len(table))
    for _ in range(20):
        law = np.linalg.lstsq(table * weight[:, np.newaxis], moves * weight, rcond=None)[0]
        left = np.abs(moves - table @ law)
        weight = 1.0 / np.sqrt(left + 1e-4 * span)
    typical = float(np.median(left))
    own = left > max(8.0 * typical, 0.02 * span)
    if typical < 0.5 * np.median(np.abs(moves)) and own.sum() < 4:
        raise ValueError(
            "the flow follows the temperature, and nothing else moves it: in a closed loop "
            "with a constant set point, the log shows the controller. Move the set point, or "
            "the flow by hand"
        )


def held_out(fit: Fit) -> tuple[float, float]:
    """Return what a fit to the first two thirds explains of the last: variance, and changes.

    A straight line is taken from the errors, for what is slow. Changes are those over one
    response, among which slow disturbances do not count.
    """
    y = fit.temperature
    cut = 2 * len(y) // 3
    first = replace(fit, temperature=np.where(np.arange(len(y)) < cut, y, np.nan)).refined()
    error = y - first.columns[0] @ first.solution.c
    y, error = y[cut:], error[cut:]
    known = np.flatnonzero(np.isfinite(y))
    line = np.polyval(np.polyfit(known, error[known], 1), np.arange(len(y)))
    later = int(fit.scale / fit.h / fit.rows) + 1
    later = min(later, len(y) // 3)
    changes = np.nanvar(error[later:] - error[:-later]) / np.nanvar(y[later:] - y[:-later])
    return float(1.0 - np.nanvar(error - line) / np.nanvar(y - line)), float(1.0 - changes)
