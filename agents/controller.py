"""Define the base classes of all controllers, and check their arguments."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from numbers import Integral, Real
from typing import Annotated, Any, Final, get_type_hints

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.actuator import float32_action

# Arguments of the environment that show the six inputs of the paper's network: the latest three
# set points and the latest three errors.
PAPER_WINDOWS: Final = {"setpoint_window": 3, "error_window": 3}
Values = NDArray[np.float64] | np.float64  # one value per loop: shape () or (batch,)
# Largest number of nodes, loops or samples of delay that is accepted. A larger number is a
# typing error, and could exhaust the memory.
LARGEST_SIZE = 1_000_000

Validator = Callable[[str, Any], Any]


def _require(is_allowed: bool, name: str, value: Any, allowed: str) -> None:
    """Raise a ValueError unless `is_allowed`: the argument `name` must be `allowed`.

    `allowed` describes the allowed values in words, such as "a finite number", and the message
    shows the argument's `value`.
    """
    if not is_allowed:
        raise ValueError(f"{name} must be {allowed}, got {value!r}")


def _is_number(value: Any, kind: type[Any]) -> bool:
    """Return whether a value is a number of a kind, `Real` or `Integral`, but not a bool."""
    return isinstance(value, kind) and not isinstance(value, bool | np.bool_)


# The following functions validate an argument: `name` is the argument's name, for the message.
# An allowed value is returned as a Python float, int or bool. For any other value, the function
# raises a ValueError that names the argument.


def finite(name: str, value: Any) -> float:
    """Return `value` as a float; raise a ValueError unless it is a finite number."""
    is_allowed = _is_number(value, Real) and math.isfinite(value)
    _require(is_allowed, name, value, "a finite number")
    return float(value)


def not_negative(name: str, value: Any) -> float:
    """Return `value` as a float; raise a ValueError unless it is finite and at least 0."""
    is_allowed = _is_number(value, Real) and 0.0 <= value < math.inf
    _require(is_allowed, name, value, "a finite number of at least 0")
    return float(value)


def positive(name: str, value: Any) -> float:
    """Return `value` as a float; raise a ValueError unless it is finite and above 0."""
    is_allowed = _is_number(value, Real) and 0.0 < value < math.inf
    _require(is_allowed, name, value, "a finite number above 0")
    return float(value)


def nonzero(name: str, value: Any) -> float:
    """Return `value` as a float; raise a ValueError unless it is finite and not 0."""
    is_allowed = _is_number(value, Real) and 0.0 < abs(value) < math.inf
    _require(is_allowed, name, value, "a finite number other than 0")
    return float(value)


def flag(name: str, value: Any) -> bool:
    """Return `value` as a bool; raise a ValueError unless it is True or False."""
    _require(isinstance(value, bool | np.bool_), name, value, "True or False")
    return bool(value)


def integer_from_0(name: str, value: Any) -> int:
    """Return `value` as an int; raise a ValueError unless it is an integer of at least 0."""
    is_allowed = _is_number(value, Integral) and value >= 0
    _require(is_allowed, name, value, "an integer of at least 0")
    return int(value)


def integer_from_1(name: str, value: Any) -> int:
    """Return `value` as an int; raise a ValueError unless it is an integer of at least 1."""
    is_allowed = _is_number(value, Integral) and value >= 1
    _require(is_allowed, name, value, "an integer of at least 1")
    return int(value)


def array_size(name: str, value: Any) -> int:
    """Return `value` as an int; raise a ValueError unless it is from 1 to `LARGEST_SIZE`."""
    is_allowed = _is_number(value, Integral) and 1 <= value <= LARGEST_SIZE
    _require(is_allowed, name, value, f"an integer from 1 to {LARGEST_SIZE:,}")
    return int(value)


# Types for the fields of controllers. Each type carries one of the validators above, which the
# controller's constructor calls.
Number = Annotated[float, finite]
NotNegative = Annotated[float, not_negative]
Positive = Annotated[float, positive]
Gain = Annotated[float, nonzero]
Flag = Annotated[bool, flag]
Index = Annotated[int, integer_from_0]
Count = Annotated[int, integer_from_1]
Size = Annotated[int, array_size]


def check_numbers(name: str, value: ArrayLike) -> NDArray[np.float64]:
    """Return real numbers as a float64 array of the same shape.

    `name` is the argument's name for the message of the ValueError, which is raised if `value`
    is not an array-like of real numbers: text, complex numbers or rows of unequal length.
    """
    try:
        array = np.asarray(value)
        if array.dtype.kind in "biufO":  # neither text, which NumPy would parse, nor complex
            return array.astype(np.float64, copy=False)
    except (TypeError, ValueError, OverflowError, RuntimeError):  # the last from tensors
        pass
    raise ValueError(f"{name} must be numbers, got {value!r}")


@cache  # as reading the annotations is slow
def _validators(controller_class: type) -> dict[str, Validator]:
    """Return the validators of a controller class by the names of the fields."""
    annotations = get_type_hints(controller_class, include_extras=True)
    validators = {}
    for name, annotation in annotations.items():
        if hasattr(annotation, "__metadata__"):  # an `Annotated` type such as `Positive`
            validators[name] = annotation.__metadata__[0]
    return validators


@dataclass(eq=False, kw_only=True)
class Controller(ABC):
    """A controller of one control loop, or of a batch of independent control loops.

    Controllers are dataclasses: the fields of a controller are the arguments of its
    constructor, and the type of a field, such as `Positive`, states which values are allowed.

    Parameters
    ----------
    u_min
        Lower limit of the actuator, t/h: the flow for which the action -1 stands. Commands
        beyond the limits of the actuator are not clipped by the controller.
    u_max
        Upper limit of the actuator, t/h: the flow for which the action 1 stands.

    Attributes
    ----------
    n_obs : int
        The minimum number of elements in an observation of one loop.
    command : float64 or ndarray of float64
        The last command u, t/h: the flow that the controller asked of the actuator. After `act`
        on a batch of loops, the shape is (batch,).

    Raises
    ------
    ValueError
        If an argument is out of range; the message names the argument.
    """

    u_min: Number = -10.0
    u_max: Number = 10.0
    n_obs: int = field(init=False, repr=False)
    command: Values = field(init=False, repr=False)

    # Half width of the dead zone, t/h, if the controller commands the edge of the dead zone: an
    # action for the edge is rounded such that the flow passes. Otherwise 0.
    _edge = 0.0
    # Whether the controller remembers past samples. Without memory, the batch size may change
    # at any sample.
    _remembers = True

    def __post_init__(self) -> None:
        """Check the constructor's arguments, and call `reset`.

        A subclass calls this method first, and then sets the attributes that its `reset` does
        not use.
        """
        for name, validator in _validators(type(self)).items():
            setattr(self, name, validator(name, getattr(self, name)))
        if self.u_min >= self.u_max:
            raise ValueError(f"u_min must be below u_max = {self.u_max!r}, got {self.u_min!r}")
        self.reset()

    def reset(self) -> None:
        """Forget the past samples before a new episode, but keep learnt weights."""
        self.command = np.float64(0.0)
        # Shape of the commands since `reset`: () for one loop, (batch,) for a batch, and None
        # before the first sample.
        self._loop_shape: tuple[int, ...] | None = None

    def check_environment(self, parameters: Any, wrapped: str, n: int) -> None:
        """Refuse plants that the controller was not made for, as their scores would be wrong.

        `mptc_gym.evaluate` calls this method before it runs the controller.

        Parameters
        ----------
        parameters
            The arguments of the plants, as attributes with the names of `mptc_gym.Parameters`;
            an argument that differs between plants is an array of shape (n,).
        wrapped
            The names of the environment's wrappers that change observations or actions; ""
            without such wrappers.
        n
            Number of plants, each of which is one loop.

        Raises
        ------
        ValueError
            If the limits of the flow differ, if the controller would read a set point or an
            error at the wrong place of the observation, if the environment is wrapped, or if
            the controller has weights for another number of loops.
        """
        # If each episode draws its limits of the flow, the controller must have the widest.
        limits = float(np.min(parameters.u_min)), float(np.max(parameters.u_max))
        if limits != (self.u_min, self.u_max):
            raise ValueError(
                f"policy must be made with the limits of env, u_min={limits[0]}, "
                f"u_max={limits[1]}, got {self.u_min}, {self.u_max}"
            )
        first = 0  # index of the signal's newest sample in the observation
        for signal in ("setpoint", "error"):
            window = getattr(parameters, f"{signal}_window")
            # None if the controller does not read this element alone.
            index = getattr(self, f"{signal}_index", None)
            if index is not None and (index != first or not window):
                raise ValueError(
                    f"env must show its newest {signal} as element {index} of the observation, "
                    f"where policy reads it, got setpoint_window={parameters.setpoint_window}, "
                    f"error_window={parameters.error_window}"
                )
            first += window
        if wrapped:
            raise ValueError(
                f"env must not be wrapped, as policy commands the flow itself, got {wrapped}"
            )

    def act(self, observation: ArrayLike) -> NDArray[np.float32]:
        """Return the action of the present sample; call this method once for each sample.

        Parameters
        ----------
        observation
            The environment's observation, of shape (n_obs,) for one loop, or (batch, n_obs)
            with one row per loop. Elements that the controller does not read are ignored.

        Returns
        -------
        ndarray of float32
            The normalised action: -1 stands for `u_min`, and 1 for `u_max`. The shape is (1,)
            for one loop, or (batch, 1). An action lies outside [-1, 1] if the command exceeds
            the actuator's limits.

        Raises
        ------
        ValueError
            If the observation has the wrong shape, a value that is not finite, or another batch
            size than the observations since `reset`. The error leaves the controller unchanged.
        """
        values = check_numbers("observation", observation)
        if values.ndim not in (1, 2) or values.shape[-1] < self.n_obs or not len(values):
            raise ValueError(
                f"observation must have shape (n_obs,) or (batch, n_obs), n_obs at least "
                f"{self.n_obs}, got {values.shape}"
            )
        if not np.isfinite(values).all():
            raise ValueError(f"observation must be finite, got {observation!r}")
        loop_shape = values.shape[:-1]
        if self._loop_shape not in (None, loop_shape):
            raise ValueError(
                f"observation must have shape {(*self._loop_shape, self.n_obs)}, for the "
                f"loops since reset or for num_envs loops, got {values.shape}"
            )
        commands = self._control(np.atleast_2d(values))
        is_batch = loop_shape != ()
        self.command = commands if is_batch else commands[0]
        if self._remembers:
            self._loop_shape = loop_shape
        return float32_action(self.command, self.u_min, self.u_max, self._edge)[..., np.newaxis]

    @abstractmethod
    def _control(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the commands u(k), t/h, shape (loops,), and update the controller's memory.

        `act` calls this method once per sample. `rows` are the checked observations, with one
        row per loop, shape (loops, size).
        """


@dataclass(eq=False, kw_only=True)
class ModelBasedController(Controller):
    """A controller that knows a step test of the plant, and the numbers of the actuator.

    The step test gives the gain, the time constant and the delay of a first-order model. The
    arguments `u_min` and `u_max` are those of `Controller`.

    Parameters
    ----------
    gain
        Steady-state gain of the plant, degC per t/h; positive or negative.
    time_constant
        Time constant of the plant, s.
    delay
        Delay of the plant, s, from a change of the command to the first change of a sampled
        output: d + 1 sampling intervals for a transport delay of d samples.
    dead_zone
        Half width of the actuator's dead zone, t/h; 0 if unknown. A command inside the dead
        zone reaches the plant as a flow of 0; a command on the edge of the dead zone passes.
    sampling_interval
        Sampling interval, s.
    """

    gain: Gain
    time_constant: Positive
    delay: NotNegative
    dead_zone: NotNegative = 0.0
    sampling_interval: Positive = 8.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self._edge = self.dead_zone
        if self.delay / self.sampling_interval > LARGEST_SIZE:
            raise ValueError(
                f"delay must be at most {LARGEST_SIZE:,} times sampling_interval = "
                f"{self.sampling_interval!r}, got {self.delay!r}"
            )
