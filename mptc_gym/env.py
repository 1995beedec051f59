"""Simulate one plant, its set point and its transmitter: the environment `MiddlePoint-v0`."""

from __future__ import annotations

import inspect
import math
from copy import copy
from typing import Any, ClassVar, cast

import gymnasium
import numpy as np
from gymnasium import logger
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box, Space
from numpy.typing import NDArray

from mptc_gym.environments.record import Record
from mptc_gym.plant.checks import NOT_A_NUMBER, one_action, one_of, to_python
from mptc_gym.plant.dynamics import Plant, action_from_command
from mptc_gym.plant.parameters import Parameters, full_signature, insert_table
from mptc_gym.plant.sampling import PlantSampler, RandomStreams, plant_numbers
from mptc_gym.plant.signals import ONLY_PLANT, Signals

INFO = ("output", "setpoint", "error", "command", "applied", "noise")  # keys of every info
_FLOAT32 = np.dtype(np.float32)  # np.fromiter takes a dtype faster than the type np.float32
NO_RENDER_MODE = (  # a warning of `render`
    "render does nothing without a render mode: make the environment with a render mode, as in "
    'gymnasium.make("MiddlePoint-v0", render_mode="rgb_array")'
)
Frame = NDArray[np.uint8]  # a picture, shape (540, 960, 3)
Observation = NDArray[np.float32]
Action = NDArray[np.float32]


def observation_space(parameters: Parameters) -> Space[Observation]:
    """Return the space of an observation, a float32 `Box` of shape (size,).

    The bounds depend on the set point only if the set point exceeds the transmitter's range, so
    that a policy that was trained on one set point can run on another set point.
    """
    span = parameters.temperature_span
    setpoints = parameters.setpoint
    if isinstance(setpoints, str):
        setpoints = parameters.setpoint_amplitude
    setpoint_limit = max(span, np.abs(setpoints).max())
    # The largest magnitude of a set point, of an error, of an output and of an action.
    limits = np.array([setpoint_limit, setpoint_limit + span, span, 1.0], np.float32)
    high = np.repeat(limits, parameters.windows)
    return Box(-high, high, dtype=np.float32)


class HasJsonSpec:
    """An environment whose specification (`EnvSpec`) can be written as JSON.

    JSON has no NumPy arrays and numbers: the specification holds lists and Python numbers.
    """

    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """The `EnvSpec` from which `gymnasium.make` can make an environment like this one."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        """Store a copy of an `EnvSpec`, with lists and Python numbers in place of NumPy's."""
        if spec is not None:
            spec = copy(spec)
            spec.kwargs = {name: to_python(value) for name, value in spec.kwargs.items()}
        self._spec = spec


