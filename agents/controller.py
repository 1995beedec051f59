"""Define the base classes of all controllers, and check their arguments."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
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


def check_count(name: str, value: Any, least: int, most: int | None = None) -> int:
    """Return `value` if it is an integer within bounds; otherwise raise a ValueError."""
    counts = isinstance(value, Integral) and not isinstance(value, bool)
    if counts and value >= least and (most is None or int(value) <= most):
        return int(value)
    bound = f"of at least {least}" if most is None else f"from {least} to {most:,}"
    raise ValueError(f"{name} must be an integer {bound}, got {value!r}")


def check_number(
    name: str, value: Any, least: float = -math.inf, above: float = -math.inf
) -> float:
    """Return `value` if it is a finite number within bounds; otherwise raise a ValueError."""
    number = isinstance(value, Real) and not isinstance(value, bool)
    if number and value >= least and value > above and math.isfinite(value):
        return float(value)
    bound = "" if least == -math.inf else f" of at least {least:g}"
    bound += "" if above == -math.inf else f" above {above:g}"
    raise ValueError(f"{name} must be a finite number{bound}, got {value!r}")


def check_gain(name: str, value: Any) -> float:
    """Return `value` if it is a finite number other than 0; otherwise raise a ValueError."""
    if check_number(name, value) == 0.0:
        raise ValueError(f"{name} must not be 0, got {value!r}")
    return float(value)


def check_flag(name: str, value: Any) -> bool:
    """Return `value` if it is True or False; otherwise raise a ValueError."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} must be True or False, got {value!r}")
    return bool(value)


def check_numbers(name: str, value: ArrayLike) -> NDArray[np.float64]:
    """Return `value` as float64 if it holds real numbers; otherwise raise a ValueError."""
    try:
        given = np.asarray(value)
        if given.dtype.kind in "biufO":  # neither text, which NumPy would parse, nor complex
            return given.astype(np.float64, copy=False)
    except (TypeError, ValueError, OverflowError, RuntimeError):  # the last from tensors
        pass
    raise ValueError(f"{name} must be numbers, got {value!r}")


def check_limits(u_min: Any, u_max: Any) -> None:
    """Raise a ValueError unless the limits are finite and in order."""
    low, high = check_number("u_min", u_min), check_number("u_max", u_max)
    if low >= high:
        raise ValueError(f"u_min must be below u_max = {u_max!r}, got {u_min!r}")


# Types of controller arguments, each with its check.
Number = Annotated[float, check_number]
NotNegative = Annotated[float, partial(check_number, least=0.0)]
Positive = Annotated[float, partial(check_number, above=0.0)]
Gain = Annotated[float, check_gain]
Flag = Annotated[bool, check_flag]
Index = Annotated[int, partial(check_count, least=0)]
Count = Annotated[int, partial(check_count, least=1)]
Size = Annotated[int, partial(check_count, least=1, most=MOST)]


@cache
def _checks(controller: type[Controller]) -> dict[str, Callable[[str, Any], Any]]:
    """Return the checks in the types of a controller's arguments, by argument."""
    hints = get_type_hints(controller, include_extras=True).items()
    return {name: hint.__metadata__[0] for name, hint in hints if hasattr(hint, "__metadata__")}


@dataclass(eq=False, kw_only=True)
class Controller(ABC):
    """A controller of one loop, or of a batch of independent loops.

    Controllers are dataclasses: their fields are the arguments of the constructor, and types
    such as `Positive` state which values are allowed.

    Parameters
    ----------
    u_min
        Lower limit of the actuator, t/h.
    u_max
        Upper limit of the actuator, t/h. Limits scale the action; they do not clip commands.

    Attributes
    ----------
    n_obs : int
        The minimum number of elements in an observation.
    command : float64 or ndarray of float64
        The last command u, before the actuator, t/h: a scalar after `act` on one observation,
        an array of shape (batch,) after `act` on a batch.

    Raises
    ------
    ValueError
        If an argument is out of range; the message names it.
    """

    u_min: Number = -10.0
    u_max: Number = 10.0
    n_obs: int = field(init=False, repr=False)
    command: Values = field(init=False, repr=False)

    _remembers = True  # past samples; if not, the batch size may change at any time
    _edge = 0.0  # of the dead zone, t/h; a command on it keeps its effect as an action

    def __post_init__(self) -> None:
        for name, check in _checks(type(self)).items():
            setattr(self, name, check(name, getattr(self, name)))
        check_limits(self.u_min, self.u_max)
        self.command = np.float64(0.0)
        self._loops_before: tuple[int, ...] | None = None  # since `reset`, () or (batch,)

    def reset(self) -> None:
        """Forget the episode, but keep what was learnt."""
        self.command = np.float64(0.0)
        self._loops_before = None

    def check_environment(self, parameters: Any, wrapped: str, n: int) -> None:
        """Refuse plants that the controller was not made for: scores would be wrong in silence.

        Parameters
        ----------
        parameters
            The plants' arguments, by name as in `mptc_gym.Parameters`.
        wrapped
            Names of wrappers that change observations or actions; empty if there are none.
        n
            Number of plants.

        Raises
        ------
        ValueError
            If limits, places in the observation or the number of loops differ, or if the plants
            are wrapped.
        """
        # Where limits are drawn, the controller has the widest.
        limits = float(np.min(parameters.u_min)), float(np.max(parameters.u_max))
        if limits != (self.u_min, self.u_max):
            raise ValueError(
                f"policy must be made with the limits of env, u_min={limits[0]}, "
                f"u_max={limits[1]}, got {self.u_min}, {self.u_max}"
            )
        shown = {
            "setpoint": (0, parameters.setpoint_window),
            "error": (parameters.setpoint_window, parameters.error_window),
        }
        for signal, (place, window) in shown.items():
            index = getattr(self, f"{signal}_index", None)  # None where it is not read alone
            if index is not None and (index != place or not window):
                raise ValueError(
                    f"env must show its newest {signal} as element {index} of the observation, "
                    f"where policy reads it, got setpoint_window={parameters.setpoint_window}, "
                    f"error_window={parameters.error_window}"
                )
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
                f"observation must have shape {(*before, self.n_obs)}, as those before it, "
                f"until reset; got {values.shape}"
            )
        self.command = self._control(values)
        if self._remembers:
            self._loops_before = now
        return float32_action(self.command, self.u_min, self.u_max, self._edge)[..., np.newaxis]

    @abstractmethod
    def _control(self, observation: NDArray[np.float64]) -> Values:
        """Return u, t/h, for a checked observation."""


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
