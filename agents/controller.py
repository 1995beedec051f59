"""Define the base classes of all controllers, and check their arguments."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from numbers import Integral, Real
from typing import Annotated, Any, Final, NoReturn, get_type_hints

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.actuator import float32_action

PAPER_WINDOWS: Final = {"setpoint_window": 3, "error_window": 3}  # the paper's six inputs
Values = NDArray[np.float64] | np.float64  # one value per loop: shape () or (batch,)
MOST = 1_000_000  # nodes, loops, elements or samples; a larger number is a mistake

Validator = Callable[[str, Any], Any]


def _reject(name: str, value: Any, allowed: str) -> NoReturn:
    """Raise a ValueError that says what an argument must be and what it is."""
    raise ValueError(f"{name} must be {allowed}, got {value!r}")


def _is_real(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool | np.bool_)


def _is_integer(value: Any) -> bool:
    return isinstance(value, Integral) and not isinstance(value, bool | np.bool_)


# Validators of arguments. They return a plain float, int or bool if the value is allowed, and
# raise a ValueError that names the argument otherwise.


def finite(name: str, value: Any) -> float:
    """Check that a value is a finite number."""
    if not (_is_real(value) and math.isfinite(value)):
        _reject(name, value, "a finite number")
    return float(value)


def not_negative(name: str, value: Any) -> float:
    """Check that a value is a finite number of at least 0."""
    if not (_is_real(value) and 0.0 <= value < math.inf):
        _reject(name, value, "a finite number of at least 0")
    return float(value)


def positive(name: str, value: Any) -> float:
    """Check that a value is a finite number above 0."""
    if not (_is_real(value) and 0.0 < value < math.inf):
        _reject(name, value, "a finite number above 0")
    return float(value)


def nonzero(name: str, value: Any) -> float:
    """Check that a value is a finite number other than 0."""
    if not (_is_real(value) and 0.0 < abs(value) < math.inf):
        _reject(name, value, "a finite number other than 0")
    return float(value)


def flag(name: str, value: Any) -> bool:
    """Check that a value is True or False."""
    if not isinstance(value, bool | np.bool_):
        _reject(name, value, "True or False")
    return bool(value)


def integer_from_0(name: str, value: Any) -> int:
    """Check that a value is an integer of at least 0."""
    if not (_is_integer(value) and value >= 0):
        _reject(name, value, "an integer of at least 0")
    return int(value)


def integer_from_1(name: str, value: Any) -> int:
    """Check that a value is an integer of at least 1."""
    if not (_is_integer(value) and value >= 1):
        _reject(name, value, "an integer of at least 1")
    return int(value)


def integer_to_most(name: str, value: Any) -> int:
    """Check that a value is an integer from 1 to `MOST`."""
    if not (_is_integer(value) and 1 <= value <= MOST):
        _reject(name, value, f"an integer from 1 to {MOST:,}")
    return int(value)


# Types for the fields of controllers, each with its validator, which the constructor applies.
Number = Annotated[float, finite]
NotNegative = Annotated[float, not_negative]
Positive = Annotated[float, positive]
Gain = Annotated[float, nonzero]
Flag = Annotated[bool, flag]
Index = Annotated[int, integer_from_0]
Count = Annotated[int, integer_from_1]
Size = Annotated[int, integer_to_most]


def check(name: str, value: Any, annotation: Any) -> Any:
    """Return a value that the validator of a type such as `Positive` accepts.

    A ValueError is raised if it does not.
    """
    (validator,) = annotation.__metadata__
    return validator(name, value)


def check_numbers(name: str, value: ArrayLike) -> NDArray[np.float64]:
    """Return real numbers as a float64 array; raise a ValueError for anything else."""
    try:
        array = np.asarray(value)
        if array.dtype.kind in "biufO":  # neither text, which NumPy would parse, nor complex
            return array.astype(np.float64, copy=False)
    except (TypeError, ValueError, OverflowError, RuntimeError):  # the last from tensors
        pass
    raise ValueError(f"{name} must be numbers, got {value!r}")


@cache  # as reading the annotations is slow
def _validated_fields(controller: type) -> dict[str, Any]:
    """Return the annotations of a controller's fields that have a validator, by name."""
    annotations = get_type_hints(controller, include_extras=True)
    return {
        name: annotation
        for name, annotation in annotations.items()
        if hasattr(annotation, "__metadata__")
    }


