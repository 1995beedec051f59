"""Simulate many plants side by side in NumPy, as a Gymnasium vector environment."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from gymnasium import logger
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from mptc_gym.batch import BatchEnv, Infos, Mask
from mptc_gym.env import INFO, NO_RENDER_MODE, Frame, MiddlePointEnv
from mptc_gym.plant.actuator import WantedFlows, action_from_command
from mptc_gym.plant.checks import is_count, many_actions, one_of, reject, to_python
from mptc_gym.plant.dynamics import PlantBatch
from mptc_gym.plant.parameters import EPISODE_STEPS, Parameters, full_signature
from mptc_gym.plant.sampling import PlantSampler, RandomStreams, plant_numbers
from mptc_gym.plant.signals import Indices, Signals, Values
from mptc_gym.record import Record

Observations = NDArray[np.float32]  # shape (num_envs, size)

# Number of steps after which all observations are moved in memory, so rarely that the moves
# take little time. The moves need memory for one more element per step.
STEPS_PER_SHIFT = 64


class MiddlePointVectorEnv(BatchEnv, VectorEnv[Any, Any, Any]):  # skrl inspects the bases
    """n plants that advance together: `gymnasium.make_vec("MiddlePoint-v0", num_envs=n)`.

    For the same seed, `reset` and `step` of `MiddlePointVectorEnv` return the same results, bit
    for bit, as `reset` and `step` of Gymnasium's `SyncVectorEnv` with n `MiddlePointEnv`. The
    docstring of `MiddlePointEnv` describes the plant, the spaces, the reward, the infos and the
    arguments.

    Parameters
    ----------
    num_envs
        Number n of plants.
    max_episode_steps
        Number of samples after which an episode is truncated; None or -1 for no limit.
    autoreset_mode
        When to reset a plant whose episode has ended: an `AutoresetMode` of Gymnasium, or the
        value of an `AutoresetMode`, as a string. "NextStep": the step after the end of an
        episode resets the plant, and ignores the action for this plant. "SameStep": the step
        that ends an episode also resets the plant; `final_obs` and `final_info` in the infos
        hold the last observation and info of the episode. "Disabled": the caller resets each
        plant whose episode has ended, with `reset(options={"reset_mask": mask})`.
    render_mode
        Render mode: None, or "rgb_array", with which `render` returns one picture per plant.
    **arguments
        The arguments of `MiddlePointEnv`. All plants have the same arguments; if an argument is
        a range, each reset of a plant samples a number for this plant.

    Raises
    ------
    ValueError
        If the value of an argument is not allowed; the message of the error names the argument.
    TypeError
        If an argument is unknown.

    Notes
    -----
    `reset(seed=seed)` restarts the random number streams of plant i with seed + i, or with
    element i of the seed if the seed is a list. The streams of a plant without a seed, or with
    the seed None, continue with the next episode. Rewards are float64, and observations
    float32.

    A step uses array arithmetic only, except when each plant draws random numbers from a
    separate generator: at the start of an episode, and about every 600 samples. Noise, load,
    measurement noise and random set points of these samples take 5 KiB each for a plant, but at
    most 256 MiB for all plants: with all four, more than 14,000 plants draw more often. The
    memory does not grow with the length of an episode.

    With an unstable polynomial `a`, the temperature may overflow. With actions beyond +-1e154,
    squared actions and commanded flows may overflow, but the actuator limits the applied flow.
    NumPy warns of an overflow in `MiddlePointVectorEnv`; `MiddlePointEnv` gives no warning.
    """

    metadata: dict[str, Any] = MiddlePointEnv.metadata | {"render_modes": ["rgb_array"]}
    _where = staticmethod(np.where)
    _as_array = staticmethod(np.array)  # which copies an array

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
        # Random number streams and, if pictures are wanted, records of episodes, by index of
        # the plant. Both dicts are empty before the first reset.
        self._streams: dict[int, RandomStreams] = {}
        self._records: dict[int, Record] = {}
        self._seeds: list[int | None] = [None] * num_envs
        self._plant_sampler = PlantSampler(parameters)
        self._signals = Signals.of(parameters, num_envs, self._episode_length)
        self._plants = PlantBatch(parameters, num_envs)
        self._wanted_flows: WantedFlows | None = None
        if parameters.action == "change":
            # The wanted flows before k = 0 are zeros.
            self._wanted_flows = WantedFlows(parameters, np.zeros(num_envs))
        self._window = _Window(parameters.windows, num_envs)
        self._last_actions = np.zeros(num_envs)
        # In comparisons, an array of shape (num_envs,) is faster than a Python number. In other
        # arithmetic, an array of shape () is faster than a Python number.
        self._zeros = np.zeros(num_envs)
        self._all_true = np.ones(num_envs, np.bool_)
        self._all_false = np.zeros(num_envs, np.bool_)
        self._error_scale = np.array(parameters.error_scale)
        self._minus_half = np.array(-0.5)  # factor of the quadratic reward

    __signature__: ClassVar[inspect.Signature] = full_signature(__init__)

    @property
    def np_random_seed(self) -> tuple[int | None, ...]:  # type: ignore[override]
        """The seed of each plant's random number streams; None before the first reset."""
        return tuple(self._seeds)

    def render(self) -> tuple[Frame, ...] | None:
        """Return one picture per plant, uint8, of shape (540, 960, 3): rows, columns, RGB.

        Without a render mode, `render` warns and returns None.

        Raises
        ------
        ResetNeeded
            If the environment has a render mode, and `render` is called before the first
            `reset`.
        """
        if self.render_mode is None:
            logger.warn(NO_RENDER_MODE)
            return None
        if not self._records:
            raise ResetNeeded("call reset before render")
        from mptc_gym import rendering  # which needs pygame, an optional package

        return tuple(map(rendering.frame, self._records.values()))

    def _advance(self, a: Values) -> tuple[Observations, Values, Mask, Mask, Infos]:
        """Move all plants by one sample, and return what `step` returns if no episode ends."""
        # The speed of the environment depends on `_advance`. With few plants, the number of
        # NumPy calls in `_advance` determines the speed.
        if self._wanted_flows is not None:
            # From here on, the actions are those that command the changed flows.
            a = self._wanted_flows.change(a)
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
        rewards = self._rewards(error, a)
        reading = self._readings(output)
        observed_error = error
        if reading is not output:  # it is `output` itself without noise and saturation
            observed_error = setpoint - reading
        observations = self._window.add(setpoint, observed_error, reading, a)
        self._last_actions = a
        mask = self._all_true.copy()
        # Copies of arrays that signals and plants use again, written out entry by entry, which
        # is faster than a loop.
        infos = {
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
        if self._records:
            columns = (infos[name].tolist() for name in INFO)
            for i, values in enumerate(zip(*columns, strict=True)):
                self._records[i].add(dict(zip(INFO, values, strict=True)))
        return observations, rewards, self._all_false.copy(), self._all_false.copy(), infos

    def _rewards(self, error: Values, a: Values) -> Values:
        """Return the rewards of errors e(k+1), degC, and actions a(k), all of shape (n,)."""
        rewards: Values = error / self._error_scale
        if self.parameters.reward == "quadratic":
            # The paper's cost, equation (12), scaled and negated.
            rewards *= rewards
            rewards *= self._minus_half
        else:
            rewards = -np.abs(rewards)
        move_weight = self.parameters.move_weight
        if move_weight:
            rewards -= move_weight * np.abs(a - self._last_actions)
        return rewards

    def _readings(self, output: Values) -> Values:
        """Return the transmitter's readings of the temperatures `output`, degC, shape (n,).

        A reading is the temperature plus measurement noise, limited to +-`temperature_span`.
        Without measurement noise and saturation, the returned array may be `output` itself.
        """
        reading = output
        if self._signals.measurement_noise is not None:
            reading = output + self._signals.measurement_noise.next()
        # One test for all plants, which is fast: if the sum of the squared readings is at most
        # the squared span, no reading is beyond the span.
        span = self.parameters.temperature_span
        if not reading.dot(reading) <= span * span:  # not `>`, which is false for NaN
            reading = np.fmin(reading, span)  # NaN becomes the highest reading
            np.fmax(reading, -span, out=reading)
        return reading

    def _begin(self, mask: Mask) -> dict[str, NDArray[Any]]:
        """Begin an episode of the plants in `mask`, and return the infos that are not 0.

        Elements of the infos for plants outside `mask` have no meaning.
        """
        which = np.flatnonzero(mask)  # the indices of the plants
        streams = [self._streams[i] for i in which.tolist()]
        numbers = self._plant_sampler.sample(streams)
        self._plants.reset(which, numbers)
        if self._wanted_flows is not None:
            self._wanted_flows.reset(which)
        setpoint = self._signals.reset(which, streams, numbers)
        rest_action = action_from_command(0.0, numbers.u_min, numbers.u_max)
        self._last_actions[which] = rest_action
        self._window.reset(which, setpoint, rest_action)
        if self.render_mode is not None:
            interval = self.parameters.sampling_interval
            for place, i in enumerate(which.tolist()):
                numbers_of_plant = plant_numbers(numbers, place)
                self._records[i] = Record.at_rest(
                    numbers_of_plant, interval, setpoint[place].item()
                )

        infos: dict[str, NDArray[Any]] = {**self._plants.factors}
        new_values = {"setpoint": setpoint, "error": setpoint}
        new_values |= numbers.select(self.parameters.ranges)  # what this reset has sampled
        for name, values in new_values.items():
            infos[name] = np.zeros(self.num_envs, values.dtype)
            infos[name][which] = values
        return infos

    def _final_observations(
        self, ended: Mask, observations: Observations
    ) -> NDArray[np.object_]:
        """Return the rows of `observations` for the plants `ended`, and None for others."""
        final_observations = np.full(self.num_envs, None, object)
        for i in np.flatnonzero(ended):
            final_observations[i] = observations[i].copy()
        return final_observations

    def _prepare(self, mask: Mask, seed: Any) -> None:
        """Restart the random number streams of the plants in `mask` that have a seed.

        A ValueError is raised if `seed` is invalid.
        """
        seeds = self._checked_seeds(seed)
        for i in np.flatnonzero(mask).tolist():
            seed_of_plant = seeds[i]
            if seed_of_plant is None and i not in self._streams:  # at the first reset
                seed_of_plant = np.random.SeedSequence().entropy  # from the operating system
            if seed_of_plant is not None:
                self._seeds[i] = int(seed_of_plant)
                self._streams[i] = RandomStreams.of_seed(int(seed_of_plant))

    def _checked_seeds(self, seed: Any) -> Sequence[Any]:
        """Return a seed or None for each plant; plant i of an integer seed gets seed + i.

        A ValueError is raised if `seed` is invalid.
        """
        n = self.num_envs
        if seed is None:
            return [None] * n
        if is_count(seed):
            return range(int(seed), int(seed) + n)
        seeds = to_python(seed)
        is_list = isinstance(seeds, list | tuple) and len(seeds) == n
        if not is_list or not all(element is None or is_count(element) for element in seeds):
            allowed = f"None, an integer of at least 0, or a list of {n} such values"
            reject("seed", seed, allowed)
        return list(seeds)

    def _checked_actions(self, actions: Any) -> Values:
        """Return the actions, shape (num_envs,), with 0 for plants whose episode has ended.

        A ValueError is raised if the shape is not (num_envs, 1), or an action not finite.
        """
        return many_actions(actions, self.num_envs, self._ended)


def make_vector_env(
    num_envs: int = 1, *, max_episode_steps: int | None = None, **arguments: Any
) -> MiddlePointVectorEnv:
    """Return many environments; the entry point of `gymnasium.make_vec`.

    The arguments are those of `MiddlePointVectorEnv`, but None stands for the registered number
    of samples of an episode, as in `gymnasium.make`.
    """
    if max_episode_steps is None:
        max_episode_steps = EPISODE_STEPS
    return MiddlePointVectorEnv(num_envs, max_episode_steps=max_episode_steps, **arguments)


def parameters_of(env: Any) -> Parameters:
    """Return the arguments of the first plant in a vector environment or a `VecEnv`.

    A ValueError is raised if `env` is not of this package, or is in PyTorch.
    """
    if isinstance(env.unwrapped, MiddlePointVectorEnv):
        return env.unwrapped.parameters
    try:
        parameters = env.get_attr("parameters")[0]  # an element for each plant, all alike
    except AttributeError:  # no such attribute, or no `get_attr`, as in PyTorch
        parameters = None
    if not isinstance(parameters, Parameters):
        reject("env", env, "of mptc_gym and in NumPy, such as an id or a spec of it")
    return parameters


class _Window:
    """The latest observations of n plants, stored so that a new sample needs little copying.

    An observation joins four blocks: set points, errors, outputs and past actions, each block
    with the newest sample first. `windows` holds the numbers of set points, errors, outputs and
    past actions in an observation.

    One 1-D array holds the observations of all plants, one observation after the other. At each
    step, the index in this array at which the first observation begins decreases by 1. Without
    any copying, each old sample then lies one element later in the observation of its plant,
    and the new sample replaces the first element of each block.
    """

    def __init__(self, windows: Sequence[int], num_envs: int) -> None:
        # For each block, the index of the newest sample in the observations of all plants; None
        # for a block of size 0.
        self._newest: list[tuple[slice, int] | None] = []
        size = 0
        for window in windows:
            self._newest.append(np.s_[:, size] if window else None)
            size += window
        self._past_actions = np.s_[:, size - windows[-1] :]  # the last block
        self._shape = num_envs, size
        self._elements = num_envs * size
        # With room for so many steps, after which `add` moves the observations back to the end.
        self._row = np.zeros(self._elements + STEPS_PER_SHIFT, np.float32)
        self._place = STEPS_PER_SHIFT  # index in `_row` at which the first observation begins

    def present(self) -> Observations:
        """Return a copy of the present observations, shape (n, size)."""
        return self._view().copy()

    def _view(self) -> Observations:
        """Return the present observations, shape (n, size), without copying them."""
        return self._row[self._place : self._place + self._elements].reshape(self._shape)

    def reset(self, which: Indices, setpoint: Values, rest_action: Values) -> None:
        """Set the observations of the plants `which` at sample k = 0, with the plants at rest.

        `setpoint` holds the set points y_d(0) of the plants `which`, degC, shape (len(which),).
        `rest_action` holds the actions that command 0 t/h, shape (len(which),), or shape () for
        one action for all plants.
        """
        observations = np.zeros((len(which), self._shape[1]), np.float32)
        observed_action = np.clip(rest_action, -1.0, 1.0)
        observations[self._past_actions] = np.reshape(observed_action, (-1, 1))
        setpoints, errors, _, _ = self._newest  # outputs stay 0
        if setpoints is not None:
            observations[setpoints] = setpoint
        if errors is not None:
            observations[errors] = setpoint  # the temperature is 0
        self._view()[which] = observations

    def add(
        self, setpoint: Values, error: Values, output: Values, action: Values
    ) -> Observations:
        """Add a sample of each plant to the observations, and return a copy, shape (n, size).

        The sample consists of set points y_d(k+1), observed errors and outputs, all in degC,
        and normalised actions a(k), each of shape (n,).
        """
        if self._place == 0:  # no element of the row is left before the first observation
            self._row[STEPS_PER_SHIFT:] = self._row[:-STEPS_PER_SHIFT]
            self._place = STEPS_PER_SHIFT
        self._place -= 1
        observations = self._view()
        setpoints, errors, outputs, actions = self._newest
        if setpoints is not None:
            observations[setpoints] = setpoint
        if errors is not None:
            observations[errors] = error
        if outputs is not None:
            observations[outputs] = output
        if actions is not None:
            observations[actions] = action.clip(-1.0, 1.0)
        return observations.copy()
