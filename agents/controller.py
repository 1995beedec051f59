"""Define the base classes of all controllers, and validate constructor arguments."""

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

# Arguments of the environment for an observation of the latest three set points and the latest
# three errors: the six inputs of the paper's network.
PAPER_WINDOWS: Final = {"setpoint_window": 3, "error_window": 3}
Values = NDArray[np.float64] | np.float64  # one value per loop: shape () or (batch,)
# Largest allowed number of network nodes, of loops and of samples of delay. A larger number is
# probably a typing error, and could exhaust the memory.
LARGEST_SIZE = 1_000_000

Validator = Callable[[str, Any], Any]


def _require(is_allowed: bool, name: str, value: Any, allowed: str) -> None:
    """Raise a ValueError for the argument `name` unless `is_allowed` is true.

    `allowed` describes the allowed values in words for the message, such as "a finite number".
    """
    if not is_allowed:
        raise ValueError(f"{name} must be {allowed}, got {value!r}")


def _is_number(value: Any, kind: type[Any]) -> bool:
    """Return whether `value` has the type `kind` (`Real` or `Integral`) and is not a bool."""
    return isinstance(value, kind) and not isinstance(value, bool | np.bool_)


# Each of the following functions validates a constructor argument. `name` is the argument's
# name for the message of the ValueError.


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


