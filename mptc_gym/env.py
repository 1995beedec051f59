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

from mptc_gym.checks import one_action, one_of, plain
from mptc_gym.draws import Ranges, Streams, plant_numbers
from mptc_gym.parameters import Parameters, insert_table, spelt_out
from mptc_gym.plant import Plant, action_from_command
from mptc_gym.record import Record
from mptc_gym.signals import ONE, Signals

INFO = ("output", "setpoint", "error", "command", "applied", "noise")  # keys of every info
_FLOAT32 = np.dtype(np.float32)  # faster to pass than the type
NO_MODE = (
    "render does nothing without a render mode: make the environment with a render mode, as in "
    'gymnasium.make("MiddlePoint-v0", render_mode="rgb_array")'
)
Frame = NDArray[np.uint8]  # a picture, shape (540, 960, 3)
Observation = NDArray[np.float32]
Action = NDArray[np.float32]


def observation_space(parameters: Parameters) -> Space[Observation]:
    """Return the space of the observation, a `Box` of shape (size,), float32.

    The bounds depend on the set point only if the set point exceeds the transmitter's range, so
    that a policy trained on one set point can run on another.
    """
    span = parameters.temperature_span
    setpoint = parameters.setpoint
    if isinstance(setpoint, str):
        setpoint = parameters.setpoint_amplitude
    setpoint_limit = max(span, np.abs(setpoint).max())
    # The largest magnitude of a set point, of an error, of an output and of an action.
    limits = np.array([setpoint_limit, setpoint_limit + span, span, 1.0], np.float32)
    high = np.repeat(limits, parameters.windows)
    return Box(-high, high, dtype=np.float32)


