"""Declare every argument of the environment once, in a dataclass that checks itself."""

# ruff: noqa: RUF009 (`_argument` makes fields)

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property, partial
from typing import Any, Final, Generic, TypeVar

import numpy as np

from mptc_gym.plant import checks
from mptc_gym.plant.checks import Number, reject

WINDOWS: Final = "setpoint_window", "error_window", "output_window", "action_window"
# The arguments of an environment that say what a policy observes and what its actions mean.
INTERFACE: Final = *WINDOWS, "action", "max_move", "compensated_dead_zone"
# The observation of the paper's network: y_d(k), y_d(k-1), y_d(k-2), e(k), e(k-1) and e(k-2).
PAPER_WINDOWS: Final = {"setpoint_window": 3, "error_window": 3}
EPISODE_STEPS: Final = 1200  # samples of an episode, unless an environment is made with others
Value = TypeVar("Value")  # type of a `PlantNumbers` field: float, array, tensor or `Number`


def _argument(default: Any, check: checks.Check, unit: str, meaning: str) -> Any:
    """Return a dataclass field for one argument of the environment."""
    metadata = {"check": check, "unit": unit, "meaning": meaning}
    return field(default=default, metadata=metadata)


@dataclass(frozen=True, kw_only=True)
class PlantNumbers(Generic[Value]):
    """The arguments of a plant that can differ from episode to episode, such as the delay.

    In the arguments of the environment, each field of `PlantNumbers` is one number, or a range
    [low, high] from which each reset of the environment samples one number; only `u_min` and
    `u_max` are always one number. During an episode, each field of `PlantNumbers` is a float
    for one plant, or an array or tensor for many plants.

    If field i of `PlantNumbers` is a range, a reset computes the value of field i from random
    number i of the episode. The order of the fields of `PlantNumbers` must therefore never
    change, and a new field must come last: otherwise the same seed would give another plant.
    """

    delay: Value = _argument(
        18, checks.count_from_0, "samples", "transport delay d in equation (28)"
    )
    dead_zone: Value = _argument(
        5.0, checks.not_negative, "t/h", "half width of the dead zone in equation (29)"
    )
    u_min: Value = _argument(
        -10.0, checks.number, "t/h", "lower limit U_min of the flow in equation (29)"
    )
    u_max: Value = _argument(
        10.0, checks.number, "t/h", "upper limit U_max of the flow in equation (29)"
    )
    noise_variance: Value = _argument(
        0.0, checks.not_negative, "degC^2", "variance R of the noise xi in equation (28)"
    )
    measurement_noise_variance: Value = _argument(
        0.0, checks.not_negative, "degC^2", "variance of the transmitter's white noise"
    )
    disturbance_amplitude: Value = _argument(
        0.0, checks.not_negative, "degC", "largest magnitude of the load's levels"
    )
    disturbance_interval: Value = _argument(
        150.0,
        checks.at_least_1,
        "samples",
        "mean time between steps of the load; values below 10 are treated as 10",
    )
    disturbance_walk_variance: Value = _argument(
        0.0,
        checks.not_negative,
        "degC^2",
        "variance that the random walk of the load gains per sample",
    )
    gain_factor: Value = _argument(
        1.0,
        checks.positive,
        "1",
        "steady-state gain at k = 0 divided by the gain of `a` and `b`",
    )
    time_constant_factor: Value = _argument(
        1.0,
        checks.positive,
        "1",
        "dominant time constant at k = 0 divided by the time constant of `a`",
    )
    gain_drift: Value = _argument(
        1.0, checks.positive, "1", "gain at k = `drift_samples` divided by the gain at k = 0"
    )
    time_constant_drift: Value = _argument(
        1.0,
        checks.positive,
        "1",
        "time constant at k = `drift_samples` divided by the time constant at k = 0",
    )

    def select(self, names: Iterable[str]) -> dict[str, Value]:
        """Return the values of the fields with the names `names`, as a dict by name."""
        return {name: getattr(self, name) for name in names}


