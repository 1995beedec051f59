"""Simulate the plant, set point and transmitter of one boiler: `MiddlePoint-v0`."""

from __future__ import annotations

import inspect
import math
from copy import copy, deepcopy
from typing import Any, ClassVar, NamedTuple, cast

import gymnasium
import numpy as np
from gymnasium import logger
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box, Space
from numpy.typing import NDArray

from mptc_gym.plant.actuator import WantedFlow, action_from_command
from mptc_gym.plant.checks import NOT_A_NUMBER, one_action, one_of, to_python
from mptc_gym.plant.dynamics import Plant
from mptc_gym.plant.parameters import Parameters, full_signature, insert_table
from mptc_gym.plant.sampling import PlantSampler, RandomStreams, plant_numbers
from mptc_gym.plant.signals import ONLY_PLANT, Signals
from mptc_gym.record import Record

# The arguments that the `EnvSpec` of a batch has in addition to those of its plants.
_BATCH_ARGUMENTS = "num_envs", "vectorization_mode", "max_episode_steps", "autoreset_mode"
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
    """Return the observation space of an environment, a float32 `Box` of shape (size,).

    The bounds of observations do not depend on the set point, so that a policy that was trained
    on one set point can run on another set point.
    """
    span = parameters.temperature_span
    # The largest magnitudes of a set point, an error, an output and an action in an
    # observation, in the order of `Parameters.windows`.
    limits = np.array([span, 2.0 * span, span, 1.0], np.float32)
    high = np.repeat(limits, parameters.windows)
    return Box(-high, high, dtype=np.float32)


