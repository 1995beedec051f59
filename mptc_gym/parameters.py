"""Every argument of the environment, in one frozen dataclass that checks itself."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any, Final, NoReturn

import numpy as np

SETPOINTS: Final = ("square", "random")
REWARDS: Final = ("quadratic", "absolute")
LARGEST: Any = 10**9  # of any argument; beyond, float32 observations and squares lose meaning

# The arguments that can be a range, in the order of their draws: a new one comes last.
PLANT_NUMBERS: Final = (
    "delay",
    "dead_zone",
    "u_min",
    "u_max",
    "noise_variance",
    "measurement_noise_variance",
    "disturbance_amplitude",
    "disturbance_interval",
    "disturbance_walk_variance",
    "gain_factor",
    "time_constant_factor",
    "gain_drift",
    "time_constant_drift",
)
SLOW: Final = 10  # samples between two changes of the load disturbance and of the dynamics
Number = float | Sequence[float]  # or a range, [low, high]


def _reject(name: str, value: object, allowed: str) -> NoReturn:
    raise ValueError(f"{name} must be {allowed}, got {value!r}")


def _is_number(value: Any) -> bool:
    if not isinstance(value, Real) or isinstance(value, bool):
        return False
    return bool(-LARGEST <= value <= LARGEST)


def _number(name: str, value: Any, allowed: str = "a number within +-1e9") -> float:
    if not _is_number(value):
        _reject(name, value, allowed)
    return float(value) + 0.0  # never -0


def _not_negative(name: str, value: Any) -> float:
    allowed = "a number from 0 to 1e9"
    if _number(name, value, allowed) < 0:
        _reject(name, value, allowed)
    return float(value)


def _positive(name: str, value: Any) -> float:
    allowed = "a number above 0, up to 1e9"
    if _number(name, value, allowed) <= 0:
        _reject(name, value, allowed)
    return float(value)


def is_count(value: Any, minimum: int = 0) -> bool:
    """Whether a value is an integer of at least `minimum`."""
    return isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= minimum


def _count(name: str, value: Any, minimum: int = 0) -> int:
    if not is_count(value, minimum):
        _reject(name, value, f"an integer of at least {minimum}")
    return int(value)


def positive_count(name: str, value: Any) -> int:
    """Return a value if it is an integer of at least 1; ValueError, naming it, otherwise."""
    return _count(name, value, minimum=1)


def _at_least_1(name: str, value: Any) -> float:
    allowed = "a number from 1 to 1e9"
    if _number(name, value, allowed) < 1:
        _reject(name, value, allowed)
    return float(value)


def _or_range(check: Callable[[str, Any], float]) -> Callable[[str, Any], Number]:
    """Return a check that takes a range [low, high] as well, of what `check` takes."""

    def checked(name: str, value: Any) -> Number:
        if not isinstance(value, list | tuple):
            return check(name, value)
        if len(value) != 2:
            _reject(name, value, "one number, or a range [low, high]")
        low, high = check(name, value[0]), check(name, value[1])
        if low > high:
            _reject(name, value, "one number, or a range [low, high] with low <= high")
        return low, high

    return checked


def _numbers(
    name: str, value: Any, allowed: str = "a list of one or more numbers within +-1e9"
) -> tuple[float, ...]:
    if not isinstance(value, list | tuple) or not value or not all(map(_is_number, value)):
        _reject(name, value, allowed)
    return tuple(float(element) for element in value)


def _polynomial(name: str, value: Any) -> tuple[float, ...]:
    allowed = "a list of numbers within +-1e9, the first of them 1"
    coefficients = _numbers(name, value, allowed)
    if coefficients[0] != 1.0:
        _reject(name, value, allowed)
    return coefficients


def _setpoint(name: str, value: Any) -> str | float | tuple[float, ...]:
    if isinstance(value, str) and value in SETPOINTS:
        return value
    allowed = "'square', 'random', or a number or a list of one or more within +-1e9"
    if isinstance(value, list | tuple):
        return _numbers(name, value, allowed)
    return _number(name, value, allowed)


def _reward(name: str, value: Any) -> str:
    if not isinstance(value, str) or value not in REWARDS:
        _reject(name, value, "'quadratic' or 'absolute'")
    return value


def slowest_pole(a: Sequence[float]) -> float:
    """Return the largest pole of 1 / A, NaN if it is none or not real."""
    poles = np.roots(a)
    slowest = poles[np.argmax(np.abs(poles))] if len(poles) else np.nan
    return float(slowest.real) if np.isreal(slowest) else math.nan


def _least_magnitude(low: float, high: float) -> float:
    return max(low, -high, 0.0)


def _shown(number: Number) -> str:
    return f"{number:g}" if isinstance(number, float | int) else f"{list(number)}"


@dataclass(frozen=True, kw_only=True)
class Parameters:
    """The arguments of `MiddlePoint-v0`, checked and brought to plain Python types.

    The defaults are the first case of the paper (Section 5, Fig. 5). All quantities are
    deviations from the operating point. Those named in `PLANT_NUMBERS` can be a range.

    Raises
    ------
    ValueError
        If an argument is out of range; the message names the argument, the value and what is
        allowed.
    """

    # The plant, (28): A(z^-1) y(k) = B(z^-1) u_a(k - d) + C(z^-1) xi(k).
    a: Sequence[float] = (1.0, -0.45181, -0.47546)  # A, from z^0 on; the first is 1
    b: Sequence[float] = (-0.04560, -0.00404)  # B, from z^-1 on; degC per t/h
    c: Sequence[float] = (1.0, -0.35740, -0.03392)  # C, from z^0 on; the first is 1
    delay: Number = 18  # d, samples
    # The actuator, (29).
    dead_zone: Number = 5.0  # t/h
    u_min: Number = -10.0  # U_min, t/h
    u_max: Number = 10.0  # U_max, t/h
    noise_variance: Number = 0.0  # R, the variance of xi, degC^2
    # What the paper names in Section 1, beside delay and actuator, and leaves out of (28).
    measurement_noise_variance: Number = 0.0  # white, degC^2
    disturbance_amplitude: Number = 0.0  # of its steps, degC
    disturbance_interval: Number = 150.0  # between steps, on average, samples
    disturbance_walk_variance: Number = 0.0  # that its random walk gains a sample, degC^2
    gain_factor: Number = 1.0  # steady-state gain, in multiples of that of B / A
    time_constant_factor: Number = 1.0  # dominant time constant, in multiples of that of A
    gain_drift: Number = 1.0  # by which factor the gain has changed after drift_samples
    time_constant_drift: Number = 1.0  # by which the time constant has
    drift_samples: int = 1200
    sampling_interval: float = 8.0  # s (Section 5)
    # The set point y_d. The paper plots it and does not state it.
    setpoint: str | float | Sequence[float] = "square"
    setpoint_amplitude: float = 5.0  # degC
    setpoint_period: int = 600  # samples
    # The observation: how many of the latest samples of each signal.
    setpoint_window: int = 3  # y_d(k), y_d(k-1), y_d(k-2): inputs 1 to 3 of the paper's NN
    error_window: int = 3  # e(k), e(k-1), e(k-2): inputs 4 to 6
    output_window: int = 0
    action_window: int = 0
    temperature_span: float = 50.0  # degC; the transmitter saturates at +-span
    # The reward.
    reward: str = "quadratic"  # the negative of the cost (12), scaled
    error_scale: float = 5.0  # degC
    move_weight: float = 0.0  # per unit of normalised action

    def __post_init__(self) -> None:
        checks: dict[str, Callable[[str, Any], Any]] = {
            "a": _polynomial,
            "b": _numbers,
            "c": _polynomial,
            "delay": _or_range(_count),
            "dead_zone": _or_range(_not_negative),
            "u_min": _or_range(_number),
            "u_max": _or_range(_number),
            "noise_variance": _or_range(_not_negative),
            "measurement_noise_variance": _or_range(_not_negative),
            "disturbance_amplitude": _or_range(_not_negative),
            "disturbance_interval": _or_range(_at_least_1),
            "disturbance_walk_variance": _or_range(_not_negative),
            "gain_factor": _or_range(_positive),
            "time_constant_factor": _or_range(_positive),
            "gain_drift": _or_range(_positive),
            "time_constant_drift": _or_range(_positive),
            "drift_samples": positive_count,
            "sampling_interval": _positive,
            "setpoint": _setpoint,
            "setpoint_amplitude": _not_negative,
            "setpoint_period": positive_count,
            "setpoint_window": _count,
            "error_window": _count,
            "output_window": _count,
            "action_window": _count,
            "temperature_span": _positive,
            "reward": _reward,
            "error_scale": _positive,
            "move_weight": _not_negative,
        }
        for name, check in checks.items():
            object.__setattr__(self, name, check(name, getattr(self, name)))

        self._check_actuator()
        self._check_dynamics()
        if self.observation_size == 0:
            _reject(
                "setpoint_window, error_window, output_window, action_window",
                (0, 0, 0, 0),
                "such that the observation has at least one element",
            )

    def _check_actuator(self) -> None:
        """Refuse limits and a dead zone that do not fit together, whatever is drawn."""
        (lowest, low), (high, highest) = self.range_of("u_min"), self.range_of("u_max")
        if low >= high:
            _reject("u_min", self.u_min, f"below u_max = {_shown(self.u_max)}")
        # The draw that leaves least of both limits.
        reach = max(_least_magnitude(lowest, low), _least_magnitude(high, highest))
        if self.range_of("dead_zone")[1] > reach:
            _reject(
                "dead_zone",
                self.dead_zone,
                "small enough to leave some command effective, at most max(|u_min|, |u_max|) = "
                f"{reach:g}",
            )

    def _check_dynamics(self) -> None:
        """Refuse a change of dynamics that A has no meaning for."""
        name = "time_constant_factor"
        drift = self.range_of("time_constant_drift")[0]
        if self.changes_time_constant:
            pole = slowest_pole(self.a)
            if not 0.0 < pole < 1.0:
                _reject(
                    f"{name}, time_constant_drift",
                    (getattr(self, name), self.time_constant_drift),
                    f"1 for this a, whose slowest pole, {pole:g}, is not between 0 and 1",
                )
            if self.range_of(name)[0] * min(drift, 1.0) < 1.0 - pole:
                _reject(
                    f"{name}, time_constant_drift",
                    (getattr(self, name), self.time_constant_drift),
                    f"such that the factor is never below {1.0 - pole:g}, where the slowest "
                    "pole comes to 0",
                )
        if self.is_disturbed and not np.all(np.abs(np.roots(self.a)) < 1.0):
            _reject(
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
        """Whether the time constant is, or may come to be, another than that of A."""
        return self._may_change("time_constant_factor", "time_constant_drift")

    @property
    def changes_dynamics(self) -> bool:
        """Whether (28) has, or may come to have, other coefficients than A and B."""
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
        """Where the errors, outputs and actions begin in the observation."""
        setpoints, errors, outputs, _ = self.windows
        return setpoints, setpoints + errors, setpoints + errors + outputs

    @property
    def largest_setpoint(self) -> float:
        """Largest magnitude that the set point can take, in degC."""
        if isinstance(self.setpoint, str):
            return self.setpoint_amplitude
        levels = self.setpoint if isinstance(self.setpoint, tuple) else (self.setpoint,)
        return max(abs(float(level)) for level in levels)
