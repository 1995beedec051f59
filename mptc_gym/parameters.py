"""Declare every argument of the environment once, in a dataclass that checks itself."""

# ruff: noqa: RUF009 (`_linear` makes fields)

from __future__ import annotations

import difflib
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property, partial
from types import MappingProxyType
from typing import Any, Final, Generic, TypeVar

import numpy as np

from mptc_gym import checks
from mptc_gym.checks import Number, reject

DRAWS: Final = 32  # per episode: enough for every plant number, and for future ones

Value = TypeVar("Value")  # of a plant number: float, an array for many plants, or `Number`


@dataclass(frozen=True)
class Argument:
    """Declaration of an argument of the environment, apart from its name and type."""

    default: Any
    check: checks.Check  # returns a valid value in plain Python types, or raises a ValueError
    unit: str
    meaning: str
    # Whether the plant is (28) and (29), linear between the limits, for any value. An analysis
    # that assumes this refuses any other argument that is not at its default.
    linear: bool

    def checked(self, name: str, value: Any) -> Any:
        """Return a value in plain Python types; ValueError, naming it, if it is invalid."""
        check = checks.or_range(self.check) if name in PLANT_NUMBERS else self.check
        return check(name, checks.plain(value))

    @property
    def is_integer(self) -> bool:
        """Whether an integer is drawn from a range, both ends included."""
        return isinstance(self.default, int)

    def row(self, name: str) -> str:
        """Return its row in a Markdown table of arguments."""
        default = repr(self.default).replace("'", '"')
        star = "*" if name in PLANT_NUMBERS else ""
        return f"| `{name}` | {default}{star} | {self.unit} | {self.meaning} |"


def _argument(
    default: Any, check: checks.Check, unit: str, meaning: str, *, linear: bool = False
) -> Any:
    """Declare an argument: a dataclass field that carries an `Argument`."""
    argument = Argument(default, check, unit, meaning, linear)
    return field(default=default, metadata={"argument": argument})


_linear = partial(_argument, linear=True)  # whatever its value, the plant is (28) and (29)


@dataclass(frozen=True, kw_only=True)
class PlantNumbers(Generic[Value]):
    """The numbers of a plant that can differ from episode to episode.

    As an argument, each is a `Number`: a number, or a range to draw from. During an episode,
    each is a float for one plant, and an array for many. Field i takes draw i of a reset. The
    order never changes, so that seeds keep their meaning, and new fields come last.
    """

    delay: Value = _linear(18, checks.samples, "samples", "transport delay d of (28)")
    dead_zone: Value = _linear(
        5.0, checks.not_negative, "t/h", "half width of the actuator's dead zone (29)"
    )
    u_min: Value = _linear(
        -10.0, checks.number, "t/h", "lower limit of the actuator, U_min in (29)"
    )
    u_max: Value = _linear(
        10.0, checks.number, "t/h", "upper limit of the actuator, U_max in (29)"
    )
    noise_variance: Value = _linear(
        0.0, checks.not_negative, "degC^2", "R, the variance of xi in (28)"
    )
    measurement_noise_variance: Value = _linear(
        0.0, checks.not_negative, "degC^2", "variance of the transmitter's white noise"
    )
    disturbance_amplitude: Value = _linear(
        0.0, checks.not_negative, "degC", "largest level of the load disturbance's steps"
    )
    disturbance_interval: Value = _linear(
        150.0, checks.at_least_1, "samples", "mean interval of these steps; below 10 it is 10"
    )
    disturbance_walk_variance: Value = _linear(
        0.0, checks.not_negative, "degC^2", "variance that the load's walk gains a sample"
    )
    gain_factor: Value = _linear(
        1.0, checks.positive, "1", "steady-state gain, as a multiple of that of `a` and `b`"
    )
    time_constant_factor: Value = _linear(
        1.0, checks.positive, "1", "dominant time constant, as a multiple of that of `a`"
    )
    gain_drift: Value = _linear(
        1.0, checks.positive, "1", "factor by which the gain changes in `drift_samples`"
    )
    time_constant_drift: Value = _linear(
        1.0, checks.positive, "1", "the same for the time constant"
    )

    def chosen(self, names: Sequence[str]) -> dict[str, Value]:
        """Return some of the numbers by name."""
        return {name: getattr(self, name) for name in names}


def slowest_pole(a: Sequence[float]) -> complex | None:
    """Return the pole of 1 / A with the largest magnitude, or None if there is no pole."""
    poles = np.roots(a)
    return complex(poles[np.argmax(np.abs(poles))]) if len(poles) else None


