"""Every argument of the environment, in one frozen dataclass that checks itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any, Final, NoReturn

SETPOINTS: Final = ("square", "random")
REWARDS: Final = ("quadratic", "absolute")
LARGEST: Any = 10**9  # of any argument; beyond, float32 observations and squares lose meaning


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


@dataclass(frozen=True, kw_only=True)
class Parameters:
    """The arguments of `MiddlePoint-v0`, checked and brought to plain Python types.

    The defaults are the first case of the paper (Section 5, Fig. 5). All quantities are
    deviations from the operating point.

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
    delay: int = 18  # d, samples
    # The actuator, (29).
    dead_zone: float = 5.0  # t/h
    u_min: float = -10.0  # U_min, t/h
    u_max: float = 10.0  # U_max, t/h
    noise_variance: float = 0.0  # R, the variance of xi, degC^2
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
            "delay": _count,
            "dead_zone": _not_negative,
            "u_min": _number,
            "u_max": _number,
            "noise_variance": _not_negative,
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

        if self.u_min >= self.u_max:
            _reject("u_min", self.u_min, f"below u_max = {self.u_max:g}")
        if self.dead_zone > max(abs(self.u_min), abs(self.u_max)):
            _reject(
                "dead_zone",
                self.dead_zone,
                "small enough to leave some command effective, at most max(|u_min|, |u_max|) = "
                f"{max(abs(self.u_min), abs(self.u_max)):g}",
            )
        if self.observation_size == 0:
            _reject(
                "setpoint_window, error_window, output_window, action_window",
                (0, 0, 0, 0),
                "such that the observation has at least one element",
            )

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