def slowest_pole(a: Sequence[float]) -> complex:
    """Return the pole of 1 / A(z^-1) with the largest magnitude, or 0 if A has degree 0.

    `a` holds the coefficients of the polynomial A of equation (28) of the paper, from z^0 on.
    """
    poles = np.roots([*a, 0.0])  # the 0 adds a pole of 0, which is all that degree 0 has
    return complex(poles[np.argmax(np.abs(poles))])


@dataclass(frozen=True, kw_only=True)
class Parameters(PlantNumbers[Number]):
    """The arguments of `MiddlePoint-v0`, checked and converted to Python's own types.

    In the table of arguments, (28) is the paper's equation of the plant, and (29) the paper's
    equation of the actuator; the docstring of `MiddlePointEnv` states both equations and cites
    the paper. The default arguments are the first case of the paper (Section 5, Fig. 5). All
    temperatures and flows are deviations from the boiler's operating point. In the table of
    arguments, an asterisk marks an argument that can be a range [low, high], from which each
    `reset` samples a number.

    <arguments>

    Raises
    ------
    ValueError
        If the value of an argument is not allowed. The message of the error names the argument,
        the value and the allowed values.
    """

    # The plant, equation (28) of the paper, with temperature y, applied flow u_a, delay d and
    # white noise xi: A(z^-1) y(k) = B(z^-1) u_a(k - d) + C(z^-1) xi(k). With an unstable A, the
    # temperature y may grow beyond all floats.
    a: Sequence[float] = _argument(
        (1.0, -0.45181, -0.47546),
        checks.polynomial,
        "1",
        "coefficients of A in equation (28), from z^0 on; the first is 1",
    )
    b: Sequence[float] = _argument(
        (-0.04560, -0.00404),
        checks.number_list,
        "degC per t/h",
        "coefficients of B in equation (28), from z^-1 on",
    )
    c: Sequence[float] = _argument(
        (1.0, -0.35740, -0.03392),
        checks.polynomial,
        "1",
        "coefficients of C in equation (28), from z^0 on; the first is 1",
    )
    drift_samples: int = _argument(
        EPISODE_STEPS,
        checks.count_from_1,
        "samples",
        "time in which gain and time constant drift",
    )
    sampling_interval: float = _argument(
        8.0,
        checks.positive,
        "s",
        "duration of a sample; the dynamics in samples do not depend on it",
    )
    # The paper plots the set point, but does not state the set point's amplitude and period.
    setpoint: str | float | Sequence[float] = _argument(
        "square",
        checks.setpoint,
        "degC",
        '"square", "random", a number (constant), or a list with a number for each sample, '
        "whose last number is held; [-5, 5] is a list for two samples, not a range",
    )
    setpoint_amplitude: float = _argument(
        5.0,
        checks.not_negative,
        "degC",
        'A: "square" alternates between A and -A; "random" samples levels uniformly from '
        "[-A, A]",
    )
    setpoint_period: int = _argument(
        600,
        checks.count_from_1,
        "samples",
        'P: "square" repeats every P samples; "random" holds each level for a uniform random '
        "number of samples from P/6 to P/2",
    )
    setpoint_window: int = _argument(
        PAPER_WINDOWS["setpoint_window"],
        checks.count_from_0,
        "samples",
        "number of latest set points in the observation",
    )
    error_window: int = _argument(
        PAPER_WINDOWS["error_window"],
        checks.count_from_0,
        "samples",
        "number of latest errors in the observation",
    )
    output_window: int = _argument(
        0,
        checks.count_from_0,
        "samples",
        "number of latest measured outputs in the observation",
    )
    action_window: int = _argument(
        0, checks.count_from_0, "samples", "number of latest past actions in the observation"
    )
    temperature_span: float = _argument(
        50.0,
        checks.positive,
        "degC",
        "largest magnitude of a reading of the transmitter, which saturates there, and so of a "
        "set point",
    )
    reward: str = _argument(
        "quadratic", checks.reward, "", 'form of the reward: "quadratic" or "absolute"'
    )
    error_scale: float = _argument(
        5.0,
        checks.positive,
        "degC",
        'error for which the reward is -1/2 (if "quadratic") or -1 (if "absolute")',
    )
    move_weight: float = _argument(
        0.0,
        checks.not_negative,
        "1",
        "cost of a change of the flow by half its range, subtracted from the reward",
    )
    action: str = _argument(
        "flow",
        checks.action,
        "",
        'what an action sets: "flow", or "change", a change of the flow',
    )
    max_move: float = _argument(
        0.4,
        checks.share_of_range,
        "1",
        '"change": change of the flow for an action of 1, as a share of half the range',
    )
    compensated_dead_zone: float = _argument(
        0.0,
        checks.not_negative,
        "t/h",
        '"change": half width of the dead zone that the commands skip',
    )

    def __post_init__(self) -> None:
        for name, argument in ARGUMENTS.items():
            check = argument.metadata["check"]
            if name in CAN_BE_RANGES:
                check = partial(checks.number_or_range, check)
            value = check(name, checks.to_python(getattr(self, name)))
            object.__setattr__(self, name, value)  # the dataclass is frozen
        self._check_actuator()
        if self.largest_setpoint > self.temperature_span:
            name = "setpoint_amplitude" if isinstance(self.setpoint, str) else "setpoint"
            allowed = f"within +-temperature_span = {self.temperature_span:g}"
            reject(name, getattr(self, name), allowed)
        if self.changes_time_constant:
            self._check_time_constant()
        if self.is_disturbed and abs(slowest_pole(self.a)) >= 1.0:
            reject("a", self.a, "stable: with a load disturbance, the plant has a steady state")
        if not any(self.windows):
            allowed = "such that the observation has at least one element"
            reject(", ".join(WINDOWS), self.windows, allowed)

    def _check_actuator(self) -> None:
        """Raise a ValueError if limits of the flow and dead zone do not fit together."""
        # The limits are never ranges, so `lowest` has the limits of every plant.
        u_min, u_max = self.lowest.u_min, self.lowest.u_max
        if u_min >= u_max:
            reject("u_min", u_min, f"below u_max = {u_max}")
        largest_command = max(abs(u_min), abs(u_max))
        if self.range_of("dead_zone")[1] > largest_command:  # the widest dead zone
            allowed = f"at most {largest_command:g}, the largest magnitude of a command"
            reject("dead_zone", self.dead_zone, allowed)

    def _check_time_constant(self) -> None:
        """Raise a ValueError if `a` does not allow these changes of the time constant.

        A factor t replaces the slowest pole p of 1 / A(z^-1) by 1 - (1 - p) / t, which must be
        neither complex nor negative.
        """
        pole = slowest_pole(self.a)
        # The least factor of any episode, at its start or at the end of its drift.
        shortest = self.lowest.time_constant_factor * min(self.lowest.time_constant_drift, 1.0)
        if pole.imag != 0.0 or not 0.0 < pole.real < 1.0 or shortest < 1.0 - pole.real:
            reject(
                "time_constant_factor, time_constant_drift",
                (self.time_constant_factor, self.time_constant_drift),
                "1, or such that the factor is never below 1 - p, for a slowest pole p of a "
                f"between 0 and 1; here, p = {pole:g}",
            )

    def range_of(self, name: str) -> tuple[float, float]:
        """Return the range (low, high) of the field `name` of `PlantNumbers`.

        If the field `name` is one number instead of a range, low and high both equal the
        number.
        """
        value = getattr(self, name)
        return value if isinstance(value, tuple) else (value, value)

    @cached_property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """The range (low, high) of each field of `PlantNumbers` that is a range, by name."""
        numbers = self.select(PLANT_NUMBERS)
        return {name: value for name, value in numbers.items() if isinstance(value, tuple)}

    @cached_property
    def lowest(self) -> PlantNumbers[float]:
        """All fields of `PlantNumbers`, each range replaced by the low end of the range."""
        return PlantNumbers(**{name: self.range_of(name)[0] for name in PLANT_NUMBERS})

    @cached_property
    def largest_setpoint(self) -> float:
        """Largest magnitude that the set point can have, degC."""
        if isinstance(self.setpoint, str):
            return self.setpoint_amplitude
        return float(np.abs(self.setpoint).max())

    @cached_property
    def is_disturbed(self) -> bool:
        """Whether the plant can have a load disturbance other than 0."""
        return self._can_differ(0.0, "disturbance_amplitude", "disturbance_walk_variance")

    def _can_differ(self, value: float, *names: str) -> bool:
        """Return whether any of the fields `names` can have a value other than `value`."""
        return any(self.range_of(name) != (value, value) for name in names)

    @cached_property
    def drifts(self) -> bool:
        """Whether the gain or the time constant of the plant can change within an episode."""
        return self._can_differ(1.0, "gain_drift", "time_constant_drift")

    @cached_property
    def changes_time_constant(self) -> bool:
        """Whether the plant can have another time constant than the polynomial `a` gives."""
        return self._can_differ(1.0, "time_constant_factor", "time_constant_drift")

    @cached_property
    def changes_dynamics(self) -> bool:
        """Whether `gain_factor`, `time_constant_factor` or a drift can change the dynamics."""
        return self.drifts or self._can_differ(1.0, "gain_factor", "time_constant_factor")

    @cached_property
    def windows(self) -> tuple[int, int, int, int]:
        """Numbers of set points, errors, outputs and past actions in an observation."""
        return self.setpoint_window, self.error_window, self.output_window, self.action_window


