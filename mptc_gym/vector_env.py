"""Many plants side by side, as a Gymnasium vector environment."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, cast

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from mptc_gym import rendering
from mptc_gym.checks import MOST_PLANTS, count, is_count, reject
from mptc_gym.env import MiddlePointEnv
from mptc_gym.plant import PlantBatch, action_from_command
from mptc_gym.ranges import Ranges, numbers_of_plant
from mptc_gym.record import Record
from mptc_gym.signals import (
    BLOCK,
    FOREVER,
    DisturbanceBatch,
    NoiseBatch,
    SetPointBatch,
    Streams,
)

Infos = dict[str, Any]
Values = NDArray[np.float64]  # one a plant, shape (num_envs,)
Indices = NDArray[np.intp]

INFO = ("output", "setpoint", "error", "command", "applied", "noise")
_FLOAT64 = np.dtype(np.float64)  # quicker to pass on than the type
_NOISE_BYTES = 1 << 27  # of a block of noise, unless a single sample of all plants takes more
_STEPS_PER_SHIFT = 64  # steps until the window of the observations is moved back


def checked_limit(max_episode_steps: int | None) -> int:
    """Return the samples of an episode; `FOREVER` if there is no limit, None or -1."""
    if max_episode_steps is None:
        return FOREVER
    if not is_count(max_episode_steps, -1) or max_episode_steps == 0:
        allowed = "an integer of at least 1, or None or -1 for no limit"
        reject("max_episode_steps", max_episode_steps, allowed)
    return FOREVER if max_episode_steps == -1 else min(FOREVER, int(max_episode_steps))


def checked_mode(autoreset_mode: str | AutoresetMode) -> AutoresetMode:
    """Return an autoreset mode that is given by itself or by its value."""
    try:
        return AutoresetMode(autoreset_mode)
    except ValueError:
        allowed = ", ".join(repr(mode.value) for mode in AutoresetMode)
        reject("autoreset_mode", autoreset_mode, f"one of {allowed}")


def checked_options(options: Any) -> Mapping[str, Any]:
    """Return the options of a reset, none for None; ValueError if they are no dict."""
    if options is None:
        return {}
    if not isinstance(options, Mapping):
        reject("options", options, "a dict or None")
    return options


class MiddlePointVectorEnv(VectorEnv[NDArray[np.float32], NDArray[np.float32], NDArray[Any]]):
    """n plants that advance together: `gymnasium.make_vec("MiddlePoint-v0", num_envs=n)`.

    Given the same seed, all that `reset` and `step` return equals, to the bit, what Gymnasium's
    `SyncVectorEnv` of n `MiddlePointEnv` returns. See there for the plant, the spaces, the
    reward, the infos and the arguments.

    Parameters
    ----------
    num_envs
        n, number of plants, at most 10 million.
    max_episode_steps
        Samples after which an episode is truncated; None or -1 for never.
    autoreset_mode
        An `AutoresetMode` or its value. "NextStep": the step after the end of an episode resets
        the plant, and its action is ignored. "SameStep": the step that ends an episode resets
        the plant, and returns the last observation and info in `final_obs` and `final_info`.
        "Disabled": the caller resets ended plants by `reset(options={"reset_mask": mask})`.
    render_mode
        None, or "rgb_array": `render` returns a picture of each plant.
    **arguments
        Those of `MiddlePointEnv`, the same for all plants; from a range each draws its own.

    Raises
    ------
    ValueError
        If an argument is out of range; the message names it.
    TypeError
        If an argument is unknown.

    Notes
    -----
    All plants share one clock, so that a step is array arithmetic alone. There is a Python loop
    over plants only where each draws from its own generators: at the start of an episode, once
    in some 600 samples of noise, and when a random set point changes. A plant needs the same
    few KiB however long an episode lasts.

    With an unstable `a`, or with actions beyond 1e154, y may leave the range of floats. NumPy
    then warns here, while `MiddlePointEnv` continues without a warning.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (as in VectorEnv)
        **MiddlePointEnv.metadata,
        "render_modes": ["rgb_array"],
    }

    __signature__: ClassVar[inspect.Signature] = inspect.Signature(
        [
            inspect.Parameter(
                "num_envs", inspect.Parameter.POSITIONAL_OR_KEYWORD, default=1, annotation="int"
            ),
            *MiddlePointEnv.__signature__.parameters.values(),
            inspect.Parameter(
                "max_episode_steps",
                inspect.Parameter.KEYWORD_ONLY,
                default=None,
                annotation="int | None",
            ),
            inspect.Parameter(
                "autoreset_mode",
                inspect.Parameter.KEYWORD_ONLY,
                default=AutoresetMode.NEXT_STEP,
                annotation="str | AutoresetMode",
            ),
        ]
    )

    def __init__(
        self,
        num_envs: int = 1,
        *,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        **arguments: Any,
    ) -> None:
        rendering.check_mode(render_mode, self.metadata["render_modes"])
        single = MiddlePointEnv(**arguments)
        self.num_envs = num_envs = count("num_envs", num_envs, 1, MOST_PLANTS)
        self._limit = checked_limit(max_episode_steps)
        self.autoreset_mode = checked_mode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.render_mode = render_mode
        self._records: dict[int, Record] = {}  # of every plant, for pictures
        self.parameters = parameters = single.parameters
        self.single_action_space = single.action_space
        self.single_observation_space = single.observation_space
        self.action_space = batch_space(single.action_space, num_envs)
        self.observation_space = batch_space(single.observation_space, num_envs)

        self._seeds: list[int | None] = [None] * num_envs
        self._streams: dict[int, Streams] = {}  # of every plant, once they have been reset
        self._clock = 0  # samples since the plants were made
        self._plants = PlantBatch(parameters, num_envs)
        # Blocks of noise that come out even at the end of an episode; short ones, which take
        # longer to make, where the memory of many plants would be large.
        longest = max(1, min(BLOCK, _NOISE_BYTES // (8 * num_envs)))
        block = math.ceil(self._limit / math.ceil(self._limit / longest))
        self._noise = NoiseBatch(
            parameters.c, parameters.range_of("noise_variance"), num_envs, block
        )
        self._transmitter = NoiseBatch(
            [1.0], parameters.range_of("measurement_noise_variance"), num_envs, block
        )
        self._ranges = Ranges(parameters)
        self._disturbance = DisturbanceBatch(num_envs) if parameters.is_disturbed else None
        self._factors = ("gain_factor", "time_constant_factor") if parameters.drifts else ()
        load = ("disturbance",) if self._disturbance is not None else ()
        self._names = (*INFO, *load, *self._factors)  # of what infos hold
        self._setpoint = SetPointBatch(parameters, num_envs)
        self._ends = np.zeros(num_envs, np.int64)  # by the clock, of the episodes
        self._first_end = 0
        self._ended: NDArray[np.bool_] | None = None  # those still to be reset, if any
        # Arrays instead of numbers, as in `PlantBatch`.
        span = parameters.temperature_span
        self._span = np.full(num_envs, -span), np.full(num_envs, span), span * span
        self._reward_terms = (
            np.array(parameters.error_scale),
            np.array(-0.5),
            parameters.reward == "quadratic",
            parameters.move_weight,
        )
        # Where the newest sample of each block of the observation lies, if there is the block.
        self._newest = tuple(
            np.s_[:, head] if window else None
            for head, window in zip((0, *parameters.heads), parameters.windows, strict=True)
        )
        self._actions = np.zeros(num_envs)  # the last ones
        # The observations of all plants lie in this row, one after the other, from a place on
        # that moves back by one each step. So all blocks of samples move on by one, and only
        # their first elements have to be written.
        self._shape = num_envs, parameters.observation_size
        self._elements = num_envs * parameters.observation_size
        self._row = np.zeros(self._elements + _STEPS_PER_SHIFT, np.float32)
        self._place = _STEPS_PER_SHIFT
        self._everyone, self._nobody = np.ones(num_envs, np.bool_), np.zeros(num_envs, np.bool_)

    @property
    def np_random_seed(self) -> tuple[int | None, ...]:  # type: ignore[override]
        """The seed of each plant; None before the first reset."""
        return tuple(self._seeds)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[NDArray[np.float32], Infos]:
        """Bring all plants, or some, to rest and start an episode of each.

        Parameters
        ----------
        seed
            Starts the random streams anew: those of plant i with seed + i, or with element i of
            a list. Without it, or where the list says None, the next episode of the present
            streams begins.
        options
            `reset_mask`, an array of bool, shape (num_envs,), says which plants are reset.

        Returns
        -------
        observations
            Shape (num_envs, observation_size), float32;
            the last one of a plant that was not reset.
        infos
            Arrays of shape (num_envs,), and a mask of the plants that were reset with each.

        Raises
        ------
        ValueError
            If `seed` or `reset_mask` does not fit. Nothing is changed then.
        ResetNeeded
            If the first reset is not one of all plants.
        """
        seeds = self._checked_seeds(seed)
        mask = self._checked_mask(checked_options(options))
        which = np.flatnonzero(mask)
        if len(which) < self.num_envs and not self._streams:
            raise ResetNeeded("reset all environments before some of them")
        self._seed(which, seeds)
        infos: Infos = {
            name: np.zeros(self.num_envs) for name in {*self._names, *self._ranges.names}
        }
        self._reset_plants(which, infos)
        if self._ended is not None:
            ended = self._ended & ~mask
            self._ended = ended if ended.any() else None
        return self._window().copy(), infos | {f"_{name}": mask.copy() for name in infos}

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[
        NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], Infos
    ]:
        """Apply normalised actions for one sample.

        Parameters
        ----------
        actions
            a(k) of each plant, shape (num_envs, 1).

        Returns
        -------
        observations
            Shape (num_envs, observation_size), float32.
        rewards
            Shape (num_envs,), float64.
        terminations, truncations
            Shape (num_envs,), bool.
        infos
            Arrays of shape (num_envs,) and their masks, which may be one array.

        Raises
        ------
        ValueError
            If the actions have another shape, or one is not finite. The plants are untouched
            then.
        ResetNeeded
            If the environments have never been reset, or, with autoreset disabled, if one has
            ended.
        """
        # This is the hot path: for few plants, the number of calls determines its speed.
        a = self._checked_actions(actions)
        if self._ended is not None and self._ended.all():
            observations, infos = self.reset()
            none = self._nobody
            return observations, np.zeros(self.num_envs), none.copy(), none.copy(), infos
        self._clock = clock = self._clock + 1
        if clock >= self._setpoint.next_change:
            self._setpoint.move(clock)
        setpoint = self._setpoint.now
        noise = self._noise.next()
        load = self._disturbance.at(clock) if self._disturbance is not None else None
        command, applied, output = self._plants.step(a, noise, load)

        error_scale, minus_half, quadratic, move_weight = self._reward_terms
        error = setpoint - output
        scaled = error / error_scale
        if quadratic:
            rewards = scaled * scaled  # (12)
            rewards *= minus_half
        else:
            rewards = -np.abs(scaled)
        if move_weight:
            rewards -= move_weight * np.abs(a - self._actions)
        self._actions = a

        measured, measured_error = output, error
        if not self._transmitter.silent:
            measured = output + self._transmitter.next()
            measured_error = setpoint - measured
        lowest, highest, squared = self._span
        # Otherwise no single one can be beyond the span.
        if not measured.dot(measured) <= squared:
            measured = np.fmin(measured, highest)  # which takes NaN for the limit
            np.fmax(measured, lowest, out=measured)
            measured_error = setpoint - measured
        if self._place == 0:
            self._row[_STEPS_PER_SHIFT:] = self._row[:-_STEPS_PER_SHIFT]
            self._place = _STEPS_PER_SHIFT
        self._place = place = self._place - 1
        window = self._row[place : place + self._elements].reshape(self._shape)
        setpoints, errors, outputs, past_actions = self._newest
        if setpoints is not None:
            window[setpoints] = setpoint
        if errors is not None:
            window[errors] = measured_error
        if outputs is not None:
            window[outputs] = measured
        if past_actions is not None:
            window[past_actions] = a.clip(-1.0, 1.0)

        if self._records:
            columns = (values.tolist() for values in (setpoint, output, command, applied))
            for i, numbers in enumerate(zip(*columns, strict=True)):
                self._records[i].add(*numbers)

        everyone = self._everyone.copy()
        infos = {
            "output": output.copy(),
            "_output": everyone,
            "setpoint": setpoint.copy(),
            "_setpoint": everyone,
            "error": error,
            "_error": everyone,
            "command": command,
            "_command": everyone,
            "applied": applied,
            "_applied": everyone,
            "noise": noise.copy(),
            "_noise": everyone,
        }
        if load is not None:
            infos["disturbance"], infos["_disturbance"] = load.copy(), everyone
        for name, factors in zip(self._factors, self._plants.factors, strict=False):
            infos[name], infos[f"_{name}"] = factors.copy(), everyone
        terminations, truncations = self._nobody.copy(), self._nobody.copy()
        if clock >= self._first_end:
            truncations = self._end_episodes(rewards, infos)
        return window.copy(), rewards, terminations, truncations, infos

    def render(self) -> tuple[rendering.Frame, ...] | None:
        """Draw the last minutes of each plant's episode.

        Returns
        -------
        tuple of ndarray, or None
            A picture of each plant, shape (540, 960, 3), uint8. None, after a warning, without
            a render mode.

        Raises
        ------
        ResetNeeded
            If the environments have never been reset.
        DependencyNotInstalled
            If there is no pygame.
        """
        if self.render_mode is None:
            rendering.warn_no_mode()
            return None
        if not self._records:
            raise ResetNeeded("call reset before render")
        return tuple(rendering.frame(self._records[i]) for i in range(self.num_envs))

    def _window(self) -> NDArray[np.float32]:
        """Return the observations as they lie in the row, shape (num_envs, size)."""
        return self._row[self._place : self._place + self._elements].reshape(self._shape)

    def _end_episodes(self, rewards: Values, infos: Infos) -> NDArray[np.bool_]:
        """Do what the end of an episode asks for, and return which have ended."""
        ended = self._ends <= self._clock
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            which = np.flatnonzero(ended)
            final_info = {name: np.where(ended, infos[name], 0.0) for name in self._names}
            final_obs = np.full(self.num_envs, None, object)
            for i, observation in zip(which, self._window()[which], strict=True):
                final_obs[i] = observation
            self._reset_ended(ended, infos)
            infos |= {
                "final_obs": final_obs,
                "_final_obs": ended.copy(),
                "final_info": final_info | {f"_{name}": ended.copy() for name in final_info},
                "_final_info": ended.copy(),
            }
            return ended
        if self._ended is not None:  # at the step before this one
            rewards[self._ended] = 0.0
            self._reset_ended(self._ended, infos)
            ended = self._ends <= self._clock
        self._ended = ended.copy() if ended.any() else None
        return ended

    def _reset_ended(self, ended: NDArray[np.bool_], infos: Infos) -> None:
        """Begin an episode of those that have ended, within the infos of a step."""
        for name in self._ranges.names:
            if name not in self._names:
                infos[name], infos[f"_{name}"] = np.zeros(self.num_envs), ended.copy()
        self._reset_plants(np.flatnonzero(ended), infos)

    def _reset_plants(self, which: Indices, infos: Infos) -> None:
        """Begin an episode of some plants, and put their infos of k = 0 in."""
        streams = [self._streams[i] for i in which.tolist()]
        numbers = self._ranges.given_arrays
        if self._ranges.names or self._disturbance is not None:
            generators = [each.plant.next_episode() for each in streams]
            numbers = self._ranges.draw(generators, len(which))
            if self._disturbance is not None:
                self._disturbance.reset(which, generators, numbers, self._clock)
        self._plants.reset(which, numbers)
        self._noise.reset(which, (each.noise for each in streams), numbers.noise_variance)
        self._transmitter.reset(
            which,
            (each.transmitter for each in streams),
            numbers.measurement_noise_variance,
        )
        self._setpoint.reset(which, (each.setpoint for each in streams), self._clock)
        rest_action = action_from_command(0.0, numbers.u_min, numbers.u_max)
        self._actions[which] = rest_action
        self._ends[which] = self._clock + self._limit
        self._first_end = int(self._ends.min())

        setpoint = self._setpoint.now[which]
        rest = np.zeros((len(which), self.parameters.observation_size), np.float32)
        setpoints, errors, _, _ = self._newest
        if setpoints is not None:
            rest[setpoints] = setpoint
        if errors is not None:
            rest[errors] = setpoint
        rest[:, self.parameters.heads[2] :] = np.reshape(
            np.clip(rest_action, -1.0, 1.0), (-1, 1)
        )
        self._window()[which] = rest
        for name in self._names:
            infos[name][which] = setpoint if name in ("setpoint", "error") else 0.0
        for name, factors in zip(self._factors, self._plants.factors, strict=False):
            infos[name][which] = factors[which]
        for name, values in numbers.chosen(self._ranges.names).items():
            infos[name][which] = values
        if self.render_mode is not None:
            for j, (i, first) in enumerate(zip(which.tolist(), setpoint.tolist(), strict=True)):
                interval = self.parameters.sampling_interval
                own = numbers_of_plant(numbers, j)
                self._records[i] = Record(own, interval, first)

    def _seed(self, which: Indices, seeds: Sequence[int | None]) -> None:
        for i in which.tolist():
            seed = seeds[i]
            if seed is None and i not in self._streams:
                seed = cast("int", np.random.SeedSequence().entropy)
            if seed is not None:
                self._seeds[i] = seed
                self._streams[i] = Streams.of_seed(seed)

    def _checked_seeds(self, seed: int | Sequence[int | None] | None) -> Sequence[int | None]:
        n = self.num_envs
        if seed is None:
            return [None] * n
        seeds: list[int | None] = []
        if isinstance(seed, int | np.integer) and not isinstance(seed, bool):
            seeds = list(range(int(seed), int(seed) + n))
        elif isinstance(seed, list | tuple) or (
            isinstance(seed, np.ndarray) and seed.ndim == 1
        ):
            seeds = list(seed)
        if len(seeds) != n or not all(s is None or is_count(s) for s in seeds):
            reject("seed", seed, f"an integer of at least 0, or a list of {n} of them or None")
        return [None if s is None else int(s) for s in seeds]

    def _checked_mask(self, options: Mapping[str, Any]) -> NDArray[np.bool_]:
        if "reset_mask" not in options:
            return np.ones(self.num_envs, np.bool_)
        mask = options["reset_mask"]
        if (
            not isinstance(mask, np.ndarray)
            or mask.dtype != np.bool_
            or mask.shape != (self.num_envs,)
            or not mask.any()
        ):
            allowed = f"an array of bool, shape ({self.num_envs},), at least one of them True"
            reject("options['reset_mask']", mask, allowed)
        return mask

    def _checked_actions(self, actions: NDArray[np.float32]) -> Values:
        """Return the actions as a new array, shape (num_envs,); 0 where they are ignored."""
        if not self._streams:
            raise ResetNeeded("call reset before step")
        n = self.num_envs
        given: NDArray[Any]
        try:
            given = np.asarray(actions)
            if given.dtype == object:
                given = np.array((given - 0.0).tolist())
            # Text is no number, even where NumPy reads one.
            given = given.astype(_FLOAT64, casting="same_kind")
        except (TypeError, ValueError, OverflowError):
            given = np.empty(0)
        if given.shape != (n, 1):
            reject("actions", actions, f"numbers, shape ({n}, 1)")
        a = given.ravel()
        if self._ended is not None:
            if self.autoreset_mode is AutoresetMode.DISABLED:
                ended = np.flatnonzero(self._ended)
                raise ResetNeeded(f"episodes of environments {ended} have ended: reset them")
            a[self._ended] = 0.0
        # One call tells that all are finite, unless some are huge.
        if not a.dot(a) < math.inf and not np.isfinite(a).all():
            reject("actions", actions, "finite")
        return a