class HasPlainSpec:
    """An environment whose spec can be written as JSON.

    The spec holds lists in place of arrays, and Python numbers in place of NumPy's.
    """

    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """The specification, from which `gymnasium.make` makes such an environment again."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None:
            spec = copy(spec)
            spec.kwargs = {name: plain(value) for name, value in spec.kwargs.items()}
        self._spec = spec


class MiddlePointEnv(HasPlainSpec, gymnasium.Env[Observation, Action]):
    """Control the temperature at the middle point of a once-through boiler by feedwater flow.

    At the middle point of a once-through boiler, water becomes steam. More feedwater lowers the
    temperature there, but only after a transport delay of 18 samples of 8 s; the actuator has a
    dead zone and saturates; noise disturbs the temperature. The plant is that of X. Cui and
    K. G. Shin, "Application of neural networks to temperature control in thermal power plants"
    (1992); numbers in parentheses are its equations. All quantities are deviations from the
    operating point. `MiddlePointVectorEnv` runs many of these plants at once.

    ## Plant

    ::

        (28)  y(k) = 0.45181 y(k-1) + 0.47546 y(k-2)
                     - 0.04560 u_a(k-d-1) - 0.00404 u_a(k-d-2) + n(k),       d = 18
              n(k) = xi(k) - 0.35740 xi(k-1) - 0.03392 xi(k-2),              xi ~ N(0, R)
        (29)  u_a = 0 where |u| < dead_zone, otherwise u limited to [u_min, u_max]

    y is the temperature (degC), y_d its set point, e = y_d - y the error, u the commanded and
    u_a the applied feedwater flow (t/h). Call k of `step` (k = 0, 1, ...) applies u(k), moves
    the plant from sample k to k+1 and returns the observation at k+1 and the reward of e(k+1).
    So u(0) first shows in y(19).

    Section 1 of the paper names further difficulties that (28) does not include. These
    difficulties are off by default; some of `mptc_gym.PRESETS` turn them on:

    - Measurement noise: from k = 1 on, the observation shows y + v with white noise
      v ~ N(0, measurement_noise_variance). The reward and `info["output"]` use the true y.
    - A load disturbance w, as when the feedwater's temperature, the coal or the fire's position
      changes: A(1) w(k) is added to (28), so that a constant w adds w to y in the steady state.
      The load starts at 0 and changes every 10 samples. The load is the sum of a random walk
      that gains a variance of `disturbance_walk_variance` per sample, and of steps to levels
      uniform within +-`disturbance_amplitude`, at random, every `disturbance_interval` samples
      on average.
    - Other dynamics: `gain_factor` times the steady-state gain, `time_constant_factor` times
      the dominant time constant. With p the slowest pole (0.9515), A = (1 - p z^-1) Q(z^-1),
      and the time constant is 1 / (1 - p) = 20.6 samples. For t times the time constant and g
      times the gain, 1 - p is divided by t, Q stays, and B is multiplied by g / t.
    - Fouling: in `drift_samples` samples, gain and time constant drift linearly to `gain_drift`
      and `time_constant_drift` times their values at k = 0. The drifting values change every 10
      samples.

    ## Action space

    `Box(-1, 1, (1,), float32)`: u = u_min + (a + 1) / 2 * (u_max - u_min).

    | Index | Action | at -1 | at 1 | Unit |
    |---|---|---|---|---|
    | 0 | feedwater flow u | u_min = -10 | u_max = 10 | t/h |

    An action outside the box is a command outside the range, which the actuator limits.

    ## Observation space

    The observation space is a 1-D float32 `Box` with the following blocks, each with the newest
    sample first. In the table, `y` is the transmitter's reading, which saturates at
    +-`temperature_span`.

    | Block | Elements (default) | Bounds (default) | Unit |
    |---|---|---|---|
    | set points y_d(k), y_d(k-1), ... | `setpoint_window` (3) | +-50 | degC |
    | errors e(k), e(k-1), ... | `error_window` (3) | +-100 | degC |
    | outputs y(k), y(k-1), ... | `output_window` (0) | +-50 | degC |
    | actions a(k-1), a(k-2), ... | `action_window` (0) | +-1 | 1 |

    The defaults give the six inputs of the paper's neural network. Past actions are clipped to
    +-1, as the actuator limits them. With `action_window=delay+2` the noise-free problem is
    Markov while the set point holds. If the set point can exceed the transmitter's range, the
    bounds of set points and errors widen to include the set point.

    ## Reward

    | `reward` | reward of the step to k+1 |
    |---|---|
    | "quadratic" | -(e(k+1) / error_scale)^2 / 2 - move_weight * abs(a(k) - a(k-1)) |
    | "absolute" | -abs(e(k+1)) / error_scale - move_weight * abs(a(k) - a(k-1)) |

    "quadratic" is the negative of the paper's cost (12), scaled. The best possible reward of a
    step is 0. With the default set point, a plant without input earns -0.5 per step. There is
    no lower bound, since e is the error of the true temperature, which the transmitter's range
    does not limit.

    ## Starting state

    Before k = 0 the plant has been at rest: y, y_d, e, u, u_a and xi are all 0, so y(0) = 0.
    All randomness comes from the seed, in separate streams, so that every controller meets the
    same noise, set point, disturbance and plant. The j-th episode after a seed does not depend
    on the length of earlier episodes. `reset` has no options.

    ## Episode end

    Nothing terminates an episode. `gymnasium.make` truncates an episode after 1200 steps.

    ## Arguments

    All arguments are keyword-only and can be given to `gymnasium.make`. An asterisk marks an
    argument that can also be a range [low, high], from which each `reset` draws a number
    uniformly (an integer where the default is an integer). The arguments are declared in
    `mptc_gym/parameters.py`.

    <arguments>

    `render_mode` is None, "human" or "rgb_array"; see Rendering. Lists may also be tuples or
    NumPy arrays. Numbers are within +-1e9, the delay and each window are at most 10,000
    samples, and `a`, `b` and `c` have at most 1,000 coefficients each.

    ## Info

    `reset` and `step` return a new dict of floats: `output` (the true y, degC), `setpoint`
    (y_d, degC), `error` (y_d - y, degC), `command` (u, t/h), `applied` (u_a, t/h) and `noise`
    (n, degC). After a step, `command` and `applied` belong to the step, and the other values
    belong to the sample to which the step leads. At reset, `command`, `applied` and `noise` are
    0.

    With a load disturbance, the dict also holds `disturbance` (w, degC), and with a drift, the
    present `gain_factor` and `time_constant_factor`. The dict of `reset` also holds each number
    that was drawn, under its name; a delay is an int.

    ## Rendering

    | `render_mode` | `render` |
    |---|---|
    | "rgb_array" | returns a picture, shape (540, 960, 3), uint8 |
    | "human" | shows the picture in a window, as do `reset` and `step`, at most `metadata["render_fps"]` times a second |

    A picture shows the last 200 samples, or more if the delay is long: set point and true
    temperature; commanded and applied flow, with the dead zone, the limits and the time in
    which the flow is still in transit to the middle point. Pictures need pygame:
    `pip install "mptc_gym[render]"`. Gymnasium's `RecordVideo` also needs moviepy.

    ## Errors

    For an invalid argument or `render_mode`, the constructor raises a `ValueError` that names
    the argument. For a misspelt argument, the constructor raises a `TypeError`. If an action is
    not one finite number, `step` raises a `ValueError` and leaves the plant unchanged. Without
    pygame, the first picture raises `DependencyNotInstalled`.

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
        self._record: Record | None = None  # for pictures; None without a render mode
        self.action_space = Box(-1.0, 1.0, (1,), np.float32)
        self.observation_space = observation_space(parameters)
        # `step` unpacks two tuples, which is faster than reading as many attributes.
        quadratic = parameters.reward == "quadratic"
        self._reward_terms = parameters.error_scale, quadratic, parameters.move_weight
        # The places where errors, outputs and actions begin in the observation, and the size of
        # the observation.
        places = np.cumsum(parameters.windows).tolist()
        self._layout = parameters.temperature_span, *places
        self._has_more_info = parameters.is_disturbed or parameters.drifts
        self._ranges = Ranges(parameters)
        self._signals = Signals.of(parameters)
        self._streams: list[Streams] = []  # of the only plant; empty before the first reset
        self._root: np.random.Generator | None = None  # from which the streams were spawned
        # y_d, n, w and the measurement noise of the samples to come, the next sample last.
        self._ahead: list[tuple[float, ...]] = []

    # Only `Parameters` lists the arguments; this signature shows them in help() and in editors.
    __signature__: ClassVar[inspect.Signature] = spelt_out(__init__)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, float]]:
        """Bring the plant to rest and start an episode.

        Parameters
        ----------
        seed
            Restarts the environment's random streams. Without a seed, the next episode of the
            present streams begins.
        options
            Not used.

        Returns
        -------
        observation : ndarray of float32
            The observation at k = 0, shape (size,).
        info : dict
            The info at k = 0.
        """
        super().reset(seed=seed)
        if self._root is not self.np_random:
            self._root = self.np_random
            seeds = cast("np.random.SeedSequence", self._root.bit_generator.seed_seq)
            self._streams = [Streams.spawn(seeds)]
        numbers_of_plants = self._ranges.draw(self._streams)
        setpoint = self._signals.reset(ONE, self._streams, numbers_of_plants).item()
        numbers = plant_numbers(numbers_of_plants, 0)
        self._plant = Plant(self.parameters, numbers)
        self._ahead.clear()

        # At rest u is 0, whichever action that is.
        self._action = action_from_command(0.0, numbers.u_min, numbers.u_max)
        rest_action = _limited(self._action, 1.0)
        _, error_place, output_place, action_place, size = self._layout
        # `step` needs one more element at the end.
        self._window = [0.0] * action_place + [rest_action] * (size - action_place + 1)
        # An empty block begins where the next block does, which is written later.
        self._window[0] = setpoint
        self._window[error_place] = setpoint
        self._window[output_place] = 0.0
        self._window[action_place] = rest_action
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
        info |= numbers.chosen(self.parameters.ranges)
        return np.fromiter(self._window, _FLOAT32, size), info

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, dict[str, float]]:
        """Apply a normalised action for one sample.

        Parameters
        ----------
        action
            a(k), shape (1,).

        Returns
        -------
        observation : ndarray of float32
            The observation at k+1, shape (size,).
        reward : float
            The reward of e(k+1).
        terminated, truncated : bool
            Always False.
        info : dict of float
            The info at k+1.

        Raises
        ------
        ValueError
            If the action is not one finite number. The plant is then unchanged.
        ResetNeeded
            Before the first reset.
        """
        # The speed of the environment depends on this method, so it avoids function calls.
        try:
            a = float(action.item() - 0.0)  # the difference fails for text such as "0.3"
        except (AttributeError, TypeError, ValueError, OverflowError, RuntimeError):
            a = one_action(action)
        observed_action = a
        if not -1.0 <= a <= 1.0:
            observed_action = _limited(a, 1.0)
            if not math.isfinite(a):
                one_action(a)  # raises a ValueError
        if not self._ahead:
            if not self._streams:
                raise ResetNeeded("call reset before step")
            self._ahead = self._signals.ahead()[::-1]
        setpoint, noise, load, transmitter_noise = self._ahead.pop()
        error_scale, quadratic, move_weight = self._reward_terms
        span, error_place, output_place, action_place, size = self._layout

        command, applied, output = self._plant.step(a, noise, load)
        error = setpoint - output
        scaled = error / error_scale
        reward = scaled * scaled * -0.5 if quadratic else -abs(scaled)  # (12)
        if move_weight:
            reward -= move_weight * abs(a - self._action)
        self._action = a

        measured = output + transmitter_noise
        if not -span <= measured <= span:
            measured = _limited(measured, span)
        # One insertion shifts all blocks by one place. The oldest element of a block moves to
        # the first place of the next block, where the new sample overwrites it. An empty block
        # begins where the next block does, which is written later; an empty last block begins
        # at the additional element at the end.
        window = self._window
        window.insert(0, setpoint)
        window.pop()
        window[error_place] = setpoint - measured
        window[output_place] = measured
        window[action_place] = observed_action
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
        """Draw the last samples of the episode.

        Returns
        -------
        ndarray of uint8 or None
            With the render mode "rgb_array", a picture, shape (540, 960, 3). With "human",
            None: the picture is shown in a window. Without a render mode, None, after a
            warning.

        Raises
        ------
        ResetNeeded
            Before the first reset.
        DependencyNotInstalled
            If pygame is not installed.
        """
        if self.render_mode is None:
            logger.warn(NO_MODE)
            return None
        if self._record is None:
            raise ResetNeeded("call reset before render")
        from mptc_gym import drawing  # which needs pygame

        if self.render_mode == "rgb_array":
            return drawing.frame(self._record)
        drawing.show(self._record, self.metadata["render_fps"], self)
        return None

    def close(self) -> None:
        """Close the window, unless another environment shows its pictures in this window."""
        if self.render_mode == "human" and self._record is not None:
            from mptc_gym import drawing  # which needs pygame

            drawing.hide(self)
        self._record = None


MiddlePointEnv.__doc__ = insert_table(MiddlePointEnv.__doc__)


def _limited(value: float, limit: float) -> float:
    """Limit a value to +-limit; by this order of min and max, NaN becomes the limit."""
    return max(-limit, min(limit, value))