# Types for the fields of controllers. Each type carries a validator, which the constructor of
# the controller calls with the field's value.
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

    A ValueError that names the argument `name` is raised for anything else, such as text,
    complex numbers or rows of unequal length.
    """
    try:
        array = np.asarray(value)
        if array.dtype.kind in "biufO":  # neither text, which NumPy would parse, nor complex
            return array.astype(np.float64, copy=False)
    except (TypeError, ValueError, OverflowError, RuntimeError):  # the last from tensors
        pass
    raise ValueError(f"{name} must be numbers, got {value!r}")


@cache  # because `get_type_hints` is slow
def _validators(controller_class: type) -> dict[str, Validator]:
    """Return a dict from field names of a controller class to their validators."""
    annotations = get_type_hints(controller_class, include_extras=True)
    validators = {}
    for name, annotation in annotations.items():
        if hasattr(annotation, "__metadata__"):  # an `Annotated` type such as `Positive`
            validators[name] = annotation.__metadata__[0]
    return validators


@dataclass(eq=False, kw_only=True)
class Controller(ABC):
    """A controller of one control loop, or of a batch of independent control loops.

    Every controller is a dataclass whose fields are the constructor arguments. The type of an
    argument, such as `Positive`, states the values that the argument may have.

    Parameters
    ----------
    u_min
        Lower limit of the actuator's flow, t/h, which the action -1 commands. Some controllers,
        such as `PIController`, also command flows beyond the limits.
    u_max
        Upper limit of the actuator's flow, t/h, which the action 1 commands.

    Attributes
    ----------
    n_obs : int
        Smallest number of elements that an observation of one loop may have.
    command : float64 or ndarray of float64
        Command u of the last call of `act`, t/h: a number, or an array of shape (batch,) for a
        batch of loops.

    Raises
    ------
    ValueError
        If a constructor argument is out of range. The message names the argument.
    """

    u_min: Number = -10.0
    u_max: Number = 10.0
    n_obs: int = field(init=False, repr=False)
    command: Values = field(init=False, repr=False)

    # Half width of the dead zone, t/h, for a controller that commands the edge of the dead
    # zone, and 0 for other controllers. `float32_action` keeps such commands out of the dead
    # zone.
    _edge = 0.0
    # Whether the controller remembers past samples. The batch size of a controller without
    # memory may change at any sample.
    _remembers = True

    def __post_init__(self) -> None:
        """Validate the constructor arguments, and call `reset`.

        A subclass must call `super().__post_init__()` first. This call runs `reset`, so `reset`
        must not use attributes that a subclass sets after the call.
        """
        for name, validator in _validators(type(self)).items():
            setattr(self, name, validator(name, getattr(self, name)))
        if self.u_min >= self.u_max:
            raise ValueError(f"u_min must be below u_max = {self.u_max!r}, got {self.u_min!r}")
        self.reset()

    def reset(self) -> None:
        """Forget past samples before a new episode, but keep learnt network weights."""
        self.command = np.float64(0.0)
        # Shape that commands must have until the next `reset`: () for one loop, (batch,) for a
        # batch of loops, and None while both are allowed.
        self._loop_shape: tuple[int, ...] | None = None

    def check_environment(self, parameters: Any, wrapped: str, n: int) -> None:
        """Raise a ValueError if the controller does not fit the plants of an environment.

        `mptc_gym.evaluate` calls this method before an evaluation, so that a wrong limit or
        observation does not give a wrong score.

        Parameters
        ----------
        parameters
            Arguments of the environment, a `mptc_gym.Parameters`. An argument that is sampled
            at each reset is a range (low, high).
        wrapped
            Names of the environment's wrappers that change observations or actions; "" if there
            are none.
        n
            Number of plants.

        Raises
        ------
        ValueError
            If the controller does not fit the flow limits, the observations or the number of
            the plants, or if `wrapped` is not empty.
        """
        # If the flow limits are random for each episode, the controller must have the widest
        # limits.
        limits = float(np.min(parameters.u_min)), float(np.max(parameters.u_max))
        if limits != (self.u_min, self.u_max):
            raise ValueError(
                f"policy must have the flow limits of env, u_min={limits[0]}, "
                f"u_max={limits[1]}, got {self.u_min}, {self.u_max}"
            )
        first = 0  # index of the signal's newest sample in the observation
        for signal in ("setpoint", "error"):
            window = getattr(parameters, f"{signal}_window")
            # None for a controller without an index for this signal.
            index = getattr(self, f"{signal}_index", None)
            if index is not None and (index != first or not window):
                raise ValueError(
                    f"env must have the newest {signal} as element {index} of an observation, "
                    f"because policy reads this element, got "
                    f"setpoint_window={parameters.setpoint_window}, "
                    f"error_window={parameters.error_window}"
                )
            first += window
        if wrapped:
            raise ValueError(
                f"env must not be wrapped in a wrapper that changes observations or actions, "
                f"got {wrapped}"
            )

    def act(self, observation: ArrayLike) -> NDArray[np.float32]:
        """Return the action for an observation; call this method once per sample.

        Parameters
        ----------
        observation
            Observation of shape (n_obs,) for one loop, or (batch, n_obs) for a batch of loops.
            The values of elements that the controller does not need have no effect. A
            `PolicyNetwork` needs exactly n_obs elements, and other controllers at least n_obs.

        Returns
        -------
        ndarray of float32
            Normalised action, -1 for the command `u_min` and 1 for `u_max`, of shape (1,) for
            one loop, or (batch, 1). A command beyond the actuator's limits gives an action
            outside [-1, 1].

        Raises
        ------
        ValueError
            If `observation` has a wrong shape, a value that is not finite, or another batch
            size than earlier observations since `reset`. A ValueError leaves the controller
            unchanged.
        """
        values = check_numbers("observation", observation)
        if values.ndim not in (1, 2) or values.shape[-1] < self.n_obs or not len(values):
            raise ValueError(
                f"observation must have shape (n_obs,) or (batch, n_obs), with n_obs of at "
                f"least {self.n_obs}, got {values.shape}"
            )
        if not np.isfinite(values).all():
            raise ValueError(f"observation must be finite, got {observation!r}")
        loop_shape = values.shape[:-1]
        if self._loop_shape not in (None, loop_shape):
            raise ValueError(
                f"observation must have shape {(*self._loop_shape, self.n_obs)}, as the "
                f"number of loops is fixed by num_envs or since reset, got {values.shape}"
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

        `rows` are the observations of all loops at one sample, shape (loops, elements).
        """


@dataclass(eq=False, kw_only=True)
class ModelBasedController(Controller):
    """A controller whose arguments include a first-order model of the plant, from a step test.

    The arguments `u_min` and `u_max` are described in `Controller`.

    Parameters
    ----------
    gain
        Steady-state gain of the plant, degC per t/h; positive or negative.
    time_constant
        Time constant of the plant, s.
    delay
        Delay of the plant, s, from a change of the command to the first sampled output that
        changes. A transport delay of d samples gives a `delay` of d + 1 sampling intervals.
    dead_zone
        Half width of the actuator's dead zone, t/h; 0 if unknown. A command smaller in size
        than `dead_zone` gives a flow of 0.
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
