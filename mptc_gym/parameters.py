"""Declare every argument of the environment once, in a dataclass that checks itself."""

# ruff: noqa: RUF009 (`_arg` makes fields)

from __future__ import annotations

import difflib
import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any, Final, Generic, NamedTuple, TypeVar

import numpy as np

from mptc_gym import checks
from mptc_gym.checks import Number, reject

Value = TypeVar("Value")  # of a plant number: float, an array for many plants, or `Number`
_LOAD: Final = ("disturbance_amplitude", "disturbance_walk_variance")


class Argument(NamedTuple):
    """Declaration of an argument of the environment, apart from its name and type."""

    default: Any
    check: checks.Check  # returns a valid value in plain Python types, or raises a ValueError
    unit: str
    meaning: str


def _arg(default: Any, check: checks.Check, unit: str, meaning: str) -> Any:
    """Declare an argument: a dataclass field that carries an `Argument`."""
    return field(
        default=default, metadata={"argument": Argument(default, check, unit, meaning)}
    )


@dataclass(frozen=True, kw_only=True)
class PlantNumbers(Generic[Value]):
    """The numbers of a plant that can differ from episode to episode.

    As an argument, each is a `Number`: a number, or a range to draw from. During an episode,
    each is a float for one plant, and an array for many. Field i takes draw i of a reset. The
    order never changes, so that seeds keep their meaning, and new fields come last.
    """

    delay: Value = _arg(18, checks.samples, "samples", "transport delay d of (28)")
    dead_zone: Value = _arg(5.0, checks.not_negative, "t/h", "half width of the dead zone (29)")
    u_min: Value = _arg(-10.0, checks.number, "t/h", "U_min, the lower limit in (29)")
    u_max: Value = _arg(10.0, checks.number, "t/h", "U_max, the upper limit in (29)")
    noise_variance: Value = _arg(0.0, checks.not_negative, "degC^2", "variance R of xi in (28)")
    measurement_noise_variance: Value = _arg(
        0.0, checks.not_negative, "degC^2", "variance of the transmitter's white noise"
    )
    disturbance_amplitude: Value = _arg(
        0.0, checks.not_negative, "degC", "largest level of the load's steps"
    )
    disturbance_interval: Value = _arg(
        150.0, checks.at_least_1, "samples", "mean interval of its steps; below 10 it is 10"
    )
    disturbance_walk_variance: Value = _arg(
        0.0, checks.not_negative, "degC^2", "variance that the load's walk gains a sample"
    )
    gain_factor: Value = _arg(1.0, checks.positive, "1", "multiple of the steady-state gain")
    time_constant_factor: Value = _arg(1.0, checks.positive, "1", "that of the time constant")
    gain_drift: Value = _arg(
        1.0, checks.positive, "1", "factor by which the gain changes in `drift_samples`"
    )
    time_constant_drift: Value = _arg(1.0, checks.positive, "1", "that of the time constant")

    def chosen(self, names: Iterable[str]) -> dict[str, Value]:
        """Return some of the numbers by name."""
        return {name: getattr(self, name) for name in names}


def slowest_pole(a: Sequence[float]) -> complex:
    """Return the pole of 1 / A with the largest magnitude, or 0 if there is no pole."""
    poles = np.roots([*a, 0.0])
    return complex(poles[np.argmax(np.abs(poles))])


