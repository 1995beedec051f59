"""Many plants side by side in PyTorch, on any device and with gradients if asked for."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from gymnasium.error import DependencyNotInstalled, ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

try:
    import torch
except ImportError as error:
    raise DependencyNotInstalled(
        'mptc_gym.torch_env needs PyTorch: pip install "mptc_gym[torch]"'
    ) from error
from torch import Tensor

from mptc_gym import rendering
from mptc_gym.checks import MOST_PLANTS, count, is_count, reject
from mptc_gym.env import MiddlePointEnv
from mptc_gym.parameters import PLANT_NUMBERS, argument_signature
from mptc_gym.plant import DRIFT_INTERVAL, action_from_command
from mptc_gym.signals import Levels
from mptc_gym.torch_plant import TorchPlants
from mptc_gym.torch_signals import (
    LONGEST,
    Draws,
    Given,
    Held,
    Load,
    Noise,
    Number,
    Repeated,
)
from mptc_gym.vector_env import checked_limit, checked_mode, checked_options

Infos = dict[str, Any]

SIGNALS = ("noise", "setpoint", "disturbance", "measurement_noise")
_IN_CACHE = 1 << 17  # numbers that are worked on at once
_ROOM = 64  # steps until the window of past actions is moved back


def _usable(device: str | torch.device) -> torch.device:
    """Return a device on which there can be tensors and a generator; ValueError otherwise."""
    try:
        usable = torch.device(device)
        torch.zeros(1, device=usable)
        torch.Generator(usable)
    except (AssertionError, RuntimeError, TypeError, ValueError) as error:
        raise ValueError(
            f"device must be one that PyTorch can use here, got {device!r}: {error}"
        ) from error
    return usable


class MiddlePointTorchEnv(VectorEnv[Tensor, Tensor, Tensor]):
    """n plants that advance together, whose observations, actions and rewards are tensors.

    The plant, the spaces, the reward, the infos and the arguments are those of
    `MiddlePointEnv`; resets are those of `MiddlePointVectorEnv`. Given the same signals and
    actions, all that `reset` and `step` return is the same but for rounding.

    Use it to train on a GPU, on thousands of noisy plants, or through the plant. With fewer
    plants on a CPU, NumPy is quicker: `gymnasium.make_vec("MiddlePoint-v0", num_envs=n)`.

    Parameters
    ----------
    num_envs, max_episode_steps, autoreset_mode
        As for `MiddlePointVectorEnv`. `final_obs` is a tensor, 0 where no episode has ended.
    device
        Where everything is computed and all tensors are.
    dtype
        torch.float32 or torch.float64, of all that is computed; the spaces say float32.
    differentiable
        Whether observations, rewards and infos carry the graph back to the actions, through
        time; see Gradients.
    **arguments
        Those of `MiddlePointEnv` but `render_mode`, the same for all plants; from a range each
        draws its own.

    Attributes
    ----------
    autoreset_mode : AutoresetMode
        The mode.

    Raises
    ------
    ValueError
        If an argument is out of range; the message names it.
    TypeError
        If an argument is unknown.

    Notes
    -----
    **Random numbers.** All come from one `torch.Generator` on the device, which `reset(seed=)`
    starts anew: the same seed, arguments and resets give the same numbers on the same device,
    with the same versions of this package and of PyTorch. They are other numbers than those of
    the environments in NumPy, which stay from version to version, of the same distributions.
    There, the j-th episode of a plant is the same however long the episodes before it were, and
    whatever the other plants do; here it is not. So compare controllers with those, or hand the
    signals in.

    **Signals from outside.** `reset(options={"signals": signals})` takes a dict of tensors:
    "noise" (n), "setpoint" (y_d), "disturbance" (w) and "measurement_noise", degC, each of
    shape (samples, num_envs), where row k is that of sample k; and numbers that are ranges by
    their names, shape (num_envs,). With one dimension more before, the j-th episode of a plant
    gets the j-th, and after the last one the first again. What is not in the dict is drawn. It
    is a ValueError if a step needs a sample beyond the last.

    **Gradients.** The actuator is not smooth. The gradient goes straight through the dead zone,
    as if it were not there, and is 0 beyond the limits, as nothing changes there; the same
    holds for readings beyond the transmitter's span. So a policy also learns from commands
    without effect, which have no gradient in truth. `detach` cuts the graph for truncated
    backpropagation. An action shows after `delay` + 1 samples: shorter pieces have no gradient.
    Without `differentiable` nothing of a graph is kept.

    **Waiting.** `step` never waits for the device: the host knows when episodes end. For the
    same reason, actions that are not finite are an error on the CPU only; elsewhere the plants
    that got them show NaN until they are reset. `reset` may wait.

    **Memory.** What a step returns is the caller's, to keep or to overwrite, except that in the
    infos masks and the factors of drifts may be one tensor for several steps. Tensors of
    several steps may share one piece of memory, which is freed when none of them is left.
    Observations are transposed views: their columns lie one after the other in memory.
    """

    __signature__: ClassVar[inspect.Signature] = inspect.Signature(
        [
            inspect.Parameter(
                "num_envs", inspect.Parameter.POSITIONAL_OR_KEYWORD, annotation="int"
            ),
            *(
                inspect.Parameter(
                    name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation
                )
                for name, default, annotation in (
                    ("device", "cpu", "str | torch.device"),
                    ("dtype", torch.float32, "torch.dtype"),
                    ("max_episode_steps", 1200, "int | None"),
                    ("autoreset_mode", AutoresetMode.NEXT_STEP, "str | AutoresetMode"),
                    ("differentiable", False, "bool"),
                )
            ),
            *argument_signature(),
        ]
    )

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
        rendering.check_mode(arguments.pop("render_mode", None), [])
        single = MiddlePointEnv(**arguments)
        self.num_envs = num_envs = count("num_envs", num_envs, 1, MOST_PLANTS)
        self._limit = checked_limit(max_episode_steps)
        self.autoreset_mode = checked_mode(autoreset_mode)
        self.metadata = {
            **self.metadata,
            "render_modes": [],
            "autoreset_mode": self.autoreset_mode,
        }
        if not isinstance(dtype, torch.dtype) or dtype not in (torch.float32, torch.float64):
            reject("dtype", dtype, "torch.float32 or torch.float64")
        if not isinstance(differentiable, bool):
            reject("differentiable", differentiable, "True or False")
        self.device = _usable(device)
        self.dtype = dtype
        self.differentiable = differentiable
        self.parameters = parameters = single.parameters
        self.single_action_space = single.action_space
        self.single_observation_space = single.observation_space
        self.action_space = batch_space(single.action_space, num_envs)
        self.observation_space = batch_space(single.observation_space, num_envs)

        load = ("disturbance",) if parameters.is_disturbed else ()
        factors = ("gain_factor", "time_constant_factor") if parameters.drifts else ()
        first = "command", "applied", "output", "setpoint", "error", "noise"
        self._names = (*first, *load, *factors)  # of what infos hold
        self._keys = (*self._names, *(f"_{name}" for name in self._names))

        self._seed: int | None = None  # None until the first reset
        self._nothing = nothing = torch.zeros(num_envs, dtype=dtype, device=self.device)
        self._draws = draws = Draws(torch.Generator(self.device), nothing)
        # Changed in place, as what draws disturbances looks them up here. If one limit is
        # drawn, both are tensors: PyTorch clamps between two numbers or between two tensors.
        alike = not {"u_min", "u_max"} & {*parameters.ranges}
        self._numbers: dict[str, Number] = {
            name: parameters.range_of(name)[0]
            if name not in parameters.ranges and (alike or name not in ("u_min", "u_max"))
            else nothing + parameters.range_of(name)[0]
            for name in PLANT_NUMBERS
        }
        self._given: Given | None = None
        self._plants = TorchPlants(parameters, nothing)
        self._noise, self._transmitter = (
            Noise(c, draws) if parameters.range_of(name)[1] > 0.0 else None
            for name, c in (
                ("noise_variance", parameters.c),
                ("measurement_noise_variance", [1.0]),
            )
        )
        levels = Levels(parameters)
        self._repeated = None if levels.random else Repeated(levels, nothing)
        self._random = Held(levels, draws)
        self._load = Load(self._numbers, draws) if parameters.is_disturbed else None

        # Each plant's k is the clock less where it started. The host has a copy of the latter,
        # so that it knows when episodes end without asking the device.
        self._clock = 0
        self._starts = torch.zeros(num_envs, dtype=torch.int64, device=self.device)
        self._host_starts = np.zeros(num_envs, np.int64)
        self._aligned = True
        self._first_end = 0
        self._ended: NDArray[np.bool_] | None = None  # those still to be reset, if any
        self._ended_mask = torch.zeros_like(self._starts, dtype=torch.bool)  # and on the device
        self._waits = self.device.type == "cpu"  # it costs no time to look at a value

        self._zero = nothing.new_zeros(())
        self._move_weight = parameters.move_weight
        self._action = nothing
        # Blocks of samples that stay in the processor's cache, or that are worth their calls.
        in_cache = max(1, _IN_CACHE // num_envs) if self.device.type == "cpu" else LONGEST
        self._block = min(self._plants.most_samples, LONGEST, in_cache)
        self._offsets = torch.arange(LONGEST, device=self.device)[:, None]
        self._ahead: list[tuple[Any, ...]] = []  # what the steps ahead return, worked out
        self._samples = self._taken = 0  # of those in the block, and of those returned
        # What the observation shows of set point, error and output, oldest first, and then what
        # it will show in the samples of the block.
        self._windows = parameters.windows
        self._seen = [[nothing] * window for window in self._windows[:3]]
        self._past_actions: Any = None  # a tensor where observations show any
        self._row = nothing.new_zeros(parameters.action_window + _ROOM, num_envs)
        self._place = _ROOM

    @property
    def np_random_seed(self) -> int | None:
        """The seed of the generator; None before the first reset."""
        return self._seed

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Tensor, Infos]:
        """Bring all plants, or some, to rest and start an episode of each.

        Parameters
        ----------
        seed
            Starts the generator anew. Without it, draws go on.
        options
            `reset_mask`, a tensor of bool, shape (num_envs,), says which plants are reset.
            `signals`, a dict of tensors, is what the next episodes of all plants get instead of
            draws, until all are reset without it; see the class docstring.

        Returns
        -------
        observations
            Shape (num_envs, observation_size); the last one of a plant that was not reset.
        infos
            Tensors of shape (num_envs,), and a mask of the plants that were reset with each.

        Raises
        ------
        ValueError
            If an argument does not fit. Nothing is changed then.
        ResetNeeded
            If the first reset is not one of all plants.
        """
        if seed is not None and not (is_count(seed) and seed < 1 << 63):
            reject("seed", seed, "None or an integer from 0 to 2^63 - 1")
        chosen = checked_options(options)
        which = self._checked_mask(chosen)
        if which is not None and self._seed is None:
            raise ResetNeeded("reset all environments before some of them")
        if which is None:
            self._given = self._checked_signals(chosen.get("signals"))
        elif "signals" in chosen:
            raise ValueError("options['signals'] needs a reset of all plants, not of some")
        if seed is not None:
            self._seed = int(seed)
            self._draws.generator.manual_seed(self._seed)
        elif self._seed is None:
            self._seed = self._draws.generator.seed()
        return self._reset(which)

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Infos]:
        """Apply normalised actions for one sample.

        Parameters
        ----------
        actions
            a(k) of each plant, shape (num_envs, 1).

        Returns
        -------
        observations
            Shape (num_envs, observation_size).
        rewards
            Shape (num_envs,).
        terminations, truncations
            Shape (num_envs,), bool.
        infos
            Tensors of shape (num_envs,) and their masks, which may be one tensor.

        Raises
        ------
        ValueError
            If the actions have another shape, or, on the CPU, if one is not finite. The plants
            are untouched then.
        ResetNeeded
            If the environments have never been reset, or, with autoreset disabled, if one has
            ended.
        """
        a = self._checked_actions(actions)
        if self._ended is not None and self._ended.all():
            observations, infos = self._reset(None)
            none = torch.zeros_like(self._starts, dtype=torch.bool)
            return observations, self._nothing.clone(), none, none.clone(), infos
        self._clock += 1
        command, applied = self._plants.apply(a)
        if self._taken == self._samples:
            self._look_ahead()
        rewards, terminations, truncations, told = self._ahead[self._taken]
        self._taken += 1
        observations = self._front()

        if self._move_weight:
            rewards = rewards - self._move_weight * (a - self._action).abs()
            self._action = a.clone()  # the caller may write in it
        if self._windows[3]:
            observations = self._with_actions(observations, a)
        infos = dict(zip(self._keys, (command, applied, *told), strict=True))
        if self._clock >= self._first_end:
            return self._end_episodes(observations, rewards, terminations, infos)
        return observations, rewards, terminations, truncations, infos

    def detach(self) -> None:
        """Cut the graph that leads to earlier actions, for truncated backpropagation.

        What later steps return then depends on the actions from now on alone.
        """
        self._plants.detach()
        self._action = self._action.detach()
        self._ahead = [
            (*(each.detach() for each in shown), tuple(each.detach() for each in told))
            for *shown, told in self._ahead
        ]
        self._seen = [[row.detach() for row in seen] for seen in self._seen]
        if self._past_actions is not None:
            self._past_actions = self._past_actions.detach()

    def _look_ahead(self) -> None:
        """Work out what the next steps return, but for what depends on their actions."""
        clock, n = self._clock, self.num_envs
        samples = max(1, min(self._block, self._first_end - clock + 1))
        given = self._given
        if given is not None or self._repeated is not None:
            starts = self._starts[:1] if self._aligned else self._starts
            ages = self._offsets[:samples] + (clock - starts)

        def noise_of(source: Noise | None, name: str) -> Tensor | None:
            if given is not None and name in given:
                return given.at(name, ages)
            if source is None:
                return None
            return source.take(samples, self._taken)

        noise = noise_of(self._noise, "noise")
        reading = noise_of(self._transmitter, "measurement_noise")
        if given is not None and "setpoint" in given:
            setpoint = given.at("setpoint", ages)
        elif self._repeated is None:
            setpoint = self._random.take(samples, self._taken)
        else:
            setpoint = self._repeated.at(ages).expand(samples, n)
        load = None
        if given is not None and "disturbance" in given:
            load = given.at("disturbance", ages)
        elif self._load is not None:
            load = self._load.take(samples, self._taken, clock)

        output, factors = self._plants.outputs(self._taken, clock, samples, noise, load)
        error = setpoint - output
        scale = self.parameters.error_scale
        if self.parameters.reward == "quadratic":
            rewards = torch.addcmul(self._zero, error, error, value=-0.5 / scale**2)  # (12)
        else:
            rewards = error.abs().mul_(-1.0 / scale)

        measured = output if reading is None else output + reading
        span = self.parameters.temperature_span
        measured = measured.clamp(-span, span)
        for place, values in enumerate((setpoint, setpoint - measured, measured)):
            if self._windows[place]:
                past = self._seen[place][self._taken :][: self._windows[place]]
                self._seen[place] = [*past, *values.unbind()]
        flags = torch.zeros(2 * samples, n, dtype=torch.bool, device=self.device).unbind()
        none = torch.zeros_like(error) if noise is None else noise
        # The set point is shown later, too, and what is told is the caller's.
        told_setpoint = setpoint.clone(memory_format=torch.contiguous_format)
        blocks = [output, told_setpoint, error, none] + ([] if load is None else [load])
        told: list[Sequence[Tensor]] = [each.unbind() for each in blocks]
        if self.parameters.drifts:
            told += zip(*factors, strict=True)
        everyone = torch.ones_like(flags[0])  # all plants have all that is told
        self._ahead = list(
            zip(
                rewards.unbind(),
                flags[:samples],
                flags[samples:],
                zip(*told, *[[everyone] * samples] * len(self._names), strict=True),
                strict=True,
            )
        )
        self._samples, self._taken = samples, 0

    def _front(self) -> Tensor:
        """Return what the present observation shows of set point, error and output."""
        newest = [
            row
            for seen, window in zip(self._seen, self._windows, strict=False)
            for row in reversed(seen[self._taken : self._taken + window])
        ]
        return torch.stack(newest).t() if newest else self._nothing.new_empty(self.num_envs, 0)

    def _with_actions(self, front: Tensor, a: Tensor) -> Tensor:
        """Return the observations once a(k) has been added to them."""
        window, newest = self._windows[3], a.clamp(-1.0, 1.0)
        if self.differentiable:
            self._past_actions = torch.cat((newest[None], self._past_actions[:-1]))
        else:
            if self._place == 0:
                self._row[_ROOM:] = self._row[:window].clone()
                self._place = _ROOM
            self._place -= 1
            self._row[self._place] = newest
            self._past_actions = self._row[self._place : self._place + window]
        return torch.cat((front.t(), self._past_actions)).t()

    def _window(self) -> Tensor:
        """Return the present observations."""
        front = self._front()
        if self._past_actions is None:
            return front
        return torch.cat((front.t(), self._past_actions)).t()

    def _reset(self, which: Tensor | None) -> tuple[Tensor, Infos]:
        chosen = np.ones(self.num_envs, np.bool_) if which is None else which.cpu().numpy()
        mask = torch.ones_like(self._starts, dtype=torch.bool) if which is None else which
        begun = self._begin(which, chosen)
        if self._ended is not None:
            left = self._ended & ~chosen
            self._ended_mask = self._ended_mask & ~mask
            self._ended = left if left.any() else None
        infos: Infos = {}
        for name in {*self._names, *begun}:
            values = begun.get(name, self._nothing)
            infos[name] = torch.where(mask, values, 0.0)
            infos[f"_{name}"] = mask.clone()
        return self._window(), infos

    def _end_episodes(
        self, observations: Tensor, rewards: Tensor, terminations: Tensor, infos: Infos
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Infos]:
        """Do what the end of an episode asks for, and return what `step` does."""
        ended = self._clock - self._starts >= self._limit
        host = self._clock - self._host_starts >= self._limit
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            final_info = {name: torch.where(ended, infos[name], 0.0) for name in self._names}
            final_obs = torch.where(ended[:, None], observations, 0.0)
            self._restart(ended, host, infos)
            infos |= {
                "final_obs": final_obs,
                "_final_obs": ended.clone(),
                "final_info": final_info | {f"_{name}": ended.clone() for name in final_info},
                "_final_info": ended.clone(),
            }
            return self._window(), rewards, terminations, ended, infos
        if self._ended is not None:  # at the step before this one
            rewards = torch.where(self._ended_mask, 0.0, rewards)
            self._restart(self._ended_mask, self._ended, infos)
            observations = self._window()
            ended = self._clock - self._starts >= self._limit
            host = self._clock - self._host_starts >= self._limit
        self._ended, self._ended_mask = host if host.any() else None, ended.clone()
        return observations, rewards, terminations, ended, infos

    def _restart(self, which: Tensor, chosen: NDArray[np.bool_], infos: Infos) -> None:
        """Begin an episode of those that have ended, within the infos of a step."""
        begun = self._begin(None if chosen.all() else which, chosen)
        for name in {*self._names, *begun}:
            infos.setdefault(f"_{name}", which.clone())
            before = infos.get(name, self._nothing)
            infos[name] = torch.where(which, begun.get(name, self._nothing), before)

    def _begin(self, which: Tensor | None, chosen: NDArray[np.bool_]) -> dict[str, Tensor]:
        """Begin an episode of some plants, and return their infos of k = 0 that are not 0.

        Parameters
        ----------
        which
            Whether each does, shape (num_envs,), bool; None for all.
        chosen
            The same on the host.
        """

        def chosen_of(new: Any, old: Any) -> Tensor:
            """Return the new values of those plants, and the old ones of the others."""
            if which is None:
                return new if isinstance(new, Tensor) else torch.full_like(old, new)
            return torch.where(which, new, old)

        given = self._given
        if given is not None:
            given.rest(which)
        begun: dict[str, Tensor] = {}
        for name in self.parameters.ranges:
            if given is not None and name in given:
                begun[name] = given.number(name)
            else:
                begun[name] = self._draws.within(
                    *self.parameters.range_of(name), whole=name == "delay"
                )
            self._numbers[name] = chosen_of(begun[name], self._numbers[name])

        self._starts = chosen_of(self._clock, self._starts)
        self._host_starts[chosen] = self._clock
        first = int(self._host_starts.min())
        self._first_end = first + self._limit
        self._aligned = first == int(self._host_starts.max())
        phases = (
            set(np.unique(self._host_starts % DRIFT_INTERVAL).tolist())
            if self.parameters.drifts or self.parameters.is_disturbed
            else ()
        )
        starts = first if self._aligned else self._starts
        self._plants.rest(which, self._taken, self._numbers, starts, phases)
        for noise, name in (
            (self._noise, "noise_variance"),
            (self._transmitter, "measurement_noise_variance"),
        ):
            if noise is not None:
                noise.rest(which, self._taken, self._numbers[name])
        if self._load is not None:
            self._load.rest(which, self._taken, self._starts, phases)
        if given is not None and "setpoint" in given:
            setpoint = given.at("setpoint", torch.zeros_like(self._starts)[None])[0]
        elif self._repeated is None:
            setpoint = self._random.rest(which, self._taken)
        else:
            setpoint = self._repeated.values[0].expand(self.num_envs)

        for place, newest in enumerate((setpoint, setpoint, self._nothing)):
            window = self._windows[place]
            past = self._seen[place][self._taken : self._taken + window]
            rest = [*[self._nothing] * (window - 1), newest.clone()][-window:] if window else []
            self._seen[place] = [
                chosen_of(new, old) for new, old in zip(rest, past, strict=True)
            ]
        self._ahead, self._samples, self._taken = [], 0, 0

        rest_action: Any = action_from_command(
            0.0, self._numbers["u_min"], self._numbers["u_max"]
        )
        self._action = chosen_of(rest_action, self._action)
        if self._windows[3]:
            old = self._row[self._place :][: self._windows[3]]
            if self._past_actions is not None:
                old = self._past_actions
            shown = torch.zeros_like(old) + rest_action
            self._past_actions = chosen_of(shown.clamp(-1.0, 1.0), old)
            if not self.differentiable:
                self._row[self._place :][: self._windows[3]] = self._past_actions
        begun["setpoint"] = begun["error"] = setpoint
        if self.parameters.drifts:
            for name in ("gain_factor", "time_constant_factor"):
                begun[name] = self._nothing + self._numbers[name]
        return begun

    def _checked_mask(self, options: Mapping[str, Any]) -> Tensor | None:
        if "reset_mask" not in options:
            return None
        mask = options["reset_mask"]
        if isinstance(mask, np.ndarray):
            mask = torch.from_numpy(mask)
        if (
            not isinstance(mask, Tensor)
            or mask.dtype != torch.bool
            or mask.shape != (self.num_envs,)
            or not mask.any()
        ):
            allowed = f"a tensor of bool, shape ({self.num_envs},), at least one of them True"
            reject("options['reset_mask']", mask, allowed)
        return mask.to(self.device, copy=True)

    def _checked_signals(self, signals: Any) -> Given | None:
        if signals is None:
            return None
        n = self.num_envs
        numbers = self.parameters.ranges
        names = {*SIGNALS, *numbers}
        if not self.parameters.is_disturbed:
            names.remove("disturbance")
        if not isinstance(signals, Mapping) or not signals or not names >= {*signals}:
            given = [*signals] if isinstance(signals, Mapping) else signals
            reject("options['signals']", given, f"a dict with some of {sorted(names)}")
        tensors = {}
        for name, values in signals.items():
            tensor = self._tensor(values)
            if tensor is None:
                reject(f"options['signals'][{name!r}]", values, "numbers")
            dimensions = 1 if name in numbers else 2
            if tensor.ndim == dimensions:
                tensor = tensor[None]
            if tensor.ndim != dimensions + 1 or tensor.shape[-1] != n or not tensor.numel():
                shape = f"(samples, {n})" if dimensions == 2 else f"({n},)"
                raise ValueError(
                    f"options['signals'][{name!r}] must have the shape {shape}, or one more "
                    f"dimension before, of episodes, got {tuple(tensor.shape)}"
                )
            if not tensor.isfinite().all():
                raise ValueError(f"options['signals'][{name!r}] must be finite")
            if name in numbers:
                low, high = tensor.new_tensor(self.parameters.range_of(name))
                whole = name != "delay" or bool((tensor == tensor.round()).all())
                if not (whole and bool(((low <= tensor) & (tensor <= high)).all())):
                    allowed = f"within its range, {list(self.parameters.range_of(name))}"
                    reject(f"options['signals'][{name!r}]", values, allowed)
            tensors[name] = tensor
        return Given(tensors, self._nothing)

    def _tensor(self, values: Any) -> Tensor | None:
        """Return real numbers as a tensor of the environment's type, None if they are not."""
        if "complex" in str(getattr(values, "dtype", "")):  # PyTorch would drop a part of them
            return None
        try:
            return torch.as_tensor(values, dtype=self.dtype, device=self.device)
        except (TypeError, ValueError, RuntimeError, OverflowError):
            return None

    def _checked_actions(self, actions: Tensor) -> Tensor:
        """Return the actions, shape (num_envs,); 0 where they are ignored."""
        if self._seed is None:
            raise ResetNeeded("call reset before step")
        given = actions
        if not (isinstance(actions, Tensor) and actions.dtype is self.dtype):
            tensor = self._tensor(actions)
            given = self._nothing if tensor is None else tensor
        if given.shape != (self.num_envs, 1):
            reject("actions", actions, f"numbers, shape ({self.num_envs}, 1)")
        if given.requires_grad and not self.differentiable:
            given = given.detach()
        a = given.reshape(-1)
        if self._ended is not None:
            if self.autoreset_mode is AutoresetMode.DISABLED:
                ended = np.flatnonzero(self._ended)
                raise ResetNeeded(f"episodes of environments {ended} have ended: reset them")
            a = a.masked_fill(self._ended_mask, 0.0)
        # Elsewhere the device would have to be waited for. One call tells that all are finite,
        # unless some are huge.
        plain = a.detach() if a.requires_grad else a
        if (
            self._waits
            and not math.isfinite(plain.dot(plain).item())
            and not plain.isfinite().all()
        ):
            reject("actions", actions, "finite")
        if self._given is not None:
            going = (
                self._host_starts if self._ended is None else self._host_starts[~self._ended]
            )
            age = self._clock + 1 - int(going.min()) if len(going) else 0
            if age > self._given.last:
                raise ValueError(
                    f"options['signals'] end at sample {self._given.last} of an episode, and "
                    "the step goes beyond"
                )
        return a
