"""Define the base classes of all controllers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mptc_gym.plant.actuator import float32_action
from mptc_gym.plant.checks import nonzero, not_negative, number, positive, reject
from mptc_gym.plant.parameters import Parameters

Values = NDArray[np.float64] | np.float64  # one value per loop: shape () or (batch,)


@dataclass(eq=False, kw_only=True)
class Controller(ABC):
    """A controller of one control loop, or of a batch of independent control loops.

    Every controller is a dataclass whose fields are the constructor arguments.

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

    u_min: float = -10.0
    u_max: float = 10.0
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
        """Check the flow limits, and call `reset`.

        A subclass must call `super().__post_init__()` first, and then check its own arguments.
        This call runs `reset`, so `reset` must not use attributes that a subclass sets after
        the call.
        """
        self._check(number, "u_min", "u_max")
        if self.u_min >= self.u_max:
            reject("u_min", self.u_min, f"below u_max = {self.u_max!r}")
        self.reset()

    def _check(self, check: Callable[[str, Any], Any], *names: str) -> None:
        """Replace the arguments `names` by what `check`, such as `positive`, returns."""
        for name in names:
            setattr(self, name, check(name, getattr(self, name)))

    def reset(self) -> None:
        """Forget past samples before a new episode, but keep learnt network weights."""
        self.command = np.float64(0.0)
        # Shape that commands must have until the next `reset`: () for one loop, (batch,) for a
        # batch of loops, and None while both are allowed.
        self._loop_shape: tuple[int, ...] | None = None

    def check_environment(self, parameters: Parameters, n: int) -> None:
        """Raise a ValueError if the controller does not fit the plants of an environment.

        `mptc_gym.evaluate` calls this method before an evaluation, so that a wrong limit or
        observation does not give a wrong score.

        Parameters
        ----------
        parameters
            Arguments of the environment. An argument that is sampled at each reset is a range
            (low, high).
        n
            Number of plants.

        Raises
        ------
        ValueError
            If the controller does not fit the action form, the flow limits, the observations or
            the number of the plants.
        """
        # A `PolicyNetwork` has the form of its actions as an argument; all other controllers
        # set flows.
        action_form = getattr(self, "action", "flow")
        if parameters.action != action_form:
            raise ValueError(
                f"env must have action={action_form!r}, because policy returns such actions, "
                f"got {parameters.action!r}"
            )
        if (parameters.u_min, parameters.u_max) != (self.u_min, self.u_max):
            raise ValueError(
                f"policy must have the flow limits of env, u_min={parameters.u_min}, "
                f"u_max={parameters.u_max}, got {self.u_min}, {self.u_max}"
            )
        # An observation begins with the windows of set points and errors, each newest first.
        # A `PolicyNetwork` has no such index, and checks all windows itself.
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

    def act(self, observation: ArrayLike) -> NDArray[np.float32]:
        """Return the action for an observation; call this method once per sample.

        Parameters
        ----------
        observation
            Observation of shape (n_obs,) for one loop, or (batch, n_obs) for a batch of loops.
            Elements that the controller does not need must be finite, but have no effect. A
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
            If `observation` has a wrong shape, a value that is not finite, or, for a controller
            that remembers past samples, another batch size than earlier observations since
            `reset`. A ValueError leaves the controller unchanged.
        """
        values = np.asarray(observation, np.float64)
        if values.ndim not in (1, 2) or values.shape[-1] < self.n_obs or not len(values):
            raise ValueError(
                f"observation must have shape (size,) or (batch, size), with a size of at "
                f"least {self.n_obs} and a batch of at least 1, got {values.shape}"
            )
        if not np.isfinite(values).all():
            raise ValueError(f"observation must be finite, got {observation!r}")
        loop_shape = values.shape[:-1]
        if self._loop_shape not in (None, loop_shape):
            raise ValueError(
                f"observation must have shape {(*self._loop_shape, self.n_obs)}, or a longer "
                f"last axis, as the number of loops must not change before a reset, got "
                f"{values.shape}"
            )
        # `_control` takes a batch, of one loop if need be, and updates the controller's memory.
        commands = self._control(np.atleast_2d(values))
        is_batch = loop_shape != ()
        self.command = commands if is_batch else commands[0]
        if self._remembers:
            self._loop_shape = loop_shape
        return self._action(self.command)[..., np.newaxis]  # one element for each loop

    def _action(self, command: Values) -> NDArray[np.float32]:
        """Return the actions that command the flows `command`, t/h, in the same shape."""
        return float32_action(command, self.u_min, self.u_max, self._edge)

    @abstractmethod
    def _control(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the commands u(k), t/h, shape (loops,), and update the controller's memory.

        `rows` are the observations of all loops at one sample, float64, shape (loops,
        elements).
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

    gain: float
    time_constant: float
    delay: float
    dead_zone: float = 0.0
    sampling_interval: float = 8.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check(nonzero, "gain")
        self._check(positive, "time_constant", "sampling_interval")
        self._check(not_negative, "delay", "dead_zone")
        self._edge = self.dead_zone  # for `_action`, as commands may be on the edge

    def check_environment(self, parameters: Parameters, n: int) -> None:
        """Raise a ValueError if the controller does not fit the plants of an environment.

        The arguments are described in `Controller.check_environment`. In addition to the checks
        of `Controller`, the environment must have the sampling interval of the controller.
        """
        super().check_environment(parameters, n)
        if parameters.sampling_interval != self.sampling_interval:
            raise ValueError(
                f"policy must have the sampling_interval of env, "
                f"{parameters.sampling_interval} s, got {self.sampling_interval} s"
            )