class HasJsonSpec:
    """An environment whose specification (`EnvSpec`) can be written as JSON."""

    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """The `EnvSpec` of an environment like this one, for `gymnasium.make`, or None."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        """Store a copy of `spec` that can be written as JSON and that makes this environment.

        `gymnasium.make_vec` stores the time limit of a batch among the arguments alone.
        """
        if spec is not None:
            spec = copy(spec)
            spec.kwargs = {name: to_python(value) for name, value in spec.kwargs.items()}
            limit = spec.kwargs.get("max_episode_steps")
            if limit is not None:
                spec.max_episode_steps = None if limit == -1 else limit
        self._spec = spec


class _State(NamedTuple):
    """What `MiddlePointEnv.get_state` returns; nothing in it changes after that."""

    parameters: Parameters
    plant: Plant
    wanted_flow: WantedFlow | None
    action: float
    window: list[float]
    coming_signals: list[tuple[float, ...]]
    signals: Signals
    streams: list[RandomStreams]
    continues_streams: bool  # whether a reset without a seed goes on with `streams`
    seed: int | None
    np_random: Any  # state of the bit generator


class MiddlePointEnv(HasJsonSpec, gymnasium.Env[Observation, Action]):
    """Control the temperature at the middle point of a once-through boiler by feedwater flow.

    At the middle point of a once-through boiler, water becomes steam. More feedwater lowers the
    temperature at the middle point, but only after a transport delay of 18 samples of 8 s. The
    actuator of the feedwater flow has a dead zone and saturates, and noise disturbs the
    temperature. The plant comes from Cui and Shin, "Application of neural networks to
    temperature control in thermal power plants" (1992), here called the paper. Numbers in
    parentheses, such as (28), are equations of the paper. All temperatures and flows are
    deviations from the boiler's operating point. `MiddlePointVectorEnv` simulates many plants
    at once.

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
    reward of the error e(k+1). With a delay of d = 18 samples, y(19) is the first temperature
    that depends on the flow u(0). With polynomials A, B and C in the backward shift z^-1,
    equation (28) reads A(z^-1) y(k) = B(z^-1) u_a(k-d) + C(z^-1) xi(k), for temperature y,
    applied flow u_a, delay d and white noise xi.

    Section 1 of the paper names difficulties of a boiler that equation (28) does not include.
    The environment can simulate the following difficulties, which are off by default, and on in
    some of the argument sets in `mptc_gym.PRESETS`:

    - Measurement noise: from sample k = 1 on, the observation holds the transmitter's reading
      y + v in place of the temperature y, with white noise v ~ N(0,
      measurement_noise_variance). The reward and `info["output"]` use the true temperature y.

    - A load disturbance w (degC), as when the feedwater's temperature, the coal or the fire's
      position changes: A(1) w(k), where A(1) is the sum of the coefficients of the polynomial
      A, is added to the right side of equation (28), so that a constant load w adds w to the
      steady-state temperature. The load w starts at 0 and changes every 10 samples. The load
      disturbance w is the sum of a random walk and of a level that jumps. The variance of the
      random walk in the load grows by `disturbance_walk_variance` per sample. The level of the
      load jumps at random times, every `disturbance_interval` samples on average, to a new
      level that is uniform within +-`disturbance_amplitude`.

    - Other dynamics: `gain_factor` multiplies the steady-state gain, and `time_constant_factor`
      multiplies the dominant time constant. The slowest pole of equation (28) is p = 0.9515,
      and the dominant time constant is 1 / (1 - p) = 20.6 samples. A gain factor g and a time
      constant factor t replace the slowest pole p of equation (28) by 1 - (1 - p) / t, multiply
      the polynomial B by g / t, and leave the other poles unchanged.

    - Fouling: within the first `drift_samples` samples of an episode, the steady-state gain
      drifts linearly to `gain_drift` times the gain at k = 0, and the time constant to
      `time_constant_drift` times the time constant at k = 0. A gain or time constant that
      drifts changes in small steps, every 10 samples.

    ## Action space

    The action space is `Box(-1, 1, (1,), float32)`: an action a commands the flow
    u = u_min + (a + 1) / 2 * (u_max - u_min), in t/h.

    | Index | Action | at -1 | at 1 | Unit |
    |---|---|---|---|---|
    | 0 | feedwater flow u | u_min = -10 | u_max = 10 | t/h |

    An action below -1 or above 1 commands a flow outside the range from `u_min` to `u_max`; the
    actuator limits the applied flow to this range.

    With the argument `action="change"`, the velocity form of process control, the action w is
    a change of a wanted flow v that starts at 0 t/h, and is clipped to +-1:
    v(k) = v(k-1) + w(k) * max_move * (u_max - u_min) / 2, limited to [u_min, u_max]. The
    commanded flow is u(k) = v(k). With a `compensated_dead_zone` z above 0 t/h, the commanded
    flow skips a dead zone of the half width z: u = z + (u_max - z) v / u_max for v > 0, u = 0
    for v = 0, and u = -z + (u_min + z) v / u_min for v < 0. In observation and reward, the
    action a(k) then is the one that commands the flow u(k). A policy must know the wanted flow,
    so an `action_window` of at least 1 is advisable.

    ## Observation space

    The observation is a 1-D float32 array that joins four blocks: set points, errors, outputs
    and past actions, each block with the newest sample first. In the following table of the
    blocks of an observation, y is the transmitter's reading of the temperature, which saturates
    at +-`temperature_span`, and e is y_d minus this reading.

    | Block | Elements (default) | Bounds (default) | Unit |
    |---|---|---|---|
    | set points y_d(k), y_d(k-1), ... | `setpoint_window` (3) | +-50 | degC |
    | errors e(k), e(k-1), ... | `error_window` (3) | +-100 | degC |
    | outputs y(k), y(k-1), ... | `output_window` (0) | +-50 | degC |
    | actions a(k-1), a(k-2), ... | `action_window` (0) | +-1 | 1 |

    The default observation holds three set points and three errors, the six inputs of the
    paper's neural network. Past actions in the observation are clipped to +-1, because the
    actuator limits the flow that an action beyond +-1 commands. With `action_window=delay+2`,
    otherwise default windows and polynomials, a constant set point, and without noise, load,
    drifts and ranges, the control problem is a Markov decision process. A set point, or an
    amplitude in use, beyond +-`temperature_span` is a ValueError.

    ## Reward

    | `reward` | reward of the step to k+1 |
    |---|---|
    | "quadratic" | -(e(k+1) / error_scale)^2 / 2 - move_weight * abs(a(k) - a(k-1)) |
    | "absolute" | -abs(e(k+1)) / error_scale - move_weight * abs(a(k) - a(k-1)) |

    If `move_weight` is 0, the reward "quadratic" is the negative of the cost in equation (12)
    of the paper, applied to the error divided by `error_scale`. The best possible reward of a
    step is 0. With the default arguments and a constant feedwater flow of 0 t/h, the reward of
    every step is -0.5. The transmitter's range does not limit the reward, because the error in
    the reward is the set point minus the true temperature.

    ## Starting state

    The plant is at rest before sample k = 0: temperature y, set point y_d, error e, flows u and
    u_a, and white noise xi are all 0, so that y(0) = 0. All random numbers come from the seed
    of `reset`. The random numbers do not depend on the actions, so that every controller meets
    the same noise, set point, load and plant for the same seed. The random numbers of the j-th
    episode after a seed do not depend on the length of earlier episodes. `reset` has no
    options.

    ## Episode end

    No episode terminates. `gymnasium.make` truncates an episode after 1200 steps.

    ## Arguments

    All arguments are keyword-only and can be given to `gymnasium.make`. In the table of
    arguments, an asterisk marks an argument that can be a range [low, high], from which each
    `reset` samples a number uniformly (an integer where the default is an integer).

    <arguments>

    `render_mode` is None, "human" or "rgb_array"; the section on rendering describes these
    modes. An argument that is a list may also be a tuple or a NumPy array. Every number in an
    argument must be within +-1e9.

    ## Info

    `reset` and `step` return a new dict of floats: `output` (the true y, degC), `setpoint`
    (y_d, degC), `error` (y_d - y, degC), `command` (u, t/h), `applied` (u_a, t/h) and `noise`
    (n, degC). The info of the step from sample k to k+1 holds the commanded flow u(k), the
    applied flow u_a(k), the temperature y(k+1), the set point y_d(k+1), the error e(k+1) and
    the noise n(k+1). In the info of `reset`, the entries `command`, `applied` and `noise` are
    0.

    With a load disturbance, the info also holds `disturbance`, the load w in degC. With a drift
    of gain or time constant, the info also holds the values of `gain_factor` and
    `time_constant_factor` at the present sample. For each argument that is a range, the info of
    `reset` also holds the sampled number, under the argument's name; a sampled delay is an int.

    ## Copies

    A deep copy or a pickle in mid-episode continues the same episode: noise, load and set
    points to come are those of the original, even if the copy gets another `np_random`. So does
    an environment that `set_state` brings back to a state of `get_state`, which is much faster
    than a copy. A planner that tries actions on copies or from a state therefore foresees them,
    which no controller of a real plant can. A planner should try actions in an environment of
    its own, made without noise and load and with the set point that it expects, to which it
    applies every action that the plant receives.

    ## Rendering

    | `render_mode` | `render` |
    |---|---|
    | "rgb_array" | returns a picture, shape (540, 960, 3), uint8 |
    | "human" | shows the picture in pygame's window; `reset` and `step` call `render`, at most `metadata["render_fps"]` times a second |

    The picture shows the latest 200 samples of the episode, or more if the delay is long. The
    upper panel of the picture shows the set point and the true temperature. The lower panel of
    the picture shows the commanded and the applied flow, the dead zone and the limits of the
    flow, and the latest samples, whose flow has not reached the middle point yet. Pictures
    need pygame: `pip install "mptc_gym[render]"`. Gymnasium's `RecordVideo` also needs
    moviepy.

    ## Errors

    For an invalid argument or `render_mode`, the constructor raises a `ValueError` that names
    the argument. For an unknown argument, the constructor raises a `TypeError`. If an action is
    not one finite number, `step` raises a `ValueError` and leaves the plant unchanged. Without
    pygame, `render` raises `DependencyNotInstalled` in an environment with a render mode.

    ## Version history

    * v0: first version.
    """  # noqa: E501 (the tables)

    metadata: dict[str, Any] = {  # noqa: RUF012 (as in gymnasium.Env)
        "render_modes": ["human", "rgb_array"],
        "render_fps": 30,
    }

    def __init__(self, *, render_mode: str | None = None, **arguments: Any) -> None:
        parameters = Parameters(**arguments)
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
        self._wanted_flow: WantedFlow | None = None  # for the action form "change" alone
        self._signals = Signals.of(parameters)
        # Whether a state of `get_state` refers to `_signals` and `_streams`.
        self._signals_are_shared = False
        # Random number streams of the environment's plant; empty before the first reset.
        self._streams: list[RandomStreams] = []
        # The random number generator from whose seed the streams start.
        self._root: np.random.Generator | None = None
        # Set point y_d, noise n, load w and measurement noise, degC, of the coming samples,
        # with the next sample at the end of the list.
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
            Seed with which the environment's random number streams restart. If the seed is
            None, the random number streams continue with the random numbers of the next
            episode.
        options
            Not used.

        Returns
        -------
        observation : ndarray of float32
            The observation at sample k = 0, shape (size,); the docstring of the class describes
            the elements.
        info : dict of float
            The info at sample k = 0, with the values that `reset` sampled for arguments that
            are ranges.
        """
        super().reset(seed=seed)
        self._own_signals()  # which are about to change, and may belong to a `get_state`
        if self._root is not self.np_random:  # at the first reset, or after a new seed
            self._root = self.np_random
            seeds = cast("np.random.SeedSequence", self._root.bit_generator.seed_seq)
            self._streams = [RandomStreams.spawn(seeds)]
        arrays_of_numbers = self._plant_sampler.sample(self._streams)
        setpoint = self._signals.reset(ONLY_PLANT, self._streams, arrays_of_numbers).item()
        numbers = plant_numbers(arrays_of_numbers, 0)  # of the only plant
        self._plant = Plant(self.parameters, numbers)
        self._coming_signals.clear()
        if self.parameters.action == "change":
            self._wanted_flow = WantedFlow(self.parameters)

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
            self._record = Record.at_rest(numbers, self.parameters.sampling_interval, setpoint)
        if self.render_mode == "human":
            self.render()
        info = dict.fromkeys(INFO, 0.0)
        info["setpoint"] = setpoint
        info["error"] = setpoint
        if self.parameters.is_disturbed:
            info["disturbance"] = 0.0
        info |= self._plant.factors
        info |= numbers.select(self.parameters.ranges)  # what this reset has sampled
        # The count `size` leaves out the additional element at the end.
        return np.fromiter(self._window, _FLOAT32, size), info

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, dict[str, float]]:
        """Apply a normalised action, and move the plant from sample k to sample k+1.

        Parameters
        ----------
        action
            The action, shape (1,): a(k), of which -1 commands the flow `u_min` and 1 the flow
            `u_max`, or the change w(k) if the argument `action` is "change".

        Returns
        -------
        observation : ndarray of float32
            The observation at sample k+1, shape (size,).
        reward : float
            The reward of the step from sample k to sample k+1.
        terminated, truncated : bool
            Always False, because no episode terminates; `gymnasium.make` adds the time limit.
        info : dict of float
            The info at sample k+1.

        Raises
        ------
        ValueError
            If the action is not one finite number; the plant is then left unchanged.
        ResetNeeded
            If `step` is called before the first `reset`.
        """
        # The speed of the environment depends on `step`, which therefore avoids function calls.
        try:
            a = float(action.item() - 0.0)  # subtracting 0.0 fails for text such as "0.3"
        except NOT_A_NUMBER:
            a = one_action(action)
        if not math.isfinite(a):
            one_action(a)  # raises a ValueError, as the action is not finite
        if not self._coming_signals:
            if not self._streams:  # random number streams, which the first reset makes
                raise ResetNeeded("call reset before step")
            self._own_signals()  # as in `reset`
            # In reverse order, because `pop` returns the last element of the list.
            self._coming_signals = self._signals.ahead()[::-1]
        setpoint, noise, load, measurement_noise = self._coming_signals.pop()
        if self._wanted_flow is not None:
            a = self._wanted_flow.change(a)

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
        window[action_index] = a if -1.0 <= a <= 1.0 else _clip(a, 1.0)
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
            self._record.add(info)
            if self.render_mode == "human":
                self.render()
        return observation, reward, False, False, info

    def get_state(self) -> Any:
        """Return the present state, with which `set_state` continues from the present sample.

        With wrappers, write `env.unwrapped.get_state()`; wrappers such as a time limit keep a
        state of their own. The section on copies in the docstring of the class says what a
        planner that tries actions from a state foresees.

        Returns
        -------
        state
            The state of plant, observation, signals and all random numbers except those of the
            spaces. Its contents are not public. Any number of calls of `set_state` can use a
            state, which can be pickled.

        Raises
        ------
        ResetNeeded
            If `get_state` is called before the first `reset`.
        """
        if not self._streams:
            raise ResetNeeded("call reset before get_state")
        self._signals_are_shared = True
        return _State(
            parameters=self.parameters,
            plant=copy(self._plant),
            wanted_flow=copy(self._wanted_flow),
            action=self._action,
            window=self._window.copy(),
            coming_signals=self._coming_signals.copy(),
            signals=self._signals,
            streams=self._streams,
            continues_streams=self._root is self.np_random,
            seed=self.np_random_seed,
            np_random=self.np_random.bit_generator.state,
        )

    def set_state(self, state: Any) -> None:
        """Bring the environment back to a state, after which steps and resets are as after it.

        Only the picture of `render` is not brought back; it also shows the samples since then.

        Parameters
        ----------
        state
            A state of this environment, or of another `MiddlePointEnv` with equal arguments.

        Raises
        ------
        ValueError
            If the environment of the state had other arguments.
        """
        if state.parameters != self.parameters:
            raise ValueError("the state is that of an environment with other arguments")
        self._plant = copy(state.plant)
        self._wanted_flow = copy(state.wanted_flow)
        self._action = state.action
        self._window = state.window.copy()
        self._coming_signals = state.coming_signals.copy()
        self._signals_are_shared = True
        self._signals = state.signals
        self._streams = state.streams
        self.np_random.bit_generator.state = state.np_random
        self._np_random_seed = state.seed
        # None makes the next reset start new streams from `np_random`.
        self._root = self.np_random if state.continues_streams else None

    def _own_signals(self) -> None:
        """Copy signals and streams to which a state refers, before they change.

        They change so rarely, when a block of signals is generated and when an episode begins,
        that states refer to them instead of holding copies.
        """
        if self._signals_are_shared:
            # In one call, as the signals refer to the streams.
            self._signals, self._streams = deepcopy((self._signals, self._streams))
            self._signals_are_shared = False

    def render(self) -> Frame | None:
        """Return or show a picture of the latest samples of the episode.

        Returns
        -------
        ndarray of uint8 or None
            A picture, shape (540, 960, 3), in the render mode "rgb_array". None in the render
            mode "human", which shows the picture in a window. None after a warning, if the
            environment has no render mode.

        Raises
        ------
        ResetNeeded
            If the environment has a render mode, and `render` is called before the first
            `reset`.
        """
        if self.render_mode is None:
            logger.warn(NO_RENDER_MODE)
            return None
        if self._record is None:
            raise ResetNeeded("call reset before render")
        from mptc_gym import rendering  # which needs pygame, an optional package

        if self.render_mode == "rgb_array":
            return rendering.frame(self._record)
        rendering.show(self._record, self.metadata["render_fps"])
        return None

    def close(self) -> None:
        """Close the window, if this environment has shown pictures."""
        if self.render_mode == "human" and self._record is not None:
            import pygame  # optional, but present where pictures have been shown

            pygame.display.quit()
        self._record = None


MiddlePointEnv.__doc__ = insert_table(MiddlePointEnv.__doc__)


def make_env(**arguments: Any) -> MiddlePointEnv:
    """Return one environment; the entry point of `gymnasium.make`.

    `arguments` are the arguments of `MiddlePointEnv`. The `EnvSpec` of a batch, whose arguments
    include `vectorization_mode`, makes one environment like those in the batch.
    """
    if "vectorization_mode" in arguments:
        for name in _BATCH_ARGUMENTS:
            arguments.pop(name, None)
    return MiddlePointEnv(**arguments)


# From these render modes, `gymnasium.make` derives further ones, such as "rgb_array_list".
make_env.metadata = MiddlePointEnv.metadata  # type: ignore[attr-defined]


def _clip(value: float, limit: float) -> float:
    """Return `value` limited to the range from -`limit` to `limit`; NaN becomes `limit`."""
    return max(-limit, min(limit, value))
