"""Identify a plant from a log, and doubt what was found."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from benchmarks.identify.__main__ import Knowledge
from benchmarks.identify.fit import Array, Plant, Problem
from benchmarks.identify.log import Log
from benchmarks.identify.search import FAULT, FAVOUR, Found, draws, possible_zones, search
from benchmarks.identify.valve import SOUND, VALVES

LAGS = 30  # of the autocorrelation of the errors, blocks
COMMANDS = 5  # distinct ones, at least, that test a valve
RIVAL = 1.3  # largest ratio of the gains behind valves that explain a log alike
TEST = (
    "The test that tells: move the flow up and down in small steps, twice in each direction, "
    "and then from one end to the other."
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
    possible: list[Plant]
    """Plants drawn from all that the log leaves possible."""
    estimates: dict[str, Interval]
    """`delay` (samples), `dead_zone` (t/h), `gain` (degC per t/h) and `time_constant` (s, of
    the slowest lag)."""
    operating_flow: float
    operating_temperature: float
    """t/h and degC, where u and y are 0."""
    u_min: float
    u_max: float
    """Limits, t/h from the operating point."""
    simulated: Array
    """Temperatures without noise, degC, one a row."""
    explained: tuple[float, float]
    """What a fit to the first two thirds explains of the last third, as `held_out` has it."""
    notes: list[str] = field(default_factory=list)
    """Remarks for the user."""
    warnings: list[str] = field(default_factory=list)
    """Why no controller should be tuned on the model; empty if it may be used."""

    @property
    def plant(self) -> Plant:
        """The most likely plant."""
        return self.found.plant


def identify(log: Log, knowledge: Knowledge | None = None, seed: int = 0) -> Model:
    """Return the plant of a log, with warnings of what speaks against it.

    Raises
    ------
    ValueError
        If the log does not show a plant at all; the message says why.
    """
    told, h = knowledge or Knowledge(), log.sampling_interval
    _check(log)
    rest, level = (
        _operating_flow(log.flow, told.operating_flow),
        float(np.nanmean(log.temperature)),
    )
    command, moved = log.flow - rest, log.temperature - level
    known = tuple(each - each[0] for each in log.disturbances.values())
    problem = Problem(command - command[0], moved, h, known)
    found = search(problem, command, applied=told.applied)
    plant, valve, base = found.plant, found.valve, level + found.problem.level
    if plant.slowest > len(command) * h / 5.0:
        raise ValueError(
            "the log does not show where the temperature settles: record a longer one, in "
            "which the flow is held until the temperature has nearly settled"
        )
    zones = possible_zones(found, command)
    drawn = draws(found, zones, np.random.default_rng(seed))
    possible, at = [each for each, _ in drawn], [i for _, i in drawn]
    delay = _interval(plant.delay / h, [each.delay / h for each in possible])
    low, high = np.quantile([zones.low[at], zones.high[at]], (0.025, 0.975), axis=1).diagonal()
    size = valve.size if valve.name.endswith("dead zone") else 0.0
    fine = replace(found.problem, rows=1, temperature=moved)
    end = valve.size if valve.name == "saturation" else np.inf
    passed = VALVES.get(valve.name, SOUND).passed(command, valve.size)
    model = Model(
        log, found, possible,
        estimates={
            "delay": Interval(delay.value, max(delay.low - 0.5, 0.0), delay.high + 0.5),
            "dead_zone": Interval(size, min(float(low), size), max(float(high), size)),
            "gain": _interval(plant.gain, [each.gain for each in possible]),
            "time_constant": _interval(plant.slowest, [each.slowest for each in possible]),
        },
        operating_flow=rest,
        operating_temperature=float(base + found.solution.c[-1] - plant.gain * passed[0]),
        u_min=max(float(command.min()), -end) if told.u_min is None else told.u_min,
        u_max=min(float(command.max()), end) if told.u_max is None else told.u_max,
        simulated=base + fine.columns(found.shape, found.p)[0] @ found.solution.c,
        explained=held_out(found),
    )  # fmt: skip
    model.notes.extend([*log.notes, *_notes(model)])
    model.warnings.extend(_warnings(model, applied=told.applied))
    return model


def _operating_flow(flow: Array, given: float | None) -> float:
    """Return the flow from which a dead zone is counted."""
    low, high = float(flow.min()), float(flow.max())
    if given is None:
        quarter = (high - low) / 4.0
        inside = [
            each for each in (0.0, float(flow[0])) if low + quarter <= each <= high - quarter
        ]
        return inside[0] if inside else (low + high) / 2.0
    if not 2.0 * low - high <= given <= 2.0 * high - low:
        raise ValueError(
            f"operating_flow must be near the flows of the log, {low:g} to {high:g}, "
            f"got {given:g}"
        )
    return given


def _interval(value: float, values: list[float]) -> Interval:
    low, high = np.quantile(values, (0.025, 0.975))
    return Interval(value, min(float(low), value), max(float(high), value))


def _check(log: Log) -> None:
    """Raise a ValueError if no plant can be seen in a log."""
    for name, values in (("flow", log.flow), ("temperature", log.temperature)):
        if not np.nanmax(values) - np.nanmin(values) > 1e-9 * np.nanmax(np.abs(values)):
            raise ValueError(f"the {name} is constant: the log does not show a response")
    if follows(log.flow, log.temperature):
        raise ValueError(
            "the flow follows the temperature, and nothing else moves it: in a closed loop "
            "with a constant set point, the log shows the controller. Move the set point, or "
            "the flow by hand"
        )


def follows(flow: Array, temperature: Array) -> bool:
    """Return whether the flow's moves are a linear controller's, but for few.

    The least absolute errors of a regression on the last temperatures leave the moves that do
    not follow from these as outliers.
    """
    ones = np.ones(len(flow) - 2)
    lagged = [temperature[2:], temperature[1:-1], temperature[:-2], flow[1:-1], ones]
    table = np.column_stack([*lagged, np.diff(flow)[1:]])
    table = table[np.isfinite(table).all(axis=1)]
    x, moves, weight = table[:, :-1], table[:, -1], np.ones(len(table))
    for _ in range(20):
        c = np.linalg.lstsq(x * weight[:, np.newaxis], moves * weight, rcond=None)[0]
        left = np.abs(moves - x @ c)
        weight = 1.0 / np.sqrt(left + 1e-4 * np.ptp(flow))
    typical = float(np.median(left))
    own = left > max(8.0 * typical, 0.02 * float(np.ptp(flow)))
    return typical < 0.5 * float(np.median(np.abs(moves))) and int(own.sum()) < 4


def held_out(found: Found) -> tuple[float, float]:
    """Return what a fit to the first two thirds explains of the last: variance, and changes.

    A straight line is taken from the errors, for what is slow. Changes are those over one
    response, among which slow disturbances do not count.
    """
    problem, y = found.problem, found.problem.temperature
    cut = 2 * len(y) // 3
    first = replace(problem, temperature=np.where(np.arange(len(y)) < cut, y, np.nan))
    _, p = first.refined(found.shape, found.p)
    solved = first.solve(found.shape, p)
    y, error = y[cut:], (y - solved.table @ solved.c)[cut:]
    known = np.flatnonzero(np.isfinite(y))
    line = np.polyval(np.polyfit(known, error[known], 1), np.arange(len(y)))
    later = int((found.plant.delay + np.abs(found.plant.lags).sum()) / problem.h / problem.rows)
    later = min(later + 1, len(y) // 3)
    changes = np.nanvar(error[later:] - error[:-later]) / np.nanvar(y[later:] - y[:-later])
    return float(1.0 - np.nanvar(error - line) / np.nanvar(y - line)), float(1.0 - changes)


def _notes(model: Model) -> list[str]:
    """Return what a user should know of the fit."""
    found, unit = model.found, model.log.flow_unit
    problem, size = found.problem, f"{found.valve.size:.3g} {unit}"
    times = ", ".join(f"{at / 60.0:.0f}" for at in sorted(problem.loads))
    speed = f"{found.valve.size / problem.h:.3g} {unit}"
    remarks = [
        (problem.rows > 1,
         f"The log is sampled {problem.rows} times as often as the plant needs: means of "
         f"{problem.rows} rows are fitted."),
        (bool(times), f"Loads seem to have moved the temperature at {times} min."),
        (found.valve.name == "rate limit",
         f"The valve seems to move by {speed} a second at most, which plant.json cannot hold."),
        (found.valve.name == "saturation",
         f"The valve seems to end at ±{size} from the operating point."),
        (found.valve.name == "subtractive dead zone",
         "Beyond the dead zone the flow seems to rise from 0, which plant.json cannot hold."),
    ]  # fmt: skip
    inputs = len(problem.units(found.shape, found.p))
    gains = (
        found.solution.c[inputs : inputs + 3 * len(problem.known)].reshape(-1, 3).sum(axis=1)
    )
    disturbances = [
        f"{name} is a known disturbance with a gain of {gain:.4g} "
        f"{model.log.temperature_unit} a unit, which plant.json cannot hold."
        for name, gain in zip(model.log.disturbances, gains, strict=True)
    ]
    return [sentence for holds, sentence in remarks if holds] + disturbances


def _warnings(model: Model, *, applied: bool) -> list[str]:
    """Return why no controller should be tuned on a model, a sentence each."""
    found, flow, gain = model.found, model.log.flow, model.estimates["gain"]
    errors = found.solution.errors
    alike = np.correlate(errors, errors, "full")[len(errors) :][:LAGS] / (errors @ errors)
    large = float(np.mean(np.abs(alike) > max(0.1, 2.5 / np.sqrt(len(errors)))))
    commands = len(np.unique(np.round(flow / (0.02 * np.ptp(flow)))))
    doubts = [
        (found.fault is not None, fault_sentence(found, model.log.flow_unit)),
        (commands < COMMANDS and not applied,
         f"The log does not test the valve, as the flow had {commands} values only, and "
         "nothing is known of its dead zone. Record a log with a dozen flows, or the flow "
         "behind the valve (--applied)."),
        (_rivals(found) > RIVAL,
         "Valves of two kinds explain the log alike, and the plants behind them differ. "
         + TEST),
        (gain.low * gain.high <= 0.0,
         "Not even the direction is known in which the temperature answers the flow. Move the "
         "flow to and fro a dozen times, further than here, and hold it until the temperature "
         "has settled."),
        (model.estimates["delay"].high >= len(flow) / 6.0,
         "The delay may be longer than a sixth of the log, which is not looked for: record a "
         "longer one."),
        (max(model.explained) < 0.5,
         "The model leaves more than half open: the noise hides the response, or it changes. "
         "Move the flow further, and look for other inputs (--disturbance)."),
        (large > 0.25,
         f"The prediction errors are far from white ({100 * large:.0f} % of their "
         "autocorrelations are large): the plant or its disturbances are not of the model's "
         "form."),
    ]  # fmt: skip
    return [sentence for holds, sentence in doubts if holds]


def _rivals(found: Found) -> float:
    """Return the ratio of the gains behind valves that explain the log alike."""
    alike = [
        abs(each.gain) for each in found.rivals
        if each.harmless and each.drop > max(found.valve.drop - FAVOUR, FAULT)
    ]  # fmt: skip
    return max(alike) / min(alike) if alike else 1.0


def fault_sentence(found: Found, unit: str) -> str:
    """Return what seems to be wrong with the valve or the plant, and the test that tells."""
    fault = found.fault
    if fault is None:
        return ""
    if fault not in found.rivals:
        return (
            f"The plant seems to change: {fault.name}. Identify each level, time or direction "
            "from a log of its own."
        )
    others = [each.drop for each in found.rivals if each.name != fault.name]
    like = "" if max(others) < fault.drop - FAULT else ", or another fault of its kind"
    return (
        f"The valve does not seem to pass what it is told: {fault.name} of {fault.size:.2g} "
        f"{unit}{like}. {TEST} If the temperature follows alike, the plant is not of the "
        "model's form."
    )