@dataclass(frozen=True, kw_only=True)
class Parameters(PlantNumbers[Number]):
    """The arguments of `MiddlePoint-v0`, checked and converted to plain Python types.

    The defaults are the first case of the paper (Section 5, Fig. 5). All quantities are
    deviations from the operating point. The fields of `PlantNumbers` can be ranges.

    Raises
    ------
    ValueError
        If an argument is out of range; the message names the argument, the value and what is
        allowed.
    """

    # The plant, (28): A(z^-1) y(k) = B(z^-1) u_a(k - d) + C(z^-1) xi(k).
    a: Sequence[float] = _linear(
        (1.0, -0.45181, -0.47546),
        checks.polynomial,
        "1",
        "coefficients of A in (28), from z^0 on; the first is 1. If A is unstable, y may grow "
        "beyond all floats",
    )
    b: Sequence[float] = _linear(
        (-0.04560, -0.00404),
        checks.numbers,
        "degC per t/h",
        "coefficients of B in (28), from z^-1 on",
    )
    c: Sequence[float] = _linear(
        (1.0, -0.35740, -0.03392),
        checks.polynomial,
        "1",
        "coefficients of C in (28), from z^0 on; the first is 1",
    )
    drift_samples: int = _linear(
        1200, checks.duration, "samples", "how long gain and time constant drift"
    )
    sampling_interval: float = _linear(  # Section 5
        8.0, checks.positive, "s", "scale of the time axis, without effect on the dynamics"
    )
    # The paper plots the set point without stating it.
    setpoint: str | float | Sequence[float] = _linear(
        "square",
        checks.setpoint,
        "degC",
        '"square", "random", a number (constant), or a list with a number for each sample, '
        "the last one held: [-5, 5] is two samples, not a range",
    )
    setpoint_amplitude: float = _linear(
        5.0,
        checks.not_negative,
        "degC",
        'A. "square": first A, then -A. "random": levels uniform in [-A, A]',
    )
    setpoint_period: int = _linear(
        600,
        checks.duration,
        "samples",
        'period of "square". "random": each level is held for a length uniform in '
        "[period/6, period/2]",
    )
    # The observation. By default it is the six inputs of the paper's network: y_d(k), y_d(k-1),
    # y_d(k-2), e(k), e(k-1), e(k-2).
    setpoint_window: int = _linear(
        3, checks.samples, "samples", "how many of the latest set points the observation holds"
    )
    error_window: int = _linear(3, checks.samples, "samples", "the same for errors")
    output_window: int = _linear(0, checks.samples, "samples", "the same for measured outputs")
    action_window: int = _linear(0, checks.samples, "samples", "the same for past actions")
    temperature_span: float = _linear(
        50.0, checks.positive, "degC", "the transmitter's readings saturate at + and - this"
    )
    reward: str = _linear("quadratic", checks.reward, "", '"quadratic" or "absolute"')
    error_scale: float = _linear(
        5.0,
        checks.positive,
        "degC",
        'the error that costs 1/2 ("quadratic") or 1 ("absolute") in each sample',
    )
    move_weight: float = _linear(
        0.0, checks.not_negative, "1", "cost of a change of the normalised action by 1"
    )

    def __post_init__(self) -> None:
        for name, argument in ARGUMENTS.items():
            object.__setattr__(self, name, argument.checked(name, getattr(self, name)))
        self._check_actuator()
        self._check_dynamics()
        if self.observation_size == 0:
            reject(
                "setpoint_window, error_window, output_window, action_window",
                (0, 0, 0, 0),
                "such that the observation has at least one element",
            )

    @classmethod
    def of_environment(cls, arguments: Mapping[str, Any]) -> Parameters:
        """Return the parameters for the keyword arguments of an environment.

        Raises
        ------
        TypeError
            If an argument is unknown; the message suggests the one that was probably meant.
        ValueError
            If an argument is out of range.
        """
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
            reject(
                "dead_zone",
                self.dead_zone,
                "small enough to leave some command effective, at most max(|u_min|, |u_max|) = "
                f"{reach:g}",
            )

    def _check_dynamics(self) -> None:
        """Refuse changes of the dynamics that are undefined for A."""
        if self.changes_time_constant:
            names = "time_constant_factor, time_constant_drift"
            refuse = partial(
                reject, names, (self.time_constant_factor, self.time_constant_drift)
            )
            pole = slowest_pole(self.a)
            if pole is None:
                refuse("1 for this a, which has no pole")
            if pole.imag != 0.0:
                refuse("1 for this a, whose slowest poles are complex")
            if not 0.0 < pole.real < 1.0:
                refuse(
                    f"1 for this a, whose slowest pole, {pole.real:g}, is not between 0 and 1"
                )
            rate = 1.0 - pole.real
            drift = self.range_of("time_constant_drift")[0]
            if self.range_of("time_constant_factor")[0] * min(drift, 1.0) < rate:
                refuse(
                    f"such that the factor is never below {rate:g}, where the slowest pole "
                    "comes to 0"
                )
        if self.is_disturbed and not self.is_stable:
            reject(
                "disturbance_amplitude, disturbance_walk_variance",
                (self.disturbance_amplitude, self.disturbance_walk_variance),
                "0 for this a, which is not stable and has no steady state",
            )

    def range_of(self, name: str) -> tuple[float, float]:
        """Return the lowest and the highest value that a plant number can take."""
        value = getattr(self, name)
        return value if isinstance(value, tuple) else (value, value)

    @property
    def ranges(self) -> tuple[str, ...]:
        """Names of the plant numbers that are drawn at each reset."""
        return tuple(name for name in PLANT_NUMBERS if isinstance(getattr(self, name), tuple))

    @cached_property
    def is_stable(self) -> bool:
        """Whether all poles of 1 / A lie within the unit circle."""
        return bool(np.all(np.abs(np.roots(self.a)) < 1.0))

    @property
    def is_disturbed(self) -> bool:
        """Whether there is a load disturbance."""
        names = "disturbance_amplitude", "disturbance_walk_variance"
        return any(self.range_of(name)[1] > 0.0 for name in names)

    def _may_change(self, *names: str) -> bool:
        return any(self.range_of(name) != (1.0, 1.0) for name in names)

    @property
    def drifts(self) -> bool:
        """Whether the dynamics change within an episode."""
        return self._may_change("gain_drift", "time_constant_drift")

    @property
    def changes_time_constant(self) -> bool:
        """Whether the time constant differs, or may come to differ, from that of A."""
        return self._may_change("time_constant_factor", "time_constant_drift")

    @property
    def changes_dynamics(self) -> bool:
        """Whether the coefficients of (28) differ, or may come to differ, from A and B."""
        return self.changes_time_constant or self._may_change("gain_factor", "gain_drift")

    @property
    def windows(self) -> tuple[int, int, int, int]:
        """Sizes of the observation's blocks: set points, errors, outputs, actions."""
        return self.setpoint_window, self.error_window, self.output_window, self.action_window

    @property
    def observation_size(self) -> int:
        """Number of elements of the observation."""
        return sum(self.windows)

    @property
    def heads(self) -> tuple[int, int, int]:
        """Indices where errors, outputs and actions begin in the observation."""
        setpoints, errors, outputs, _ = self.windows
        return setpoints, setpoints + errors, setpoints + errors + outputs

    @property
    def largest_setpoint(self) -> float:
        """Largest magnitude that the set point can take, degC."""
        if isinstance(self.setpoint, str):
            return self.setpoint_amplitude
        levels = self.setpoint if isinstance(self.setpoint, tuple) else (self.setpoint,)
        return max(abs(float(level)) for level in levels)