class MiddlePointEnv(HasJsonSpec, gymnasium.Env[Observation, Action]):
    """Control the temperature at the middle point of a once-through boiler by feedwater flow.

    At the middle point of a once-through boiler, water becomes steam. More feedwater lowers the
    temperature there, but only after a transport delay of 18 samples of 8 s; the actuator has a
    dead zone and saturates; noise disturbs the temperature. The plant is that of X. Cui and
    K. G. Shin, "Application of neural networks to temperature control in thermal power plants"
    (1992), here called the paper; numbers in parentheses, such as (28), are equations of this
    paper. All temperatures and flows are deviations from the operating point.
    `MiddlePointVectorEnv` runs many such plants at once.

    ## Plant

    ::

        (28)  y(k) = 0.45181 y(k-1) + 0.47546 y(k-2)
                     - 0.04560 u_a(k-d-1) - 0.00404 u_a(k-d-2) + n(k),       d = 18
              n(k) = xi(k) - 0.35740 xi(k-1) - 0.03392 xi(k-2),              xi ~ N(0, R)
        (29)  u_a = 0 where |u| < dead_zone, otherwise u limited to [u_min, u_max]

    y is the temperature (degC), y_d the set point of the temperature, e = y_d - y the error, u
    the commanded and u_a the applied feedwater flow (t/h), n the noise (degC), xi the white
    noise that causes n, and d the delay (samples). Call k of `step` (k = 0, 1, ...) applies the
    flow u(k), moves the plant from sample k to k+1, and returns the observation at k+1 and the
    reward of the error e(k+1). With d = 18, the flow u(0) first shows in y(19). Equation
    (28) is also written as A(z^-1) y(k) = B(z^-1) u_a(k-d) + C(z^-1) xi(k), with polynomials A,
    B and C.

    Section 1 of the paper names further difficulties of a boiler that equation (28) does not
    include. The following difficulties are off by default, and on in some of the argument sets
    in `mptc_gym.PRESETS`:

    - Measurement noise: from k = 1 on, the observation shows the reading y + v in place of the
      temperature y, with white noise v ~ N(0, measurement_noise_variance). The reward and
      `info["output"]` use the true temperature y.
    - A load disturbance w (degC), as when the feedwater's temperature, the coal or the fire's
      position changes: A(1) w(k) is added to the right side of equation (28), so that a
      constant load w adds w to the temperature in the steady state. The load starts at 0 and
      changes every 10 samples. The load is the sum of two parts: a random walk that gains a
      variance of `disturbance_walk_variance` per sample, and steps at random times, every
      `disturbance_interval` samples on average, to random levels uniform within
      +-`disturbance_amplitude`.
    - Other dynamics: `gain_factor` times the steady-state gain, `time_constant_factor` times
      the dominant time constant. With p = 0.9515 the slowest pole of equation (28), the
      polynomial A is (1 - p z^-1) Q(z^-1), and the time constant is 1 / (1 - p) = 20.6 samples.
      To multiply the time constant by t and the gain by g, the slowest pole p moves so that
      1 - p is divided by t, and the polynomial B is multiplied by g / t; the polynomial Q stays.
    - Fouling: in `drift_samples` samples, gain and time constant drift linearly to `gain_drift`
      and `time_constant_drift` times the gain and the time constant at k = 0. The drifting
      values change every 10 samples.

    ## Action space

    `Box(-1, 1, (1,), float32)`: an action a commands the flow
    u = u_min + (a + 1) / 2 * (u_max - u_min), in t/h.

    | Index | Action | at -1 | at 1 | Unit |
    |---|---|---|---|---|
    | 0 | feedwater flow u | u_min = -10 | u_max = 10 | t/h |

    An action below -1 or above 1 commands a flow outside the range from `u_min` to `u_max`,
    which the actuator limits to this range.

    ## Observation space

    The observation is a 1-D float32 array that joins four blocks, each with the newest sample
    first. In this table, y is the transmitter's reading of the temperature, which saturates at
    +-`temperature_span`, and e is y_d minus this reading.

    | Block | Elements (default) | Bounds (default) | Unit |
    |---|---|---|---|
    | set points y_d(k), y_d(k-1), ... | `setpoint_window` (3) | +-50 | degC |
    | errors e(k), e(k-1), ... | `error_window` (3) | +-100 | degC |
    | outputs y(k), y(k-1), ... | `output_window` (0) | +-50 | degC |
    | actions a(k-1), a(k-2), ... | `action_window` (0) | +-1 | 1 |

    The default observation is the six inputs of the paper's neural network. Past actions are
    clipped to +-1, as the actuator limits the commands of actions beyond +-1. With
    `action_window=delay+2`, the problem without noise is a Markov decision process as long as
    the set point stays constant. If the set point can exceed the transmitter's range, the
    bounds of set points and errors widen to include the set point.

    ## Reward

    | `reward` | reward of the step to k+1 |
    |---|---|
    | "quadratic" | -(e(k+1) / error_scale)^2 / 2 - move_weight * abs(a(k) - a(k-1)) |
    | "absolute" | -abs(e(k+1)) / error_scale - move_weight * abs(a(k) - a(k-1)) |

    The reward "quadratic" is the negative of the cost in equation (12) of the paper, for the
    error divided by `error_scale`.
    The best possible reward of a step is 0. With the default set point, a plant whose feedwater
    flow stays 0 earns -0.5 per step. The reward has no lower bound, since e is the error of the
    true temperature, which the transmitter's range does not limit.

    ## Starting state

    Before sample k = 0, the plant has been at rest: temperature y, set point y_d, error e,
    flows u and u_a, and white noise xi are all 0, so that y(0) = 0. All random numbers come
    from the seed, in separate streams, so that every controller meets the same noise, set
    point, load and plant. The j-th episode after a seed does not depend on the length of
    earlier episodes. `reset` has no options.

    ## Episode end

    No episode terminates. `gymnasium.make` truncates an episode after 1200 steps.

    ## Arguments

    All arguments are keyword-only and can be given to `gymnasium.make`. An asterisk marks an
    argument that can be a range [low, high], from which each `reset` samples a number uniformly
    (an integer where the default is an integer).

    <arguments>

    `render_mode` is None, "human" or "rgb_array"; see Rendering. In place of lists, arguments
    may be tuples or NumPy arrays. Numbers must be within +-1e9, the delay and each window may
    have at most 10,000 samples, and `a`, `b` and `c` at most 1,000 coefficients each.

    ## Info

    `reset` and `step` return a new dict of floats: `output` (the true y, degC), `setpoint`
    (y_d, degC), `error` (y_d - y, degC), `command` (u, t/h), `applied` (u_a, t/h) and `noise`
    (n, degC). The step from sample k to k+1 returns the flows u(k) and u_a(k), and y(k+1),
    y_d(k+1), e(k+1) and n(k+1). At reset, `command`, `applied` and `noise` are 0.

    With a load disturbance, the info also holds `disturbance` (w, degC). With a drift, the info
    also holds the present `gain_factor` and `time_constant_factor`. The info of `reset` also
    holds the number that was sampled for each argument that is a range, under the argument's
    name; a delay is an int.

    ## Rendering

    | `render_mode` | `render` |
    |---|---|
    | "rgb_array" | returns a picture, shape (540, 960, 3), uint8 |
    | "human" | shows the picture in a window; `reset` and `step` call `render`, at most `metadata["render_fps"]` times a second |

    A picture shows the latest 200 samples, or more if the delay is long. The upper panel shows
    set point and true temperature. The lower panel shows commanded and applied flow, the dead
    zone, the limits, and the time in which the flow is still in transit to the middle point.
    Pictures need pygame: `pip install "mptc_gym[render]"`. Gymnasium's `RecordVideo` also needs
    moviepy.

    ## Errors

    For an invalid argument or `render_mode`, the constructor raises a `ValueError` that names
    the argument. For an unknown argument, the constructor raises a `TypeError`. If an action is
    not one finite number, `step` raises a `ValueError` and leaves the plant unchanged. Without
    pygame, the first call of `render` raises `DependencyNotInstalled`.

    ## Version history

    * v0: first version.
    """  # noqa: E501 (the tables)

    metadata: dict[str, Any] = {  # noqa: RUF012 (as in gymnasium.Env)
        "render_modes": ["human", "rgb_array"],
        "render_fps": 30,
    }

    def __init__(self, *, render_mode: str | None = None, **arguments: Any) -> None:
        parameters = Parameters.of_environment(arguments)
        one_of("render_mode", render_mode, [None, *self.metadata["render_modes"]])
        self.parameters = parameters
        self.render_mode = render_mode
        self._record: Record | None = None  # samples for pictures; None without a render mode
        self.action_space = Box(-1.0, 1.0, (1,), np.float32)
        self.observation_space = observation_space(parameters)
        # `step` unpacks two tuples, which is faster than reading as many attributes.
        is_quadratic = parameters.reward == "quadratic"
        self._reward_terms = parameters.error_scale, is_quadratic, parameters.move_weight
        # The indices at which errors, outputs and actions begin in the observation, and the
        # number of elements of the observation.
        self._layout = tuple(np.cumsum(parameters.windows).tolist())
        self._has_more_info = parameters.is_disturbed or parameters.drifts
        self._plant_sampler = PlantSampler(parameters)
        self._signals = Signals.of(parameters)
        # Random number streams of the only plant; empty before the first reset.
        self._streams: list[RandomStreams] = []
        self._root: np.random.Generator | None = None  # whose seed the streams come from
        # Set point y_d, noise n, load w and measurement noise, degC, of the samples to come,
        # the next sample last.
        self._coming_signals: list[tuple[float, ...]] = []

    # Only `Parameters` lists all arguments, so help() and editors need this signature.
    __signature__: ClassVar[inspect.Signature] = full_signature(__init__)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, float]]:
        """Bring the plant to rest and start an episode.

        Parameters
        ----------
        seed
            Seed from which the environment's random number streams restart. Without a seed, the
            streams move to their next episode.
        options
            Not used.

        Returns
        -------
        observation : ndarray of float32
            The observation at sample k = 0, shape (size,), laid out as in the class docstring.
        info : dict of float
            The info at sample k = 0, and the numbers that were sampled for ranges.
        """
        super().reset(seed=seed)
        if self._root is not self.np_random:  # at the first reset, or after a new seed
            self._root = self.np_random
            seeds = cast("np.random.SeedSequence", self._root.bit_generator.seed_seq)
            self._streams = [RandomStreams.spawn(seeds)]
        arrays_of_numbers = self._plant_sampler.sample(self._streams)
        setpoint = self._signals.reset(ONLY_PLANT, self._streams, arrays_of_numbers).item()
        numbers = plant_numbers(arrays_of_numbers, 0)
        self._plant = Plant(self.parameters, numbers)
        self._coming_signals.clear()

        # At rest, the commanded flow is 0 t/h. The action for 0 t/h depends on the limits.
        self._action = action_from_command(0.0, numbers.u_min, numbers.u_max)
        rest_action = _clip(self._action, 1.0)
        error_index, output_index, action_index, size = self._layout
        # `step` writes to one more element after the end of the observation.
        self._window = [0.0] * action_index + [rest_action] * (size - action_index + 1)
        # A block of size 0 begins where the next block does, whose element is written later.
        self._window[0] = setpoint
        self._window[error_index] = setpoint
        self._window[output_index] = 0.0
        self._window[action_index] = rest_action
        if self.render_mode is not None:
            self._record = Record(numbers, self.parameters.sampling_interval, setpoint)
        if self.render_mode == "human":
            self.render()
        info = dict.fromkeys(INFO, 0.0)
        info["setpoint"] = setpoint
        info["error"] = setpoint
        if self.parameters.is_disturbed:
            info["disturbance"] = 0.0
        info |= self._plant.factors
        info |= numbers.select(self.parameters.ranges)
        return np.fromiter(self._window, _FLOAT32, size), info

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, dict[str, float]]:
        """Move the plant by one sample, with a normalised action.

        Parameters
        ----------
        action
            The action a(k), shape (1,): -1 commands the flow `u_min`, and 1 commands `u_max`.

        Returns
        -------
        observation : ndarray of float32
            The observation at sample k+1, shape (size,).
        reward : float
            The reward of the error e(k+1).
        terminated, truncated : bool
            Always False: `gymnasium.make` adds the time limit.
        info : dict of float
            The info at sample k+1.

        Raises
        ------
        ValueError
            If the action is not one finite number. The error leaves the plant unchanged.
        ResetNeeded
            If `step` is called before the first `reset`.
        """
        # The speed of the environment depends on this method, so it avoids function calls.
        try:
            a = float(action.item() - 0.0)  # subtracting 0.0 fails for text such as "0.3"
        except NOT_A_NUMBER:
            a = one_action(action)
        observed_action = a
        if not -1.0 <= a <= 1.0:
            observed_action = _clip(a, 1.0)
            if not math.isfinite(a):
                one_action(a)  # raises a ValueError, as the action is not finite
        if not self._coming_signals:
            if not self._streams:
                raise ResetNeeded("call reset before step")
            self._coming_signals = self._signals.ahead()[::-1]
        setpoint, noise, load, measurement_noise = self._coming_signals.pop()

        command, applied, output = self._plant.step(a, noise, load)
        error = setpoint - output
        error_scale, is_quadratic, move_weight = self._reward_terms
        scaled_error = error / error_scale
        # The paper's cost, equation (12), negated, or the magnitude of the error, negated.
        reward = scaled_error * scaled_error * -0.5 if is_quadratic else -abs(scaled_error)
        if move_weight:
            reward -= move_weight * abs(a - self._action)
        self._action = a

        reading = output + measurement_noise
        span = self.parameters.temperature_span
        if not -span <= reading <= span:
            reading = _clip(reading, span)
        # One insertion shifts all blocks of the observation by one element. The oldest element
        # of a block then has the first index of the next block, whose new sample replaces it.
        # A block of size 0 begins where the next block does, whose element is written later; an
        # empty last block begins at the additional element at the end of the list.
        error_index, output_index, action_index, size = self._layout
        window = self._window
        window.insert(0, setpoint)
        window.pop()
        window[error_index] = setpoint - reading
        window[output_index] = reading
        window[action_index] = observed_action
        observation = np.fromiter(window, _FLOAT32, size)  # faster than np.array
        info = {
            "output": output,
            "setpoint": setpoint,
            "error": error,
            "command": command,
            "applied": applied,
            "noise": noise,
        }
        if self._has_more_info:
            if self.parameters.is_disturbed:
                info["disturbance"] = load
            info |= self._plant.factors
        if self._record is not None:
            self._record.add(setpoint, output, command, applied)
            if self.render_mode == "human":
                self.render()
        return observation, reward, False, False, info

    def render(self) -> Frame | None:
        """Return a picture of the latest samples of the episode, or show it in a window.

        Returns
        -------
        ndarray of uint8 or None
            With the render mode "rgb_array", a picture, shape (540, 960, 3). With "human",
            None: the picture is shown in a window. Without a render mode, None, after a
            warning.

        Raises
        ------
        ResetNeeded
            If `render` is called before the first `reset`.
        DependencyNotInstalled
            If pygame is not installed.
        """
        if self.render_mode is None:
            logger.warn(NO_RENDER_MODE)
            return None
        if self._record is None:
            raise ResetNeeded("call reset before render")
        from mptc_gym.environments import drawing  # which needs pygame

        if self.render_mode == "rgb_array":
            return drawing.frame(self._record)
        drawing.show(self._record, self.metadata["render_fps"], self)
        return None

    def close(self) -> None:
        """Close the window, unless another environment still shows pictures in the window."""
        if self.render_mode == "human" and self._record is not None:
            from mptc_gym.environments import drawing  # which needs pygame

            drawing.hide(self)
        self._record = None


MiddlePointEnv.__doc__ = insert_table(MiddlePointEnv.__doc__)


def _clip(value: float, limit: float) -> float:
    """Return a value clipped to +-`limit`; NaN becomes the upper limit."""
    return max(-limit, min(limit, value))