@dataclass(eq=False, kw_only=True)
class Controller(ABC):
    """A controller of one loop, or of a batch of independent loops.

    Controllers are dataclasses: their fields are the arguments of the constructor, and types
    such as `Positive` state which values are allowed.

    Parameters
    ----------
    u_min
        Lower limit of the actuator, t/h. The limits are the flows for which the actions -1 and
        1 stand. The controller does not clip commands beyond the limits.
    u_max
        Upper limit of the actuator, t/h.

    Attributes
    ----------
    n_obs : int
        The minimum number of elements in an observation.
    command : float64 or ndarray of float64
        The last command u, before the actuator, t/h; after `act` on a batch, shape (batch,).

    Raises
    ------
    ValueError
        If an argument is out of range; the message names it.
    """

    u_min: Number = -10.0
    u_max: Number = 10.0
    n_obs: int = field(init=False, repr=False)
    command: Values = field(init=False, repr=False)

    # Half width of the dead zone, t/h: commands on its edge keep their effect as actions.
    _edge = 0.0
    # Whether the controller remembers past samples. If not, the batch size may always change.
    _remembers = True

    def __post_init__(self) -> None:
        """Check the arguments and reset. Subclasses add what `reset` does not need."""
        for name, annotation in _validated_fields(type(self)).items():
            setattr(self, name, check(name, getattr(self, name), annotation))
        if self.u_min >= self.u_max:
            raise ValueError(f"u_min must be below u_max = {self.u_max!r}, got {self.u_min!r}")
        self.reset()

    def reset(self) -> None:
        """Forget the episode, but keep what was learnt."""
        self.command = np.float64(0.0)
        # Shape of the loops since `reset`, () or (batch,); None before the first sample.
        self._loops_before: tuple[int, ...] | None = None

    def check_environment(self, parameters: Any, wrapped: str, n: int) -> None:
        """Refuse plants that the controller was not made for, as their scores would be wrong.

        Parameters
        ----------
        parameters
            The arguments of the plants, as attributes with the names of `mptc_gym.Parameters`;
            arrays if they differ between plants.
        wrapped
            The names of wrappers that change observations or actions; "" without any.
        n
            Number of plants.

        Raises
        ------
        ValueError
            If limits, places in the observation, wrappers or the number of loops do not fit.
        """
        # Where limits are drawn, the controller has the widest.
        limits = float(np.min(parameters.u_min)), float(np.max(parameters.u_max))
        if limits != (self.u_min, self.u_max):
            raise ValueError(
                f"policy must be made with the limits of env, u_min={limits[0]}, "
                f"u_max={limits[1]}, got {self.u_min}, {self.u_max}"
            )
        place = 0  # of the signal's newest sample in the observation
        for signal in ("setpoint", "error"):
            window = getattr(parameters, f"{signal}_window")
            # None if the controller does not read this element alone.
            index = getattr(self, f"{signal}_index", None)
            if index is not None and (index != place or not window):
                raise ValueError(
                    f"env must show its newest {signal} as element {index} of the observation, "
                    f"where policy reads it, got setpoint_window={parameters.setpoint_window}, "
                    f"error_window={parameters.error_window}"
                )
            place += window
        if wrapped:
            raise ValueError(
                f"env must not be wrapped, as policy commands the flow itself, got {wrapped}"
            )

    def act(self, observation: ArrayLike) -> NDArray[np.float32]:
        """Return the action for an observation.

        Parameters
        ----------
        observation
            Shape (n_obs,), or (batch, n_obs) with one row per loop. Elements beyond those
            that the controller reads are ignored.

        Returns
        -------
        ndarray of float32
            The normalised action, shape (1,) or (batch, 1), with the dtype of the action space.
            It lies outside [-1, 1] where the command exceeds the actuator's limits.

        Raises
        ------
        ValueError
            If the observation has the wrong shape, a value that is not finite, or a batch size
            that differs from the one since `reset`. The controller is then unchanged.
        """
        values = check_numbers("observation", observation)
        if values.ndim not in (1, 2) or values.shape[-1] < self.n_obs or not len(values):
            raise ValueError(
                f"observation must have shape (n_obs,) or (batch, n_obs), n_obs at least "
                f"{self.n_obs}, got {values.shape}"
            )
        if not np.isfinite(values).all():
            raise ValueError(f"observation must be finite, got {observation!r}")
        loops = values.shape[:-1]
        if self._loops_before not in (None, loops):
            raise ValueError(
                f"observation must have shape {(*self._loops_before, self.n_obs)}, that of the "
                f"loops since reset or of num_envs, got {values.shape}"
            )
        commands = self._control(np.atleast_2d(values))
        self.command = commands if loops else commands[0]
        if self._remembers:
            self._loops_before = loops
        return float32_action(self.command, self.u_min, self.u_max, self._edge)[..., np.newaxis]

    @abstractmethod
    def _control(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return u, t/h, shape (loops,), for checked observations, shape (loops, size)."""


@dataclass(eq=False, kw_only=True)
class ModelBasedController(Controller):
    """A controller that knows the results of a step test and the actuator's numbers.

    The limits are those of `Controller`.

    Parameters
    ----------
    gain
        Steady-state gain of the plant, degC per t/h; positive or negative.
    time_constant
        Time constant of the plant, s.
    delay
        Delay of the plant, s, including the one sample that any input takes to show.
    dead_zone
        Half width of the actuator's dead zone, t/h; 0 if unknown. Commands inside it reach the
        plant as 0; those on its edge have an effect.
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
        self._delay_samples = self.delay / self.sampling_interval
        if self._delay_samples > MOST:
            raise ValueError(
                f"delay must be at most {MOST:,} times sampling_interval = "
                f"{self.sampling_interval!r}, got {self.delay!r}"
            )
