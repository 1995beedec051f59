"""Simulate many plants at once in PyTorch, on any device, optionally with gradients."""

from __future__ import annotations

import inspect
import math
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, ClassVar, NamedTuple, cast

from gymnasium.envs.registration import EnvSpec
from gymnasium.error import DependencyNotInstalled
from gymnasium.vector import AutoresetMode

try:
    import torch
except ImportError as error:
    raise DependencyNotInstalled(
        'mptc_gym.torch_env needs PyTorch: pip install "mptc_gym[torch]"'
    ) from error
from numpy.typing import NDArray
from torch import Tensor

from mptc_gym.batch import BatchEnv, Infos, Mask
from mptc_gym.env import MiddlePointEnv
from mptc_gym.environments.making import make_one
from mptc_gym.plant.checks import is_count, one_of, reject
from mptc_gym.plant.dynamics import FACTORS, action_from_command
from mptc_gym.plant.parameters import ARGUMENTS, full_signature
from mptc_gym.plant.signals import SetPointLevels
from mptc_gym.torch_env.episodes import (
    MOST_BLOCK_SAMPLES,
    SIGNAL_NAMES,
    Episodes,
    ExternalValues,
    Restart,
    as_tensor,
    copy_to_device,
    read_external,
)
from mptc_gym.torch_env.plant import TorchPlants
from mptc_gym.torch_env.signals import make_signals
from mptc_gym.torch_env.window import Window

# Number of values in a block of a signal on a CPU, at most, if a block has several samples:
# 512 KiB of float32 fit in the cache.
_NUMBERS_IN_CACHE = 1 << 17


class _Step(NamedTuple):
    """Results of one future `step` that do not depend on the action of that step."""

    rewards: Tensor  # without the cost of moves, shape (n,)
    terminations: Tensor  # shape (n,)
    truncations: Tensor  # shape (n,)
    infos: Infos  # without commanded and applied flows
    load: Tensor  # load w, degC, shape (n,), for `plant_state`