# The dataclass field of every argument, by name.
ARGUMENTS: Final[dict[str, Any]] = {argument.name: argument for argument in fields(Parameters)}
# Index of each field of `PlantNumbers`, and of the field's random number, by name.
PLANT_NUMBERS: Final = {number.name: i for i, number in enumerate(fields(PlantNumbers))}
# The names of the arguments that can be a range [low, high].
CAN_BE_RANGES: Final = PLANT_NUMBERS.keys() - {"u_min", "u_max"}


def argument_table() -> str:
    """Return a Markdown table with a row for each argument except `render_mode`.

    The columns of the returned table are name, default, unit and meaning. An asterisk after the
    default marks an argument that can be a range [low, high].
    """
    rows = ["| Argument | Default | Unit | Meaning |", "|---|---|---|---|"]
    for name, argument in ARGUMENTS.items():
        default = repr(argument.default).replace("'", '"')
        if name in CAN_BE_RANGES:
            default += "*"
        unit = argument.metadata["unit"]
        meaning = argument.metadata["meaning"]
        rows.append(f"| `{name}` | {default} | {unit} | {meaning} |")
    return "\n".join(rows)


def insert_table(docstring: str | None) -> str:
    """Return a docstring with the table of arguments in place of the text `<arguments>`.

    With `python -OO`, which removes docstrings, `docstring` is None and the result is "".
    """
    return inspect.cleandoc(docstring or "").replace("<arguments>", argument_table())


Parameters.__doc__ = insert_table(Parameters.__doc__)


def full_signature(constructor: Callable[..., Any]) -> inspect.Signature:
    """Return the signature of an environment's `__init__` with all arguments of `Parameters`.

    The returned signature, which help() and notebooks show, lists the arguments of `Parameters`
    in place of `**arguments`, and leaves out `self`.
    """
    parameters = list(inspect.signature(constructor).parameters.values())
    parameters = parameters[1:-1]  # without `self` and `**arguments`, the first and the last
    for parameter in inspect.signature(Parameters).parameters.values():
        annotation = parameter.annotation
        if parameter.name in PLANT_NUMBERS:  # whose annotation is a type variable
            annotation = "float"
        if parameter.name in CAN_BE_RANGES:
            annotation = "float | Sequence[float]"
        parameters.append(parameter.replace(annotation=annotation))
    return inspect.Signature(parameters)
