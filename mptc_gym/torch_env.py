"""Simulate many plants side by side in PyTorch, on any device, optionally with gradients."""

from __future__ import annotations

import inspect
import math
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, ClassVar, cast

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
from mptc_gym.checks import is_count, one_of, reject
from mptc_gym.env import MiddlePointEnv
from mptc_gym.making import make_one
from mptc_gym.parameters import ARGUMENTS, spelt_out
from mptc_gym.plant import action_from_command
from mptc_gym.signals import Levels
from mptc_gym.torch_episodes import (
    LONGEST,
    SIGNALS,
    Episodes,
    Given,
    as_tensor,
    read_signals,
)
from mptc_gym.torch_plant import TorchPlants
from mptc_gym.torch_signals import Signal, make_signals

_IN_CACHE = 1 << 17  # numbers processed at once


class MiddlePointTorchEnv(BatchEnv):
    """n plants that advance together, with observations, actions and rewards in tensors.

    The plant, the spaces, the reward, the infos and the arguments are those of
    `MiddlePointEnv`; resets are those of `MiddlePointVectorEnv`. Given the same signals and
    actions, `reset` and `step` return the same up to rounding.

    Use it to train on a GPU, on thousands of noisy plants, or by gradients through the plant.
    On a CPU, NumPy steps few plants faster: `gymnasium.make_vec("MiddlePoint-v0", num_envs=n)`.

    Parameters
    ----------
    num_envs, max_episode_steps, autoreset_mode
        As for `MiddlePointVectorEnv`. `final_obs` is a tensor, 0 where no episode has ended.
    device
        Device of all computations and tensors.
    dtype
        torch.float32 or torch.float64, for all computations; the spaces say float32.
    differentiable
        Whether observations, rewards and infos carry the graph back to the actions, through
        time; see Gradients.
    **arguments
        Those of `MiddlePointEnv` except `render_mode`, the same for all plants; each draws its
        own from a range.

    Attributes
    ----------
    autoreset_mode : AutoresetMode
        The mode.
    checks_actions : bool
        Whether actions that are not finite are refused; see Waiting.

    Raises
    ------
    ValueError
        If an argument is out of range; the message names it.
    TypeError
        If an argument is unknown.

    Notes
    -----
    **Random numbers.** All come from one `torch.Generator` on the device, which `reset(seed=)`
    restarts: the same seed, arguments and resets give the same numbers on the same device, with
    the same versions of this package and of PyTorch. Their distributions are those of NumPy,
    but the numbers differ, and the j-th episode of a plant depends on the length of earlier
    episodes and on the other plants. So compare controllers in NumPy, or on external signals.

    **External signals.** `reset(options={"signals": signals})` takes a dict of tensors: "noise"
    (n), "setpoint" (y_d), "disturbance" (w) and "measurement_noise", degC, each of shape
    (samples, num_envs), with sample k in row k; and values of arguments that are ranges, by
    name, shape (num_envs,). With a further, leading dimension, the j-th episode of a plant gets
    the j-th element, and after the last the first again. What is not in the dict is drawn. A
    step beyond the last sample raises a ValueError.

    **Gradients.** The gradient goes straight through the dead zone, as if there were none, so a
    policy also learns from commands without effect, whose true gradient is 0. It is 0 beyond
    the actuator's limits and the transmitter's span. `detach` cuts the graph for truncated
    backpropagation. An action shows after `delay` + 1 samples: shorter segments have no
    gradient. Without `differentiable` no graph is kept. A copy or a pickle, also in
    mid-episode, has no graph of earlier actions.

    **Waiting.** `step` never waits for the device. So actions that are not finite are refused
    on the CPU only; elsewhere, the plants that got them show NaN until they are reset. `reset`
    may wait.

    **Memory.** The caller may keep or overwrite what a step returns, but in the infos masks and
    drift factors may be one tensor for several steps. Tensors of several steps may share a
    block of memory, freed with the last of them. Columns of observations are contiguous.
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
        one_of("render_mode", arguments.pop("render_mode", None), [None])
        super().__init__(num_envs, max_episode_steps, autoreset_mode, arguments)
        if not isinstance(dtype, torch.dtype) or dtype not in (torch.float32, torch.float64):
            reject("dtype", dtype, "torch.float32 or torch.float64")
        if not isinstance(differentiable, bool):
            reject("differentiable", differentiable, "True or False")
        try:
            self.device, self.dtype = torch.device(device), dtype
            self._zeros = torch.zeros(num_envs, dtype=dtype, device=self.device)
            torch.Generator(self.device)
        except (AssertionError, RuntimeError, TypeError, ValueError) as error:
            reject("device", device, f"one that PyTorch can use here ({error})")
        self.differentiable = differentiable
        self.checks_actions = self.device.type == "cpu"
        self._action = self._zeros  # of the last step

        self._episodes = Episodes(self.parameters, self._zeros)
        self._plants = TorchPlants(self.parameters, self._episodes)
        self._drawn = make_signals(self.parameters, self._episodes)
        self._given: dict[str, Given] = {}  # signals and plant numbers
        self._last: int | None = None  # last sample that all given signals have
        self._signals: dict[str, Signal] = self._drawn
        # Blocks that fit in the processor's cache or, on other devices, are worth their calls.
        in_cache = max(1, _IN_CACHE // num_envs) if self.device.type == "cpu" else LONGEST
        levels = Levels(self.parameters)
        held = levels.shortest if levels.random else LONGEST
        self._block = min(self._plants.most_samples, LONGEST, in_cache, held)
        # Precomputed returns of the steps ahead, the next one last.
        self._ahead: list[tuple[Any, ...]] = []
        self._shown = _Window(self.parameters.windows, self._episodes, differentiable)
        # w at the samples of the latest block, or at one sample before it.
        self._loads: list[Tensor] = [self._zeros]

    __signature__: ClassVar[inspect.Signature] = spelt_out(__init__)

    def __deepcopy__(self, memo: dict[int, Any]) -> MiddlePointTorchEnv:
        """Return a copy, also in mid-episode, without the graph of earlier actions."""
        duplicate: MiddlePointTorchEnv = pickle.loads(pickle.dumps(self))
        return duplicate

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take the state of a pickle, which has lost the graph of earlier actions."""
        vars(self).update(state)
        self.detach()

    def detach(self) -> None:
        """Cut the graph that leads to earlier actions, for truncated backpropagation.

        What later steps return then depends only on actions after this call. What earlier
        steps have returned stays attached. So detach the latest observation, too, before the
        policy sees it: through it, the next action would depend on earlier ones.
        """
        self._plants.detach()
        self._shown.detach()
        self._action = self._action.detach()
        self._ahead = [
            (*(each.detach() for each in returned), {k: v.detach() for k, v in infos.items()})
            for *returned, infos in self._ahead
        ]

    def _advance(self, a: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Infos]:
        command, applied = self._plants.apply(a)
        if not self._ahead:
            self._compute_block()
        rewards, terminations, truncations, infos = self._ahead.pop()
        observations = self._shown.next(a)
        if self.parameters.move_weight:
            rewards = rewards - self.parameters.move_weight * (a - self._action).abs()
            self._action = a.clone()  # the caller may overwrite it
        infos["command"] = command
        infos["applied"] = applied
        return observations, rewards, terminations, truncations, infos

    def _compute_block(self) -> None:
        """Compute what the next steps return, except what depends on their actions.

        As actions show after the delay, the outputs of a block follow from the actions so far.
        """
        samples = max(1, min(self._block, self._first_end - self._clock + 1))
        self._episodes.clock = self._clock
        signals = {name: each.next(samples) for name, each in self._signals.items()}
        setpoint, noise = signals["setpoint"], signals.get("noise")
        load = signals.get("disturbance")
        output, factors = self._plants.outputs(samples, noise, load)
        error = setpoint - output
        measured = output
        if "measurement_noise" in signals:
            measured = output + signals["measurement_noise"]
        span = self.parameters.temperature_span
        measured = measured.clamp(-span, span)
        self._shown.add(setpoint, setpoint - measured, measured)

        infos = {
            "output": output.unbind(),
            "setpoint": setpoint.clone(memory_format=torch.contiguous_format).unbind(),
            "error": error.unbind(),
            "noise": (torch.zeros_like(error) if noise is None else noise).unbind(),
        }
        if load is not None:
            infos["disturbance"] = load.unbind()
            self._loads = [*load.clone().unbind()]  # as the caller may overwrite infos
        infos |= zip(self._factor_names, zip(*factors, strict=True), strict=False)
        everyone = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        masks = dict.fromkeys(self._masks, everyone)
        rewards = self._rewards(error).unbind()
        flags = self._zeros.new_zeros(2 * samples, self.num_envs, dtype=torch.bool).unbind()
        for k in reversed(range(samples)):
            own = {name: rows[k] for name, rows in infos.items()}
            self._ahead.append((rewards[k], flags[k], flags[samples + k], own | masks))

    def _rewards(self, error: Tensor) -> Tensor:
        """Return the rewards of errors, without the cost of moves."""
        scale = self.parameters.error_scale
        if self.parameters.reward == "quadratic":
            zero = error.new_zeros(())
            return torch.addcmul(zero, error, error, value=-0.5 / scale**2)  # (12)
        return error.abs().mul_(-1.0 / scale)

    def _begin(self, mask: Mask) -> dict[str, Tensor]:
        which = self._flags(mask)
        self._loads = [torch.where(which, 0.0, self._present_load())]
        self._episodes.clock = self._clock
        self._episodes.unused = len(self._ahead)
        self._ahead = []
        if mask.all():  # signals may be others than before
            self._episodes.unused = 0
            self.detach()
        first = self._episodes.reset(which, self._starts, self._given)
        self._plants.reset(which)
        at_rest = {name: each.reset(which) for name, each in self._signals.items()}
        numbers, setpoint = self._episodes.numbers, at_rest["setpoint"]
        rest_action = self._zeros + action_from_command(0.0, numbers["u_min"], numbers["u_max"])
        self._action = torch.where(which, rest_action, self._action)
        self._shown.reset(which, setpoint, rest_action)
        first |= {"setpoint": setpoint, "error": setpoint}
        return first | {name: self._zeros + numbers[name] for name in self._factor_names}

    def _final(self, ended: Mask, observations: Tensor) -> Tensor:
        return torch.where(self._flags(ended)[:, None], observations, 0)

    def _flags(self, mask: Mask) -> Tensor:
        flags = torch.empty(self.num_envs, dtype=torch.bool, device=self.device)
        return flags.copy_(torch.from_numpy(mask), non_blocking=True)  # without waiting

    def _from_host(self, values: NDArray[Any]) -> Tensor:
        tensor: Tensor = torch.from_numpy(values).to(self._zeros)
        return tensor

    def _present_load(self) -> Tensor:
        if not self.parameters.is_disturbed:
            return torch.zeros_like(self._zeros)
        return self._loads[-1 - len(self._ahead)]

    def _prepare(self, mask: Mask, seed: Any, options: Mapping[str, Any]) -> None:
        if seed is not None and not (is_count(seed) and seed < 1 << 63):
            reject("seed", seed, "None or an integer from 0 to 2^63 - 1")
        if "reset_mask" not in options:
            # Signals and plant numbers that replace draws, if any.
            self._given, self._last = read_signals(
                options.get("signals"), self.parameters, self._episodes
            )
            of_signals = {name: each for name, each in self._given.items() if name in SIGNALS}
            self._signals = {**self._drawn, **of_signals}
        elif "signals" in options:
            raise ValueError("options['signals'] needs a reset of all plants, not of some")
        if seed is not None:
            self._episodes.generator.manual_seed(int(seed))
        self._np_random_seed = self._episodes.generator.initial_seed()

    def _checked_actions(self, actions: Any) -> Tensor:
        given = actions
        if not (isinstance(actions, Tensor) and actions.dtype is self.dtype):
            given = as_tensor(actions, self._zeros)
        if given is None or given.shape != (self.num_envs, 1):
            reject("actions", actions, f"numbers, shape ({self.num_envs}, 1)")
        if given.requires_grad and not self.differentiable:
            given = given.detach()
        a: Tensor = given.reshape(-1)
        if self._ended is not None:
            a = a.masked_fill(self._flags(self._ended), 0.0)
        if self.checks_actions:
            # One call shows that all are finite, unless some are huge.
            plain = a.detach() if a.requires_grad else a
            if not math.isfinite(plain.dot(plain).item()) and not plain.isfinite().all():
                reject("actions", actions, "finite")
        if self._last is not None:
            going = self._starts if self._ended is None else self._starts[~self._ended]
            if len(going) and self._clock + 1 - int(going.min()) > self._last:
                raise ValueError(
                    f"options['signals'] end at sample {self._last} of an episode, and the "
                    "step goes beyond"
                )
        return a