@dataclass(frozen=True, kw_only=True)
class Parameters(PlantNumbers[Number]):
    """The arguments of `MiddlePoint-v0`, checked and converted to plain Python types.

    The defaults are the first case of the paper (Section 5, Fig. 5). All quantities are
    deviations from the operating point. An asterisk marks an argument that can also be a range
    [low, high], from which each `reset` draws a number.

    <arguments>

    The ValueError for an argument out of range names it, its value and what is allowed.
    """

    # The plant, (28): A(z^-1) y(k) = B(z^-1) u_a(k - d) + C(z^-1) xi(k). With an unstable A, y
    # may grow beyond all floats.
    a: Sequence[float] = _arg(
        (1.0, -0.45181, -0.47546), checks.polynomial, "1", "A in (28), from z^0; begins with 1"
    )
    b: Sequence[float] = _arg(
        (-0.04560, -0.00404), checks.numbers, "degC per t/h", "B in (28), from z^-1 on"
    )
    c: Sequence[float] = _arg(
        (1.0, -0.35740, -0.03392), checks.polynomial, "1", "C in (28), from z^0; begins with 1"
    )
    drift_samples: int = _arg(1200, checks.duration, "samples", "duration of the drifts")
    sampling_interval: float = _arg(8.0, checks.positive, "s", "scale of the time axis only")
    # The paper plots the set point without stating it.
    setpoint: str | float | Sequence[float] = _arg(
        "square",
        checks.setpoint,
        "degC",
        '"square", "random", a number (constant), or a list with a number for each sample, '
        "the last one held: [-5, 5] is two samples, not a range",
    )
    setpoint_amplitude: float = _arg(
        5.0, checks.not_negative, "degC", '"square": A, then -A. "random": uniform in [-A, A]'
    )
    setpoint_period: int = _arg(
        600,
        checks.duration,
        "samples",
        'of "square". "random": levels last for a length uniform in [period/6, period/2]',
    )
    # The observation. By default it is the six inputs of the paper's network: y_d(k), y_d(k-1),
    # y_d(k-2), e(k), e(k-1), e(k-2).
    setpoint_window: int = _arg(3, checks.samples, "samples", "latest set points observed")
    error_window: int = _arg(3, checks.samples, "samples", "the same of errors")
    output_window: int = _arg(0, checks.samples, "samples", "the same of measured outputs")
    action_window: int = _arg(0, checks.samples, "samples", "the same of past actions")
    temperature_span: float = _arg(50.0, checks.positive, "degC", "readings saturate at +-this")
    reward: str = _arg("quadratic", checks.reward, "", '"quadratic" or "absolute"')
    error_scale: float = _arg(
        5.0, checks.positive, "degC", 'error that costs 1/2 ("quadratic") or 1 ("absolute")'
    )
    move_weight: float = _arg(0.0, checks.not_negative, "1", "cost of moving the action by 1")

    def __post_init__(self) -> None:
        for name, argument in ARGUMENTS.items():
            check = argument.check
            if name in PLANT_NUMBERS:
                check = partial(checks.or_range, check)
            object.__setattr__(self, name, check(name, checks.plain(getattr(self, name))))
        self._check_actuator()
        if self.changes_time_constant:
            self._check_time_constant()
        if self.is_disturbed and not abs(slowest_pole(self.a)) < 1.0:
            allowed = "0 for this a, which is not stable and has no steady state"
            reject(", ".join(_LOAD), tuple(self.chosen(_LOAD).values()), allowed)
        if not any(self.windows):
            names = "setpoint_window, error_window, output_window, action_window"
            reject(names, self.windows, "such that the observation has at least one element")

    @classmethod
    def of_environment(cls, arguments: Mapping[str, Any]) -> Parameters:
        """Return those of an environment; TypeError, with a suggestion, if one is unknown."""
        for name in arguments:
            if name == "render_mode":
                raise TypeError("render_mode is not an argument of the plant")
            if name not in ARGUMENTS:
                close = difflib.get_close_matches(name, [*ARGUMENTS, "render_mode"], n=1)
                hint = f": did you mean {close[0]!r}?" if close else ""
                # In Python's own words, by which callers detect an unsupported argument.
                raise TypeError(
                    f"MiddlePoint-v0 got an unexpected keyword argument {name!r}{hint}"
                )
        return cls(**arguments)

    def _check_actuator(self) -> None:
        """Refuse limits and a dead zone unless they fit together for every draw."""
        (lowest, low), (high, highest) = self.range_of("u_min"), self.range_of("u_max")
        if low >= high:
            reject("u_min", self.u_min, f"below u_max = {self.u_max}")
        # The least of max(|u_min|, |u_max|) over all draws.
        reach = max(lowest, -low, high, -highest, 0.0)
        if self.range_of("dead_zone")[1] > reach:
            allowed = "small enough for some command to pass, at most max(|u_min|, |u_max|)"
            reject("dead_zone", self.dead_zone, f"{allowed} = {reach:g}")

    def _check_time_constant(self) -> None:
        """Refuse changes of the time constant that are undefined for A."""
        names = "time_constant_factor", "time_constant_drift"
        pole, (factor, drift) = slowest_pole(self.a), (self.range_of(name)[0] for name in names)
        rate = 1.0 - pole.real
        if pole.imag != 0.0 or not 0.0 < pole.real < 1.0:
            allowed = f"1 for this a, whose slowest pole is {pole:g}, not one between 0 and 1"
        elif factor * min(drift, 1.0) < rate:
            allowed = f"such that the factor is never below {rate:g}, where that pole is 0"
        else:
            return
        reject(", ".join(names), tuple(self.chosen(names).values()), allowed)

    def range_of(self, name: str) -> tuple[float, float]:
        """Return the lowest and the highest value that a plant number can take."""
        value = getattr(self, name)
        return value if isinstance(value, tuple) else (value, value)

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """Lowest and highest value of the plant numbers that are drawn at each reset."""
        numbers = self.chosen(PLANT_NUMBERS)
        return {name: value for name, value in numbers.items() if isinstance(value, tuple)}

    @property
    def is_disturbed(self) -> bool:
        """Whether there is a load disturbance."""
        return self._can_differ(0.0, *_LOAD)

    def _can_differ(self, value: float, *names: str) -> bool:
        return any(self.range_of(name) != (value, value) for name in names)

    @property
    def drifts(self) -> bool:
        """Whether the dynamics change within an episode."""
        return self._can_differ(1.0, "gain_drift", "time_constant_drift")

    @property
    def changes_time_constant(self) -> bool:
        """Whether the time constant differs, or may come to differ, from that of A."""
        return self._can_differ(1.0, "time_constant_factor", "time_constant_drift")

    @property
    def changes_dynamics(self) -> bool:
        """Whether the coefficients of (28) differ, or may come to differ, from A and B."""
        return self.drifts or self._can_differ(1.0, "gain_factor", "time_constant_factor")

    @property
    def windows(self) -> tuple[int, int, int, int]:
        """Sizes of the observation's blocks: set points, errors, outputs, actions."""
        return self.setpoint_window, self.error_window, self.output_window, self.action_window