class MiddlePointTorchEnv(BatchEnv):
    """Vector environment of n plants, with PyTorch tensors as observations and actions.

    `MiddlePointTorchEnv` has the plant, the spaces, the reward, the infos and the arguments of
    `MiddlePointEnv`, and resets plants as `MiddlePointVectorEnv` does. With the same signals
    and actions, `MiddlePointTorchEnv` and `MiddlePointVectorEnv` return the same values up to
    rounding.

    Use `MiddlePointTorchEnv` to train on a GPU, on thousands of noisy plants, or with gradients
    through the plant. On a CPU, a small number of plants runs faster in NumPy, with
    `gymnasium.make_vec("MiddlePoint-v0", num_envs=n)`.

    Parameters
    ----------
    num_envs, max_episode_steps, autoreset_mode
        As in `MiddlePointVectorEnv`. In `MiddlePointTorchEnv`, `final_obs` is a tensor, with
        zeros for plants whose episode has not ended.
    device
        PyTorch device of all computations and tensors.
    dtype
        Type of all computations and of the observations: torch.float32 or torch.float64. The
        action space and the observation space are always float32.
    differentiable
        Whether observations, rewards and infos have gradients with respect to the actions of
        the present step and of earlier steps.
    **arguments
        Keyword arguments of `MiddlePointEnv`, except `render_mode`. All plants have the same
        arguments. If an argument is a range, every plant draws its own value from the range.

    Attributes
    ----------
    autoreset_mode : AutoresetMode
        When to reset a plant whose episode has ended, as in `MiddlePointVectorEnv`.
    checks_actions : bool
        Whether `step` raises a ValueError for actions that are not finite: True by default on a
        CPU, and False on other devices.

    Raises
    ------
    ValueError
        If an argument is out of range; the message names the argument.
    TypeError
        If an argument is unknown.

    Notes
    -----
    **Random numbers.** All random numbers come from one `torch.Generator` on the device, which
    `reset(seed=seed)` restarts. The same seed, arguments and resets give the same numbers on
    the same device, with the same versions of this package and of PyTorch.
    `MiddlePointTorchEnv` and `MiddlePointVectorEnv` draw different values from equal
    distributions. In `MiddlePointTorchEnv`, the j-th episode of a plant depends on the lengths
    of earlier episodes and on the other plants. To compare controllers on equal episodes, use
    `MiddlePointVectorEnv` or external signals.

    **External signals.** `reset(options={"signals": signals})` replaces signals of the
    environment by the tensors in the dict `signals`. The signals "noise" (the noise n),
    "setpoint" (the set point y_d), "disturbance" (the load w) and "measurement_noise", in degC,
    have the shape (samples, num_envs): row k holds sample k. The dict `signals` may contain
    values of any argument that is a range, shape (num_envs,), under the name of the argument.
    Every tensor in the dict `signals` may have a leading dimension of episodes: the j-th
    episode of a plant uses element j, and after the last element, the first element again. The
    environment generates all signals, and draws all values of ranges, that `signals` does not
    contain. `step` raises a ValueError if the step leads beyond the last sample of an external
    signal.

    **Gradients.** The gradient of rewards and observations with respect to actions ignores the
    dead zone: a policy can learn from commands in the dead zone, although the true gradient of
    these commands is 0. The applied flow has the gradient 0 beyond the actuator's limits, and
    the measured temperature has the gradient 0 beyond the transmitter's span. `detach` cuts the
    gradient graph for truncated backpropagation. An action affects the temperature after
    `delay` + 1 samples, so fewer samples than that between two calls of `detach` give no
    gradient through the plant. If `differentiable` is False, the environment keeps no gradient
    graph of actions. A copy or a pickle of the environment, even in the middle of an episode,
    has no gradient graph of earlier actions.

    **Waiting.** If the actions are a tensor on the device, `step` does not wait for the device
    to finish its computations. As a check of the actions would wait for the device, `step`
    raises a ValueError for actions that are not finite only on a CPU. On devices other than a
    CPU, a plant whose action is not finite may have the temperature NaN until the plant is
    reset. `reset` may wait for the device to finish its computations.

    **Memory.** The caller may keep or overwrite the tensors that `step` returns, except the
    masks and the drift factors in the infos, which several steps may share. Tensors that
    several steps return may share a block of memory, which is freed when no variable refers to
    any of these tensors. In memory, the observations, shape (num_envs, size), are contiguous by
    column, not by row.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (as in VectorEnv)
    _where = staticmethod(torch.where)

    def __init__(
        self,
        num_envs: int,
        *,
        device: str | torch.device = "cpu",
        dtype: torch.dtype = torch.float32,
        max_episode_steps: int | None = 1200,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        differentiable: bool = False,
        **arguments: Any,
    ) -> None:
        """Prepare the plants; the docstring of the class describes the arguments."""
        one_of("render_mode", arguments.pop("render_mode", None), [None])
        super().__init__(num_envs, max_episode_steps, autoreset_mode, arguments)
        if self.parameters.action != "flow":
            reject("action", self.parameters.action, "'flow' in this environment")
        if not isinstance(dtype, torch.dtype) or dtype not in (torch.float32, torch.float64):
            reject("dtype", dtype, "torch.float32 or torch.float64")
        if not isinstance(differentiable, bool):
            reject("differentiable", differentiable, "True or False")
        try:
            self.device = torch.device(device)
            self._zeros = torch.zeros(num_envs, dtype=dtype, device=self.device)
            torch.Generator(self.device)  # fails on "meta", which has tensors without values
        except (AssertionError, RuntimeError, TypeError, ValueError) as error:
            reject("device", device, f"a device that PyTorch can use ({error})")
        self.dtype = dtype
        self.differentiable = differentiable
        self.checks_actions = self.device.type == "cpu"
        # The actions of the last step, shape (n,), kept only if the reward has a cost of moves.
        self._action = self._zeros

        self._episodes = Episodes(self.parameters, self._zeros)
        self._plants = TorchPlants(self.parameters, self._episodes)
        self._window = Window(self.parameters.windows, self._zeros)
        self._load = self._zeros  # the load w at the present sample, degC, shape (n,)
        self._own_signals = make_signals(self.parameters, self._episodes)
        self._signals = self._own_signals  # own or external signals, by name
        self._external: dict[str, ExternalValues] = {}  # external signals and parameter values
        # The last sample number k for which all external signals have a value; None if there
        # are no external signals.
        self._last_sample: int | None = None
        # On a CPU, a block of samples should fit in the processor's cache. On other devices,
        # blocks are as long as possible, since every call of PyTorch takes long.
        self._most_samples = min(MOST_BLOCK_SAMPLES, self._plants.most_samples)
        if self.device.type == "cpu":
            in_cache = max(1, _NUMBERS_IN_CACHE // num_envs)
            self._most_samples = min(self._most_samples, in_cache)
        levels = SetPointLevels(self.parameters)
        if levels.random:
            self._most_samples = min(self._most_samples, levels.shortest)
        # The results of the steps that remain in the present block, the next step last.
        self._ahead: list[_Step] = []

    __signature__: ClassVar[inspect.Signature] = full_signature(__init__)

    def __deepcopy__(self, memo: dict[int, Any]) -> MiddlePointTorchEnv:
        """Return a copy of the environment, without the gradient graph of earlier actions."""
        duplicate: MiddlePointTorchEnv = pickle.loads(pickle.dumps(self))
        return duplicate

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the state of a pickle, without the gradient graph of earlier actions."""
        vars(self).update(state)
        self.detach()

    def detach(self) -> None:
        """Cut the gradient graph to earlier actions, for truncated backpropagation.

        The tensors that later steps return have gradients only with respect to actions after
        the call of `detach`. The tensors that earlier steps returned remain in the gradient
        graph, so detach the latest observation as well before the policy uses that observation.
        """
        self._plants.detach()
        self._window.detach()
        self._action = self._action.detach()
        for k, step in enumerate(self._ahead):
            infos = {name: values.detach() for name, values in step.infos.items()}
            self._ahead[k] = step._replace(rewards=step.rewards.detach(), infos=infos)

    def _advance(self, a: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Infos]:
        """Advance all plants by one sample, and return what `step` returns if no episode ends.

        `a` holds the actions that `_checked_actions` returned, shape (num_envs,).
        """
        command, applied = self._plants.apply(a)
        if not self._ahead:
            self._compute_block()
        rewards, terminations, truncations, infos, self._load = self._ahead.pop()
        observations = self._window.next(a)
        if self.parameters.move_weight:
            rewards = rewards - self.parameters.move_weight * (a - self._action).abs()
            self._action = a.clone()  # a copy, as the caller may overwrite the actions
        infos["command"] = command
        infos["applied"] = applied
        return observations, rewards, terminations, truncations, infos

    def _compute_block(self) -> None:
        """Compute and store the results and observations of the present and of future steps.

        An action affects the temperature only after the delay, so past actions determine the
        temperatures of a block of successive samples.
        """
        samples_to_next_end = self._next_end - self._clock + 1
        samples = max(1, min(self._most_samples, samples_to_next_end))
        block = self._episodes.block(self._clock, samples)
        signals = {name: signal.next(block) for name, signal in self._signals.items()}
        setpoint = signals["setpoint"]
        noise = signals.get("noise")
        load = signals.get("disturbance")
        output, factors = self._plants.outputs(block, noise, load)
        error = setpoint - output
        reading = output
        if "measurement_noise" in signals:
            reading = output + signals["measurement_noise"]
        span = self.parameters.temperature_span
        reading = reading.clamp(-span, span)
        self._window.extend(setpoint, setpoint - reading, reading)

        # The infos of the block: for each name, a row of shape (n,) for each sample. Set points
        # and loads are copied, as the environment still needs both and the caller may overwrite
        # the infos.
        if noise is None:
            noise = torch.zeros_like(error)
        infos_of_block: dict[str, Sequence[Any]] = {
            "output": output.unbind(),
            "setpoint": setpoint.clone(memory_format=torch.contiguous_format).unbind(),
            "error": error.unbind(),
            "noise": noise.unbind(),
        }
        loads: Sequence[Tensor] = [self._zeros] * samples
        if load is not None:
            loads = load.unbind()
            infos_of_block["disturbance"] = load.clone().unbind()
        if self.parameters.drifts:
            gain_factors, time_constant_factors = zip(*factors, strict=True)
            infos_of_block["gain_factor"] = gain_factors
            infos_of_block["time_constant_factor"] = time_constant_factors

        rewards = self._rewards(error).unbind()
        flags = self._zeros.new_zeros(2 * samples, self.num_envs, dtype=torch.bool).unbind()
        terminations = flags[:samples]
        truncations = flags[samples:]
        everyone = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        masks = {f"_{name}": everyone for name in self._info_names}
        for k in reversed(range(samples)):
            infos = {name: rows[k] for name, rows in infos_of_block.items()}
            step = _Step(rewards[k], terminations[k], truncations[k], infos | masks, loads[k])
            self._ahead.append(step)

    def _rewards(self, error: Tensor) -> Tensor:
        """Return the rewards for control errors, degC, without the cost of changed actions."""
        scale = self.parameters.error_scale
        if self.parameters.reward == "quadratic":
            zero = error.new_zeros(())
            # The paper's cost, equation (12), negated and scaled.
            return torch.addcmul(zero, error, error, value=-0.5 / scale**2)
        return error.abs().mul_(-1.0 / scale)

    def _begin(self, mask: Mask) -> dict[str, Tensor]:
        """Begin an episode of each plant in `mask`, and return infos at sample k = 0.

        The returned dict lacks infos that are always 0 at k = 0, such as `output`. Every info
        is a tensor of shape (num_envs,), whose elements for plants outside `mask` have no
        meaning.
        """
        restart = Restart(self._as_array(mask), unused_rows=len(self._ahead))
        if mask.all():
            # No plant needs past samples. A random signal that replaces an external signal has
            # not computed the latest block, and so has no rows of that block to drop.
            restart = restart._replace(unused_rows=0)
            self.detach()
        self._ahead = []
        first_infos = self._episodes.reset(restart, self._clock, self._starts, self._external)
        self._plants.reset(restart, self._clock - self._episodes.starts)
        first_values: dict[str, Tensor] = {}
        for name, signal in self._signals.items():
            first_values[name] = signal.reset(restart)
        setpoint = first_values["setpoint"]
        self._load = self._load.masked_fill(restart.mask, 0.0)
        numbers = self._episodes.numbers
        rest_action = self._zeros + action_from_command(0.0, numbers["u_min"], numbers["u_max"])
        self._action = torch.where(restart.mask, rest_action, self._action)
        self._window.reset(restart, setpoint, rest_action)
        first_infos["setpoint"] = setpoint
        first_infos["error"] = setpoint
        if self.parameters.drifts:
            first_infos |= {name: self._zeros + numbers[name] for name in FACTORS}
        return first_infos

    def _final_observations(self, ended: Mask, observations: Tensor) -> Tensor:
        """Return `observations`, with 0 in the rows of plants that are not in `ended`.

        `observations` and the returned tensor have the shape (num_envs, size).
        """
        return torch.where(self._as_array(ended)[:, None], observations, 0)

    def _as_array(self, values: NDArray[Any]) -> Tensor:
        """Return a NumPy array of shape (num_envs,) as a new tensor on the device."""
        return copy_to_device(values, self.device)

    def _prepare(self, mask: Mask, seed: Any, options: Mapping[str, Any]) -> None:
        """Check the seed and the options of a `reset`, and apply both.

        `mask` is unused, as all plants share one random number generator. A ValueError is
        raised if the seed is neither None nor an integer from 0 to 2^63 - 1, or if the option
        `signals` is invalid.
        """
        if seed is not None and not (is_count(seed) and seed < 1 << 63):
            reject("seed", seed, "None or an integer from 0 to 2^63 - 1")
        if "reset_mask" in options and "signals" in options:
            raise ValueError(
                "options['signals'] needs a reset of all plants, without reset_mask"
            )
        if "reset_mask" not in options:  # a reset with a mask keeps external signals
            self._external = read_external(options.get("signals"), self.parameters, self._zeros)
            self._signals = {**self._own_signals}
            last_samples: list[int] = []
            for name, values in self._external.items():
                if name in SIGNAL_NAMES:  # other names are arguments, which `Episodes` reads
                    self._signals[name] = values
                    last_samples.append(values.last_sample)
            self._last_sample = min(last_samples, default=None)
        if seed is not None:
            self._episodes.generator.manual_seed(int(seed))
        self._np_random_seed = self._episodes.generator.initial_seed()

    def _checked_actions(self, actions: Any) -> Tensor:
        """Return the actions, shape (num_envs,), with 0 for plants whose episode has ended.

        A ValueError is raised if the actions do not have the shape (num_envs, 1), if an action
        is not finite and `checks_actions` is True, or if an external signal has ended.
        """
        column = actions
        if not (isinstance(actions, Tensor) and actions.dtype is self.dtype):
            column = as_tensor(actions, self._zeros)
        if column is None or column.shape != (self.num_envs, 1):
            reject("actions", actions, f"numbers, shape ({self.num_envs}, 1)")
        if column.requires_grad and not self.differentiable:
            column = column.detach()
        a: Tensor = column.reshape(-1)
        if self._ended is not None:
            a = a.masked_fill(self._as_array(self._ended), 0.0)
        if self.checks_actions:
            # The sum of squares, which is fast, is finite if all actions are finite and none is
            # huge.
            values = a
            if a.requires_grad:
                values = a.detach()
            if not math.isfinite(values.dot(values).item()) and not values.isfinite().all():
                reject("actions", actions, "finite")
        if self._last_sample is not None:
            self._check_signals_go_on(self._last_sample)
        return a

    def _check_signals_go_on(self, last_sample: int) -> None:
        """Raise a ValueError if the next step leads a plant beyond sample k = `last_sample`."""
        ages = self._clock - self._starts
        if self._ended is not None:  # the step resets these plants
            ages = ages[~self._ended]
        if len(ages) and ages.max() >= last_sample:
            raise ValueError(
                f"options['signals'] end at sample {last_sample} of an episode, and the step "
                "leads to a later sample"
            )