def make_vec(env: str | EnvSpec, num_envs: int, **arguments: Any) -> MiddlePointTorchEnv:
    """Make many plants of an id or a spec, as `gymnasium.make_vec` does in NumPy.

    Parameters
    ----------
    env
        An id of this package, such as "MiddlePointHard-v0", or an `EnvSpec` without wrappers.
    num_envs
        Number of plants.
    **arguments
        Those of `MiddlePointTorchEnv`, which replace those of the id.

    Returns
    -------
    MiddlePointTorchEnv
        Its `spec` makes one of these plants in NumPy, as in
        `mptc_gym.evaluate(policy, plants.spec)`.

    Raises
    ------
    ValueError
        If the id is unknown or of another environment, or an argument is out of range.
    """
    of_plant = {name: value for name, value in arguments.items() if name in ARGUMENTS}
    if "max_episode_steps" in arguments:
        limit = arguments["max_episode_steps"]
        of_plant["max_episode_steps"] = -1 if limit is None else limit
    single = make_one(env, of_plant)
    plant, spec = single.unwrapped, cast("EnvSpec", single.spec)
    if not isinstance(plant, MiddlePointEnv) or spec.additional_wrappers:
        reject("env", env, "the id or the spec of a MiddlePointEnv, without wrappers")
    arguments = {
        **asdict(plant.parameters),
        "max_episode_steps": spec.max_episode_steps,
        **arguments,
    }
    plants = MiddlePointTorchEnv(num_envs, **arguments)
    plants.spec = spec
    return plants