ARGUMENTS: Final[Mapping[str, Argument]] = MappingProxyType(
    {each.name: each.metadata["argument"] for each in fields(Parameters)}
)
"""The declaration of each argument, by name."""

PLANT_NUMBERS: Final[Mapping[str, int]] = MappingProxyType(
    {each.name: place for place, each in enumerate(fields(PlantNumbers))}
)
"""The arguments that can be ranges, by name, and the index of the draw that each takes."""


def argument_table() -> str:
    """Return a Markdown table of all arguments except `render_mode`."""
    rows = (argument.row(name) for name, argument in ARGUMENTS.items())
    return "\n".join(["| Argument | Default | Unit | Meaning |", "|---|---|---|---|", *rows])


def insert_table(docstring: str | None) -> str | None:
    """Insert the table of arguments at its placeholder in a docstring."""
    if docstring is None:  # under `python -OO`
        return None
    before = docstring.partition("<arguments>")[0]
    indentation = before[before.rfind("\n") + 1 :]  # none from Python 3.13 on
    return docstring.replace("<arguments>", argument_table().replace("\n", f"\n{indentation}"))


def spelt_out(function: Callable[..., Any]) -> inspect.Signature:
    """Return a method's signature for help(), with each argument in place of **arguments."""
    own = [*inspect.signature(function).parameters.values()]
    arguments = [
        each.replace(annotation="float | Sequence[float]")
        if each.name in PLANT_NUMBERS
        else each
        for each in inspect.signature(Parameters).parameters.values()
    ]
    return inspect.Signature([*own[1:-1], *arguments])
