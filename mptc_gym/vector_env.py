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
from mptc_gym.draws import Ranges, Streams, plant_numbers
from mptc_gym.env import NO_MODE, Frame, MiddlePointEnv
from mptc_gym.parameters import spelt_out
from mptc_gym.plant import PlantBatch, action_from_command
from mptc_gym.record import Record
from mptc_gym.signals import BLOCK, Indices, Signals, Values

Observations = NDArray[np.float32]  # shape (num_envs, size)

NOISE_BYTES = 1 << 27  # largest block of noise, unless a single sample of all plants takes more
STEPS_PER_SHIFT = 64  # steps after which the window of observations is moved back


class MiddlePointVectorEnv(BatchEnv, VectorEnv[Any, Any, Any]):  # skrl inspects the bases
    """n plants that advance together: `gymnasium.make_vec("MiddlePoint-v0", num_envs=n)`.

    Given the same seed, `reset` and `step` return bit for bit the same as Gymnasium's
    `SyncVectorEnv` of n `MiddlePointEnv`. See `MiddlePointEnv` for the plant, the spaces, the
    reward, the infos and the arguments.

    Parameters
    ----------
    num_envs
        Number n of plants, at most 10 million.
    max_episode_steps
        Samples after which an episode is truncated; None or -1 for no limit.
    autoreset_mode
        An `AutoresetMode` or its value. "NextStep": the step after the end of an episode resets
        the plant, and the action of this step is ignored. "SameStep": the step that ends an
        episode resets the plant, and the infos of this step hold the last observation and info
        of the episode as `final_obs` and `final_info`. "Disabled": the caller resets plants
        whose episode has ended, with `reset(options={"reset_mask": mask})`.
    render_mode
        None, or "rgb_array": `render` returns a picture of each plant.
    **arguments
        The arguments of `MiddlePointEnv`. All plants have the same arguments, but where an
        argument is a range, every plant draws its own number.

    Raises
    ------
    ValueError
        If an argument is out of range; the message names the argument.
    TypeError
        If an argument is unknown.

    Notes
    -----
    `reset(seed=seed)` restarts the random streams of plant i with seed + i, or with element i
    if the seed is a list. Without a seed, or where the list holds None, the next episode of the
    present streams begins. Rewards are float64, and observations float32.

    All plants share one clock, so that a step is array arithmetic alone. There is a Python loop
    over plants only where every plant draws from its own generators: at the start of an
    episode, once every 600 samples or so of noise, and when a random set point changes. The
    memory that a plant needs, a few KiB, does not grow with the length of an episode.

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
        # Streams and, for pictures, records by the index of the plant, from the first reset on.
        self._streams: dict[int, Streams] = {}
        self._records: dict[int, Record] = {}
        self._seeds: list[int | None] = [None] * num_envs
        self._ranges = Ranges(parameters)
        # Blocks of noise end with an episode. Where many plants would need much memory, the
        # blocks are shorter, which is slower.
        longest = max(1, min(BLOCK, NOISE_BYTES // (8 * num_envs)))
        block = math.ceil(self._limit / math.ceil(self._limit / longest))
        self._signals = Signals.of(parameters, num_envs, block)
        self._plants = PlantBatch(parameters, num_envs)
        self._window = _Window(parameters.windows, num_envs)
        self._actions = np.zeros(num_envs)  # of the last step
        # In comparisons, an array of full length is faster than a number; in other arithmetic,
        # an array of one number is faster.
        self._zeros = np.zeros(num_envs)
        self._all_true = np.ones(num_envs, np.bool_)
        self._all_false = np.zeros(num_envs, np.bool_)
        span = parameters.temperature_span
        self._span = np.full(num_envs, -span), np.full(num_envs, span), span * span
        quadratic = parameters.reward == "quadratic"
        error_scale = np.array(parameters.error_scale)
        self._reward_terms = error_scale, np.array(-0.5), quadratic, parameters.move_weight

    __signature__: ClassVar[inspect.Signature] = spelt_out(__init__)

    @property
    def np_random_seed(self) -> tuple[int | None, ...]:  # type: ignore[override]
        """The seed of each plant; None for each plant before the first reset."""
        return tuple(self._seeds)

    def render(self) -> tuple[Frame, ...] | None:
        """Return a picture of each plant, shape (540, 960, 3); see `MiddlePointEnv.render`.

        Without a render mode, return None, after a warning.
        """
        if self.render_mode is None:
            logger.warn(NO_MODE)
            return None
        if not self._records:
            raise ResetNeeded("call reset before render")
        from mptc_gym import drawing  # which needs pygame

        return tuple(map(drawing.frame, self._records.values()))

    def _advance(self, a: Values) -> tuple[Observations, Values, Mask, Mask, Infos]:
        # The speed of the environment depends on this method: for few plants, on its number of
        # calls.
        signals = self._signals
        setpoint = signals.setpoint.next()
        noise = self._zeros
        if signals.noise is not None:
            noise = signals.noise.next()
        load = None
        if signals.disturbance is not None:
            load = signals.disturbance.next()
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

        measured = output
        measured_error = error
        if signals.measurement_noise is not None:
            measured = output + signals.measurement_noise.next()
            measured_error = setpoint - measured
        lowest, highest, squared_span = self._span
        # If the sum of squares is at most the span squared, no reading is beyond the span.
        if not measured.dot(measured) <= squared_span:
            measured = np.fmin(measured, highest)  # which turns NaN into the limit
            np.fmax(measured, lowest, out=measured)
            measured_error = setpoint - measured
        observations = self._window.add(setpoint, measured_error, measured, a)
        if self._records:
            columns = (values.tolist() for values in (setpoint, output, command, applied))
            for i, sample in enumerate(zip(*columns, strict=True)):
                self._records[i].add(*sample)

        mask = self._all_true.copy()
        infos = {  # written out, which is fastest
            "output": output.copy(),
            "_output": mask,
            "setpoint": setpoint.copy(),
            "_setpoint": mask,
            "error": error,
            "_error": mask,
            "command": command,
            "_command": mask,
            "applied": applied,
            "_applied": mask,
            "noise": noise.copy(),
            "_noise": mask,
        }
        if load is not None:
            infos["disturbance"] = load.copy()
            infos["_disturbance"] = mask
        for name, factors in self._plants.factors.items():
            infos[name] = factors.copy()
            infos[f"_{name}"] = mask
        return observations, rewards, self._all_false.copy(), self._all_false.copy(), infos

    def _begin(self, mask: Mask) -> dict[str, NDArray[Any]]:
        which = np.flatnonzero(mask)
        numbers = self._ranges.draw([self._streams[i] for i in which.tolist()])
        self._plants.reset(which, numbers)
        setpoint = self._signals.reset(which, self._streams, numbers)
        rest_action = action_from_command(0.0, numbers.u_min, numbers.u_max)
        self._actions[which] = rest_action
        self._window.reset(which, setpoint, rest_action)
        if self.render_mode is not None:
            interval = self.parameters.sampling_interval
            for place, i in enumerate(which.tolist()):
                numbers_of_plant = plant_numbers(numbers, place)
                self._records[i] = Record(numbers_of_plant, interval, setpoint[place].item())

        infos: dict[str, NDArray[Any]] = {**self._plants.factors}
        infos_of_which = {"setpoint": setpoint, "error": setpoint}
        infos_of_which |= numbers.chosen(self.parameters.ranges)
        for name, values in infos_of_which.items():
            infos[name] = np.zeros(self.num_envs, values.dtype)
            infos[name][which] = values
        return infos

    def _final(self, ended: Mask, observations: Observations) -> NDArray[np.object_]:
        final_observations = np.full(self.num_envs, None, object)
        for i in np.flatnonzero(ended):
            final_observations[i] = observations[i].copy()
        return final_observations

    def _as_array(self, values: NDArray[Any]) -> NDArray[Any]:
        return values.copy()

    def _hidden_state(self) -> tuple[dict[str, Values], Values]:
        load = self._zeros
        if self._signals.disturbance is not None:
            load = self._signals.disturbance.present
        return self._plants.numbers.chosen(self.parameters.ranges), load

    def _prepare(self, mask: Mask, seed: Any, options: Mapping[str, Any]) -> None:
        seeds = self._checked_seeds(seed)
        for i in np.flatnonzero(mask).tolist():
            seed_of_plant = seeds[i]
            if seed_of_plant is None and i not in self._streams:
                seed_of_plant = np.random.SeedSequence().entropy
            if seed_of_plant is not None:
                self._seeds[i] = int(seed_of_plant)
                self._streams[i] = Streams.of_seed(int(seed_of_plant))

    def _checked_seeds(self, seed: Any) -> Sequence[Any]:
        """Return the seed of each plant, which is None for plants whose streams continue."""
        n = self.num_envs
        if seed is None:
            return [None] * n
        if is_count(seed):
            return range(int(seed), int(seed) + n)
        seeds = plain(seed)
        is_list = isinstance(seeds, list | tuple) and len(seeds) == n
        if not is_list or not all(element is None or is_count(element) for element in seeds):
            allowed = f"None, an integer of at least 0, or a list of {n} such values"
            reject("seed", seed, allowed)
        return list(seeds)

    def _checked_actions(self, actions: Any) -> Values:
        return many_actions(actions, self.num_envs, self._ended)


class _Window:
    """The observations of all plants.

    An observation has four blocks: set points, errors, outputs and actions, each with the
    newest first; `windows` are the sizes of these blocks. The observations lie one after
    another in a row of memory, from a place that moves back by one element at each step. So the
    samples of all blocks shift by one without being copied, and only the first element of each
    block has to be written.
    """

    def __init__(self, windows: Sequence[int], num_envs: int) -> None:
        heads = np.cumsum([0, *windows[:-1]]).tolist()
        # Indices of the newest sample of a block in all observations; None for an empty block.
        self._setpoints, self._errors, self._outputs, self._actions = (
            np.s_[:, head] if window else None
            for head, window in zip(heads, windows, strict=True)
        )
        self._all_actions = np.s_[:, heads[-1] :]
        self._shape = num_envs, sum(windows)
        self._elements = num_envs * sum(windows)
        self._row = np.zeros(self._elements + STEPS_PER_SHIFT, np.float32)
        self._place = STEPS_PER_SHIFT  # of the first observation in the row

    def present(self) -> Observations:
        """Return a copy of the present observations, shape (n, size)."""
        return self._view().copy()

    def _view(self) -> Observations:
        return self._row[self._place : self._place + self._elements].reshape(self._shape)

    def reset(self, which: Indices, setpoint: Values, rest_action: Values) -> None:
        """Begin an episode of some plants at rest.

        `which` are the indices of these plants, `setpoint` is y_d(0), degC, and `rest_action`
        is the action for u = 0; both have the shape (len(which),), or () for all plants.
        """
        observations = np.zeros((len(which), self._shape[1]), np.float32)
        observations[self._all_actions] = np.reshape(np.clip(rest_action, -1.0, 1.0), (-1, 1))
        if self._setpoints is not None:
            observations[self._setpoints] = setpoint
        if self._errors is not None:
            observations[self._errors] = setpoint
        self._view()[which] = observations

    def add(
        self, setpoint: Values, error: Values, output: Values, action: Values
    ) -> Observations:
        """Add a sample of all plants, and return the observations, shape (n, size).

        The arguments have the shape (n,): y_d, the measured error and output, degC, and a.
        """
        if self._place == 0:
            self._row[STEPS_PER_SHIFT:] = self._row[:-STEPS_PER_SHIFT]
            self._place = STEPS_PER_SHIFT
        self._place -= 1
        observations = self._view()
        if self._setpoints is not None:
            observations[self._setpoints] = setpoint
        if self._errors is not None:
            observations[self._errors] = error
        if self._outputs is not None:
            observations[self._outputs] = output
        if self._actions is not None:
            observations[self._actions] = action.clip(-1.0, 1.0)
        return observations.copy()
