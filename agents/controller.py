"""Define the base classes of all controllers, and check their arguments."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import cache, partial
from numbers import Integral, Real
from typing import Annotated, Any, Final, get_type_hints

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.actuator import float32_action

PAPER_WINDOWS: Final = {"setpoint_window": 3, "error_window": 3}  # the paper's six inputs
Values = NDArray[np.float64] | np.float64  # one value per loop: shape () or (batch,)
MOST = 1_000_000  # nodes, loops, elements or samples; a larger number is a mistake

# Types of arguments, each with what is allowed, in words and as a condition.
Number = Annotated[float, "a finite number", math.isfinite]
NotNegative = Annotated[float, "a finite number of at least 0", lambda x: 0.0 <= x < math.inf]
Positive = Annotated[float, "a finite number above 0", lambda x: 0.0 < x < math.inf]
Gain = Annotated[float, "a finite number other than 0", lambda x: 0.0 < abs(x) < math.inf]
Flag = Annotated[bool, "True or False", lambda x: True]
Index = Annotated[int, "an integer of at least 0", lambda x: x >= 0]
Count = Annotated[int, "an integer of at least 1", lambda x: x >= 1]
Size = Annotated[int, f"an integer from 1 to {MOST:,}", lambda x: 1 <= x <= MOST]


def check(name: str, value: Any, of: Any) -> Any:
    """Return `value` if it is of a type such as `Positive`; otherwise raise a ValueError."""
    plain, (allowed, holds) = of.__origin__, of.__metadata__
    fits = isinstance(value, bool | np.bool_)
    if plain is not bool:
        fits = not fits and isinstance(value, Integral if plain is int else Real)
    if fits and holds(value):
        return plain(value)
    raise ValueError(f"{name} must be {allowed}, got {value!r}")


def check_numbers(name: str, value: ArrayLike) -> NDArray[np.float64]:
    """Return `value` as float64 if it holds real numbers; otherwise raise a ValueError."""
    try:
        given = np.asarray(value)
        if given.dtype.kind in "biufO":  # neither text, which NumPy would parse, nor complex
            return given.astype(np.float64, copy=False)
    except (TypeError, ValueError, OverflowError, RuntimeError):  # the last from tensors
        pass
    raise ValueError(f"{name} must be numbers, got {value!r}")


_types_of = cache(partial(get_type_hints, include_extras=True))  # which is slow


@dataclass(eq=False, kw_only=True)
class Controller(ABC):
    """A controller of one loop, or of a batch of independent loops.

    Controllers are dataclasses: their fields are the arguments of the constructor, and types
    such as `Positive` state which values are allowed.

    Parameters
    ----------
    u_min, u_max
        Limits of the actuator, t/h. They scale the action, and do not clip commands.

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

    _edge = 0.0  # of the dead zone, t/h; a command on it keeps its effect as an action
    _remembers = True  # past samples; if not, the batch size may change at any time

    def __post_init__(self) -> None:
        for name, of in _types_of(type(self)).items():
            if hasattr(of, "__metadata__"):
                setattr(self, name, check(name, getattr(self, name), of))
        if self.u_min >= self.u_max:
            raise ValueError(f"u_min must be below u_max = {self.u_max!r}, got {self.u_min!r}")
        self.reset()

    def reset(self) -> None:
        """Forget the episode, but keep what was learnt."""
        self.command = np.float64(0.0)
        self._loops_before: tuple[int, ...] | None = None  # since `reset`, () or (batch,)

    def check_environment(self, parameters: Any, wrapped: str, n: int) -> None:
        """Refuse plants that the controller was not made for: scores would be wrong in silence.

        `parameters` are the arguments of all `n` plants, by name as in `mptc_gym.Parameters`,
        and `wrapped` names wrappers that change observations or actions, if any. A ValueError
        says what does not fit: limits, places in the observation, number of loops, wrappers.
        """
        # Where limits are drawn, the controller has the widest.
        limits = float(np.min(parameters.u_min)), float(np.max(parameters.u_max))
        if limits != (self.u_min, self.u_max):
            raise ValueError(
                f"policy must be made with the limits of env, u_min={limits[0]}, "
                f"u_max={limits[1]}, got {self.u_min}, {self.u_max}"
            )
        place = 0  # of the newest sample of a signal
        for signal in ("setpoint", "error"):
            window = getattr(parameters, f"{signal}_window")
            index = getattr(self, f"{signal}_index", None)  # None where it is not read alone
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
        now, before = values.shape[:-1], self._loops_before
        if before not in (None, now):
            raise ValueError(
                f"observation must have shape {(*before, self.n_obs)}, that of the loops since "
                f"reset or of num_envs, got {values.shape}"
            )
        command = self._control(np.atleast_2d(values))
        self.command = command if len(now) else command[0]
        self._loops_before = now if self._remembers else None
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