def make_vec(env: str | EnvSpec, num_envs: int, **arguments: Any) -> MiddlePointTorchEnv:
    """Make a PyTorch environment from an id or a spec, as `gymnasium.make_vec` does in NumPy.

    Parameters
    ----------
    env
        An id of this package, such as "MiddlePointHard-v0", or an `EnvSpec` without wrappers.
    num_envs
        Number of plants.
    **arguments
        Keyword arguments of `MiddlePointTorchEnv`, which override the arguments of `env`.

    Returns
    -------
    MiddlePointTorchEnv
        Environment of `num_envs` plants. The attribute `spec` of the environment describes one
        plant in NumPy, for calls such as `mptc_gym.evaluate(policy, envs.spec)`.

    Raises
    ------
    ValueError
        If `env` is unknown, is not a `MiddlePointEnv` or has wrappers, or if an argument is out
        of range.
    """
    single_arguments = {name: arguments[name] for name in ARGUMENTS if name in arguments}
    if "max_episode_steps" in arguments:
        limit = arguments["max_episode_steps"]
        single_arguments["max_episode_steps"] = -1 if limit is None else limit
    single = make_one(env, single_arguments)
    plant = single.unwrapped
    spec = cast("EnvSpec", single.spec)
    if not isinstance(plant, MiddlePointEnv) or spec.additional_wrappers:
        reject("env", env, "the id or the spec of a MiddlePointEnv, without wrappers")
    arguments_of_id = asdict(plant.parameters)
    arguments_of_id["max_episode_steps"] = spec.max_episode_steps
    envs = MiddlePointTorchEnv(num_envs, **(arguments_of_id | arguments))
    envs.spec = spec
    return envs
