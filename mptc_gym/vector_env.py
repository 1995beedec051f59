"""Simulate many plants side by side in NumPy, as a Gymnasium vector environment."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from gymnasium import logger
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from mptc_gym.batch import BatchEnv, Infos, Mask
from mptc_gym.checks import is_count, many_actions, one_of, plain, reject
from mptc_gym.env import NO_MODE, Frame, MiddlePointEnv
from mptc_gym.parameters import spelt_out
from mptc_gym.plant import PlantBatch, action_from_command
from mptc_gym.record import Record
from mptc_gym.signals import BLOCK, Indices, Ranges, Signals, Streams, Values, plant_numbers

Observations = NDArray[np.float32]  # shape (num_envs, size)

NOISE_BYTES = 1 << 27  # at most, in a block of noise, unless one sample takes more
STEPS_PER_SHIFT = 64  # steps after which the window of observations is moved back


class MiddlePointVectorEnv(BatchEnv, VectorEnv[Any, Any, Any]):  # skrl inspects the bases
    """n plants that advance together: `gymnasium.make_vec("MiddlePoint-v0", num_envs=n)`.

    Given the same seed, `reset` and `step` return bit for bit what Gymnasium's `SyncVectorEnv`
    of n `MiddlePointEnv` returns. See `MiddlePointEnv` for the plant, the spaces, the reward,
    the infos and the arguments.

    Parameters
    ----------
    num_envs
        Number n of plants, at most 10 million.
    max_episode_steps
        Samples after which an episode is truncated; None or -1 for no limit.
    autoreset_mode
        An `AutoresetMode` or its value. "NextStep": the step after the end of an episode resets
        the plant, and its action is ignored. "SameStep": the step that ends an episode resets
        the plant, and returns the last observation and info in `final_obs` and `final_info`.
        "Disabled": the caller resets ended plants with `reset(options={"reset_mask": mask})`.
    render_mode
        None, or "rgb_array": `render` returns a picture of each plant.
    **arguments
        Those of `MiddlePointEnv`, the same for all plants; each draws its own from a range.

    Raises
    ------
    ValueError
        If an argument is out of range; the message names it.
    TypeError
        If an argument is unknown.

    Notes
    -----
    `reset(seed=)` restarts the random streams of plant i with seed + i, or with element i of a
    list. Without a seed, or where the list holds None, the next episode of the current streams
    begins. Rewards are float64, and observations float32.

    All plants share one clock, so that a step is array arithmetic alone. There is a Python loop
    over plants only where each draws from its own generators: at the start of an episode, once
    every 600 samples or so of noise, and when a random set point changes. A plant needs the
    same few KiB however long an episode lasts.

    With an unstable `a`, or with actions beyond 1e154, y may overflow. NumPy then warns here,
    while `MiddlePointEnv` continues without a warning.
    """

    metadata: dict[str, Any] = MiddlePointEnv.metadata | {"render_modes": ["rgb_array"]}
    _where = staticmethod(np.where)

    def __init__(
        self,
        num_envs: int = 1,
        *,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        **arguments: Any,
    ) -> None:
        one_of("render_mode", render_mode, [None, "rgb_array"])
        super().__init__(num_envs, max_episode_steps, autoreset_mode, arguments)
        parameters = self.parameters
        self.render_mode = render_mode
        self._records: dict[int, Record] = {}  # of every plant, for pictures
        self._seeds: list[int | None] = [None] * num_envs
        self._streams: dict[int, Streams] = {}  # of every plant, from the first reset on
        self._ranges = Ranges(parameters)
        # Blocks of noise that end with an episode; shorter ones, which are slower, where many
        # plants would need much memory.
        longest = max(1, min(BLOCK, NOISE_BYTES // (8 * num_envs)))
        block = math.ceil(self._limit / math.ceil(self._limit / longest))
        self._signals = Signals.of(parameters, num_envs, block)
        self._plants = PlantBatch(parameters, num_envs)
        self._shown = _Window(parameters.windows, num_envs)
        self._actions = np.zeros(num_envs)  # of the last step
        # Arrays instead of numbers, for speed, as in `PlantBatch`.
        self._zeros = np.zeros(num_envs)
        self._everyone, self._nobody = np.ones(num_envs, np.bool_), np.zeros(num_envs, np.bool_)
        span = parameters.temperature_span
        self._span = np.full(num_envs, -span), np.full(num_envs, span), span * span
        quadratic, scale = parameters.reward == "quadratic", np.array(parameters.error_scale)
        self._reward_terms = scale, np.array(-0.5), quadratic, parameters.move_weight

    __signature__: ClassVar[inspect.Signature] = spelt_out(__init__)

    @property
    def np_random_seed(self) -> tuple[int | None, ...]:  # type: ignore[override]
        """The seed of each plant; None before the first reset."""
        return tuple(self._seeds)

    def render(self) -> tuple[Frame, ...] | None:
        """Return a picture of each plant, shape (540, 960, 3), as `MiddlePointEnv` does of one.

        None without a render mode, after a warning.
        """
        if self.render_mode is None:
            logger.warn(NO_MODE)
            return None
        if not self._records:
            raise ResetNeeded("call reset before render")
        from mptc_gym import drawing  # which needs pygame

        return tuple(map(drawing.frame, self._records.values()))

    def _advance(self, a: Values) -> tuple[Observations, Values, Mask, Mask, Infos]:
        # This is the hot path: for few plants, the number of calls determines its speed.
        of_setpoint, of_noise, of_load, of_transmitter = self._signals
        setpoint = of_setpoint.next()
        noise = self._zeros if of_noise is None else of_noise.next()
        load = None if of_load is None else of_load.next()
        command, applied, output = self._plants.step(a, noise, load)
        error = setpoint - output

        error_scale, minus_half, quadratic, move_weight = self._reward_terms
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
        if of_transmitter is not None:
            measured = output + of_transmitter.next()
            measured_error = setpoint - measured
        lowest, highest, squared = self._span
        # If the sum of squares is at most the span squared, no reading is beyond the span.
        if not measured.dot(measured) <= squared:
            measured = np.fmin(measured, highest)  # which turns NaN into the limit
            np.fmax(measured, lowest, out=measured)
            measured_error = setpoint - measured
        observations = self._shown.add(setpoint, measured_error, measured, a)
        if self._records:
            columns = (values.tolist() for values in (setpoint, output, command, applied))
            for i, numbers in enumerate(zip(*columns, strict=True)):
                self._records[i].add(*numbers)

        everyone = self._everyone.copy()
        infos = {  # written out, which is fastest
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
        if self._factor_names:
            for name, factors in zip(self._factor_names, self._plants.factors, strict=True):
                infos[name], infos[f"_{name}"] = factors.copy(), everyone
        return observations, rewards, self._nobody.copy(), self._nobody.copy(), infos

    def _begin(self, mask: Mask) -> dict[str, NDArray[Any]]:
        which, parameters = np.flatnonzero(mask), self.parameters
        numbers = self._ranges.draw([self._streams[i] for i in which.tolist()])
        self._plants.reset(which, numbers)
        setpoint = self._signals.reset(which, self._streams, numbers)
        rest_action = action_from_command(0.0, numbers.u_min, numbers.u_max)
        self._actions[which] = rest_action
        self._shown.reset(which, setpoint, rest_action)
        if self.render_mode is not None:
            for j, i in enumerate(which.tolist()):
                own, interval = plant_numbers(numbers, j), parameters.sampling_interval
                self._records[i] = Record(own, interval, setpoint[j].item())

        first = {"setpoint": setpoint, "error": setpoint}
        first |= numbers.chosen(self._ranges.names)
        of_all = dict(zip(self._factor_names, self._plants.factors, strict=False))
        for name, values in first.items():
            of_all[name] = np.zeros(self.num_envs, values.dtype)
            of_all[name][which] = values
        return of_all

    def _final(self, ended: Mask, observations: Observations) -> NDArray[np.object_]:
        final = np.full(self.num_envs, None, object)
        for i in np.flatnonzero(ended):
            final[i] = observations[i].copy()
        return final

    def _flags(self, mask: Mask) -> Mask:
        return mask.copy()

    def _from_host(self, values: NDArray[Any]) -> NDArray[Any]:
        return values

    def _present_load(self) -> Values:
        disturbance = self._signals.disturbance
        return self._zeros if disturbance is None else disturbance.present

    def _prepare(self, mask: Mask, seed: Any, options: Mapping[str, Any]) -> None:
        n, seeds = self.num_envs, plain(seed)
        if seed is None or is_count(seed):
            seeds = [None] * n if seed is None else range(int(seed), int(seed) + n)
        else:
            fits = isinstance(seeds, list | tuple) and len(seeds) == n
            if not fits or not all(each is None or is_count(each) for each in seeds):
                allowed = f"an integer of at least 0, or a list of {n} of them or None"
                reject("seed", seed, allowed)
        for i in np.flatnonzero(mask).tolist():
            own = seeds[i]
            if own is None and i not in self._streams:
                own = np.random.SeedSequence().entropy
            if own is not None:
                self._seeds[i] = int(own)
                self._streams[i] = Streams.of_seed(int(own))

    def _checked_actions(self, actions: Any) -> Values:
        return many_actions(actions, self.num_envs, self._ended)


class _Window:
    """The observations of all plants.

    They lie in a row, one after another, from a place that moves back by one each step. So all
    blocks of samples shift by one, and only their first elements have to be written.
    """

    def __init__(self, windows: Sequence[int], num_envs: int) -> None:
        heads = np.cumsum([0, *windows[:-1]]).tolist()
        # Of each block with samples: its number, and the place of the newest one.
        self._newest = [(i, np.s_[:, heads[i]]) for i, window in enumerate(windows) if window]
        self._actions = np.s_[:, heads[-1] :]
        self._shape = num_envs, sum(windows)
        self._elements = num_envs * sum(windows)
        self._row = np.zeros(self._elements + STEPS_PER_SHIFT, np.float32)
        self._place = STEPS_PER_SHIFT

    def present(self) -> Observations:
        """Return the current observations."""
        return self._view().copy()

    def _view(self) -> Observations:
        return self._row[self._place : self._place + self._elements].reshape(self._shape)

    def reset(self, which: Indices, setpoint: Values, rest_action: Values) -> None:
        """Begin an episode of some plants at rest, with y_d(0) and the action of no flow."""
        rest = np.zeros((len(which), self._shape[1]), np.float32)
        rest[self._actions] = np.reshape(np.clip(rest_action, -1.0, 1.0), (-1, 1))
        for i, newest in self._newest:
            if i < 2:  # set points and errors
                rest[newest] = setpoint
        self._view()[which] = rest

    def add(self, *samples: Values) -> Observations:
        """Add set points, errors, outputs and actions, and return the observations."""
        if self._place == 0:
            self._row[STEPS_PER_SHIFT:] = self._row[:-STEPS_PER_SHIFT]
            self._place = STEPS_PER_SHIFT
        self._place -= 1
        window = self._row[self._place : self._place + self._elements].reshape(self._shape)
        for i, newest in self._newest:
            window[newest] = samples[i] if i < 3 else samples[i].clip(-1.0, 1.0)
        return window.copy()