ARGUMENTS: Final = {each.name: each.metadata["argument"] for each in fields(Parameters)}
"""The declaration of each argument, by name."""

PLANT_NUMBERS: Final = {each.name: i for i, each in enumerate(fields(PlantNumbers))}
"""The arguments that can be ranges, by name, and the index of the draw that each takes."""


def argument_table() -> str:
    """Return a Markdown table of all arguments except `render_mode`."""
    rows = ["| Argument | Default | Unit | Meaning |", "|---|---|---|---|"]
    for name, each in ARGUMENTS.items():
        default = repr(each.default).replace("'", '"') + "*" * (name in PLANT_NUMBERS)
        rows.append(f"| `{name}` | {default} | {each.unit} | {each.meaning} |")
    return "\n".join(rows)


def insert_table(docstring: str | None) -> str | None:
    """Insert the table of arguments in a docstring, which is None under `python -OO`."""
    return docstring and inspect.cleandoc(docstring).replace("<arguments>", argument_table())


Parameters.__doc__ = insert_table(Parameters.__doc__)


def spelt_out(function: Callable[..., Any]) -> inspect.Signature:
    """Return a method's signature for help(), with each argument in place of **arguments."""
    spelt = [*inspect.signature(function).parameters.values()][1:-1]
    for each in inspect.signature(Parameters).parameters.values():
        number = "float | Sequence[float]" if each.name in PLANT_NUMBERS else each.annotation
        spelt.append(each.replace(annotation=number))
    return inspect.Signature(spelt)