class _Window:
    """The observations of all plants, with or without gradients for past actions."""

    def __init__(
        self, windows: Sequence[int], episodes: Episodes, differentiable: bool
    ) -> None:
        *self._windows, self._past_actions = windows
        self._episodes, self._differentiable = episodes, differentiable
        self._zeros = zeros = episodes.zeros
        self._actions = [zeros[None]] * self._past_actions  # those shown, newest first
        # Set points, errors and outputs, oldest first: those of one observation, then those of
        # the latest block.
        self._rows = [[zeros] * w for w in self._windows]
        # Observations of the block, without actions: those stacked so far, the next one last;
        # and the rows at which the others begin.
        self._stacked: list[Tensor] = []
        self._unstacked = range(0)
        # Observations are stacked while they fit in the cache.
        numbers = max(1, sum(self._windows) * len(zeros))
        self._at_once = max(1, _IN_CACHE // numbers) if zeros.is_cpu else LONGEST

    def reset(self, which: Tensor, setpoint: Tensor, rest_action: Tensor) -> None:
        """Begin an episode of some plants at rest."""
        for rows, w, newest in zip(
            self._rows, self._windows, (setpoint, setpoint, self._zeros), strict=True
        ):
            at_rest = [*[self._zeros] * (w - 1), newest.clone()][:w]
            end = len(rows) - self._episodes.unused
            past = rows[end - w : end]
            rows[:] = [torch.where(which, *each) for each in zip(at_rest, past, strict=True)]
        if self._past_actions:
            shown = torch.where(which, rest_action.clamp(-1.0, 1.0), torch.cat(self._actions))
            self._actions = [shown] if self._differentiable else [*shown.split(1)]

    def add(self, *blocks: Tensor) -> None:
        """Add a block of set points, errors and outputs."""
        for rows, w, block in zip(self._rows, self._windows, blocks, strict=True):
            if w:
                rows[:] = [*rows[len(rows) - w :], *block.unbind()]
        self._stacked = []
        self._unstacked = range(1, 1 + len(blocks[0]))

    def next(self, a: Tensor) -> Tensor:
        """Return the observations of the next sample of the block, given the action before."""
        if not self._stacked:
            self._stacked = self._stack(self._unstacked[: self._at_once])[::-1]
            self._unstacked = self._unstacked[self._at_once :]
        shown = self._stacked.pop()
        if self._past_actions:
            newest = a.clamp(-1.0, 1.0)[None]
            if self._differentiable:
                self._actions = [torch.cat((newest, *self._actions))[:-1]]
            else:
                self._actions = [newest, *self._actions[:-1]]
            shown = torch.cat((shown, *self._actions))
        return shown.t()

    def present(self) -> Tensor:
        """Return the observations after a reset."""
        return torch.cat((*self._stack(range(1)), *self._actions)).t()

    def detach(self) -> None:
        """Cut the graph that leads to earlier actions."""
        self._stacked = [observation.detach() for observation in self._stacked]
        self._rows = [[each.detach() for each in rows] for rows in self._rows]
        self._actions = [each.detach() for each in self._actions]

    def _stack(self, places: range) -> list[Tensor]:
        """Return observations without actions, which begin at some places of the rows."""
        n = len(self._zeros)
        newest_first: list[Tensor] = []
        for k in places:
            for rows, window in zip(self._rows, self._windows, strict=True):
                newest_first += rows[k : k + window][::-1]
        if not newest_first:  # the observation has actions alone
            return [self._zeros.new_empty(0, n)] * len(places)
        return [*torch.stack(newest_first).view(len(places), -1, n).unbind()]
