"""Simulate many plants at once in PyTorch, on any device, optionally with gradients.

`MiddlePointTorchEnv` has the methods of `MiddlePointVectorEnv`, but computes a block of
successive samples at a time, which takes fewer calls of PyTorch: a flow affects the temperature
only after the delay, so all flows that determine the temperatures of a block are known. The
signals and temperatures of a block have one row for each sample, and each `step` returns one
row. If some plants begin an episode in the middle of a block, the rows that no `step` has
returned are dropped, and computed again for all plants.
"""

from __future__ import annotations

import functools
import inspect
import math
import pickle
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar, NamedTuple

import gymnasium
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import DependencyNotInstalled
from gymnasium.vector import AutoresetMode

try:
    import torch
except ImportError as error:
    raise DependencyNotInstalled(
        'mptc_gym.torch_env needs PyTorch: pip install "mptc_gym[torch]"'
    ) from error
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from mptc_gym.batch import BatchEnv, Infos, Mask
from mptc_gym.plant import checks
from mptc_gym.plant.actuator import (
    WantedFlows,
    action_from_command,
    least_effective_command,
)
from mptc_gym.plant.checks import NOT_A_NUMBER, one_of, reject
from mptc_gym.plant.dynamics import DRIFT_INTERVAL, FACTORS, Dynamics
from mptc_gym.plant.parameters import (
    ARGUMENTS,
    EPISODE_STEPS,
    Parameters,
    PlantNumbers,
    full_signature,
)
from mptc_gym.plant.signals import LOAD_INTERVAL, SetPointLevels, noise_polynomials

Number = float | Tensor  # a float for all plants, or an element for each plant, shape (n,)
SampleNumber = int | Tensor  # of all plants, or of each plant, shape (n,)

MOST_BLOCK_SAMPLES = 64  # most samples in a block, which bounds the memory of a block
# On a CPU, the most values of a signal in a block of more than `DRIFT_INTERVAL` samples:
# 512 KiB of float32, which fit in the cache.
VALUES_IN_CACHE = 1 << 17


def _uniform(low: float, high: float, zeros: Tensor, generator: torch.Generator) -> Tensor:
    """Return uniform random numbers from `low` to `high`: integers if `low` is an integer.

    The numbers have the shape of `zeros`, and the device and the type of `zeros` or int64.
    """
    if isinstance(low, int):
        return torch.randint(
            low, int(high) + 1, zeros.shape, generator=generator, device=zeros.device
        )
    return torch.empty_like(zeros).uniform_(low, high, generator=generator)


class _Signal:
    """A signal of n plants, whose random numbers come from the environment's generator.

    Every subclass has two methods. `reset(mask, numbers)` begins an episode of the plants in
    `mask`, and returns the values at k = 0, degC, shape (n,); those of other plants have no
    meaning. `numbers` holds the parameter values of all plants. `next(samples, k)` computes a
    block of successive samples, beginning with sample k, and returns the values, degC, shape
    (samples, n). No load changes after the first sample of a block.
    """

    def __init__(self, zeros: Tensor, generator: torch.Generator) -> None:
        self._zeros = zeros
        self._generator = generator
        self._uniform = functools.partial(_uniform, zeros=zeros, generator=generator)

    def end_block(self, samples: int) -> None:
        """Forget the latest block, except for its first samples, which steps have returned."""


class _Noise(_Signal):
    """Noise of n plants or of their transmitters: C(z^-1) xi(k) with white noise xi, degC.

    `c` holds the coefficients of the polynomial C, from z^0 on.
    """

    def __init__(
        self, name: str, c: Sequence[float], zeros: Tensor, generator: torch.Generator
    ) -> None:
        super().__init__(zeros, generator)
        self._variance_name = f"{name}_variance"
        self._c = c
        # White noise of the samples before the latest block, which C needs, and of the block.
        self._xi = [self._zeros] * (len(c) - 1)

    def reset(self, mask: Tensor, numbers: PlantNumbers[Any]) -> Tensor:
        """Begin an episode of the plants in `mask`, and return n(0) = 0, shape (n,)."""
        self._deviation = getattr(numbers, self._variance_name) ** 0.5
        self._xi = [xi.masked_fill(mask, 0.0) for xi in self._xi]
        return self._zeros

    def next(self, samples: int, k: SampleNumber) -> Tensor:
        """Return the noise of the next samples, degC, shape (samples, n)."""
        new_xi = self._zeros.new_empty(samples, len(self._zeros))
        new_xi.normal_(generator=self._generator).mul_(self._deviation)
        self._xi += new_xi.unbind()
        xi = torch.stack(self._xi)
        noise = new_xi  # as the first coefficient of C is 1
        for lag, coefficient in enumerate(self._c[1:], start=1):
            first = len(self._c) - 1 - lag  # row of xi(k - lag), as row len(c) - 1 is xi(k)
            noise = noise.add(xi[first : first + samples], alpha=coefficient)
        return noise

    def end_block(self, samples: int) -> None:
        """Forget the latest block, except for its first samples, which steps have returned."""
        # As many values up to the present sample as C needs.
        self._xi = self._xi[samples : samples + len(self._c) - 1]


class _RepeatedSetPoint(_Signal):
    """Set point that repeats one sequence of levels for all plants."""

    def __init__(
        self, levels: SetPointLevels, zeros: Tensor, generator: torch.Generator
    ) -> None:
        super().__init__(zeros, generator)
        self._levels = self._zeros.new_tensor(levels.values)
        # The samples of a period at which the levels end.
        self._ends = torch.tensor(levels.lengths, device=self._levels.device).cumsum(0)
        self._period = sum(levels.lengths)

    def reset(self, mask: Tensor, numbers: PlantNumbers[Any]) -> Tensor:
        """Return the set points y_d(0), degC, shape (n,): the first level."""
        return self._levels[0].expand(len(mask))

    def next(self, samples: int, k: SampleNumber) -> Tensor:
        """Return the set points of the next samples, degC, shape (samples, n)."""
        rows = torch.arange(samples, device=self._ends.device)[:, None]
        # The index of the level is the number of ends that a sample has reached.
        indices = torch.bucketize((k + rows) % self._period, self._ends, right=True)
        return self._levels[indices].expand(-1, len(self._zeros))


class _RandomSetPoint(_Signal):
    """Set point that takes random levels, each for a random number of samples.

    No block is longer than the shortest level, so a block needs only the present level and the
    next level of each plant.
    """

    def __init__(
        self, levels: SetPointLevels, zeros: Tensor, generator: torch.Generator
    ) -> None:
        super().__init__(zeros, generator)
        self._distribution = levels
        self._level = self._next_level = self._zeros  # degC
        # The sample numbers k at which the present and the next level end.
        self._end = self._next_end = self._zeros.to(torch.int64)

    def reset(self, mask: Tensor, numbers: PlantNumbers[Any]) -> Tensor:
        """Begin an episode of the plants in `mask`, and return y_d(0), degC, shape (n,)."""
        levels, lengths = self._draw()
        self._level = torch.where(mask, levels, self._level)
        self._end = torch.where(mask, lengths, self._end)  # as the episode begins with k = 0
        return self._level

    def next(self, samples: int, k: SampleNumber) -> Tensor:
        """Return the set points of the next samples, degC, shape (samples, n)."""
        # Make the next level of the block before the present level where it has begun, before
        # the sample k. Elsewhere, another next level is drawn in its place.
        has_ended = self._end < k
        self._level = torch.where(has_ended, self._next_level, self._level)
        self._end = torch.where(has_ended, self._next_end, self._end)
        self._next_level, lengths = self._draw()
        self._next_end = self._end + lengths
        rows = torch.arange(samples, device=self._end.device)[:, None]
        return torch.where(k + rows >= self._end, self._next_level, self._level)

    def _draw(self) -> tuple[Tensor, Tensor]:
        """Return random levels, degC, and their durations, samples, both of shape (n,)."""
        distribution = self._distribution
        levels = self._uniform(-distribution.amplitude, distribution.amplitude)
        return levels, self._uniform(distribution.shortest, distribution.longest)


class _Load(_Signal):
    """Load disturbance w(k) of n plants, as `mptc_gym.plant.signals.Disturbance` defines it."""

    def __init__(self, zeros: Tensor, generator: torch.Generator) -> None:
        super().__init__(zeros, generator)
        self._level = self._walk = self._zeros  # a level that jumps, and a random walk, degC

    def reset(self, mask: Tensor, numbers: PlantNumbers[Any]) -> Tensor:
        """Begin an episode of the plants in `mask`, and return w(0) = 0, shape (n,).

        The load of other plants goes on, and the returned 0 has no meaning for them.
        """
        self._numbers = numbers
        self._level = self._level.masked_fill(mask, 0.0)
        self._walk = self._walk.masked_fill(mask, 0.0)
        return self._zeros

    def next(self, samples: int, k: SampleNumber) -> Tensor:
        """Return the loads of the next samples, degC, shape (samples, n): all rows are equal.

        The load changes at sample k alone, as the environment ends a block before a change.
        """
        is_due = k % LOAD_INTERVAL == 0
        # A tensor is not tested, as the test would wait for the device.
        if isinstance(is_due, Tensor) or is_due:
            numbers = self._numbers
            jumps = self._uniform(0.0, 1.0) < LOAD_INTERVAL / numbers.disturbance_interval
            levels = self._uniform(-1.0, 1.0) * numbers.disturbance_amplitude
            self._level = torch.where(jumps & is_due, levels, self._level)
            # A step of the walk that is uniform within +-h has the variance h^2 / 3.
            largest_step = (3.0 * LOAD_INTERVAL * numbers.disturbance_walk_variance) ** 0.5
            self._walk = self._walk + is_due * largest_step * self._uniform(-1.0, 1.0)
        return (self._level + self._walk).repeat(samples, 1)


class _WantedFlows(WantedFlows):
    """The wanted flows of n plants in PyTorch, for the action form "change"."""

    def reset(self, plants: Any) -> None:
        """Set the wanted flows of the plants in the mask `plants` to 0 t/h."""
        self._flows = self._flows.masked_fill(plants, 0.0)

    def detach(self) -> None:
        """Cut the gradient graph of earlier actions."""
        self._flows = self._flows.detach()

    @staticmethod
    def _to_float32(values: Any) -> Any:
        """Round a tensor to float32, and return it in its own type, with the same gradient."""
        if values.dtype is torch.float32:
            return values
        exact = values.detach()
        # Added, as a conversion of `values` would round the gradient to float32 as well.
        return values + (exact.to(torch.float32).to(values.dtype) - exact)


class _Plants:
    """n plants and their actuators, with gradients if the actions have gradients.

    The plant is equation (28) of the paper, A(z^-1) y(k) = B(z^-1) u_a(k - d) + C(z^-1) xi(k),
    with temperature y, applied flow u_a, delay d and white noise xi. The actuator, with dead
    zone and limits, is equation (29) of the paper.

    Attributes
    ----------
    most_samples : int
        Most samples in a block: d + 1 for the shortest delay d, as the temperatures of the
        d + 1 samples after an action do not depend on later actions.
    factors : list of tensor
        Gain factor and time constant factor in the latest block.
    """

    def __init__(self, parameters: Parameters, zeros: Tensor, differentiable: bool) -> None:
        self._parameters = parameters
        self._zeros = zeros
        self._differentiable = differentiable
        self._dynamics = Dynamics(parameters)
        # The limits are never ranges, so `lowest` has the limits of every plant.
        self._limits = parameters.lowest.u_min, parameters.lowest.u_max
        self._half_range = (self._limits[1] - self._limits[0]) / 2.0
        self._middle = zeros.new_tensor(sum(self._limits) / 2.0)  # t/h, by the action 0
        self._shortest_delay, self._longest_delay = map(int, parameters.range_of("delay"))
        self.most_samples = self._shortest_delay + 1
        # The applied flows that the polynomial B still needs, t/h, the oldest first. At the
        # start of a block, the first of them is that of the longest delay and the last term of
        # B. No deque, as `torch.compile` forgets the length of a deque.
        self._flows = [zeros] * (self._longest_delay + len(parameters.b))
        # Temperatures of the samples before the latest block, which A needs, and of the block.
        self._outputs = [zeros] * (len(parameters.a) - 1)

    def reset(self, mask: Tensor, k: SampleNumber, numbers: PlantNumbers[Any]) -> None:
        """Bring the plants in `mask` to rest, with the parameter values `numbers`."""
        self._numbers = numbers
        self._outputs = [row.masked_fill(mask, 0.0) for row in self._outputs]
        self._flows = [row.masked_fill(mask, 0.0) for row in self._flows]
        # A command is scaled to an action and back in up to eight operations, each with a
        # relative error of at most half an eps.
        rounding = 4.0 * torch.finfo(self._zeros.dtype).eps
        self._edge: Number = least_effective_command(numbers.dead_zone, *self._limits, rounding)
        if isinstance(numbers.delay, Tensor):
            # The rows of `_flows` to which each plant responds in a block of `most_samples`.
            # With a shorter delay, these are later flows, in later rows.
            first_rows = self._longest_delay - numbers.delay.to(torch.int64)
            rows_of_block = self._shortest_delay + len(self._parameters.b)
            rows = torch.arange(rows_of_block, device=mask.device)[:, None]
            self._delayed_rows = first_rows + rows
        self._update_dynamics(k)

    def apply(self, a: Tensor) -> tuple[Tensor, Tensor]:
        """Apply the normalised actions a(k), shape (n,).

        Returns
        -------
        tuple of tensor
            Commanded flows u(k) and applied flows u_a(k), t/h, both of shape (n,). The gradient
            of the applied flow with respect to the command is 1 within the limits, even in the
            dead zone, and 0 beyond the limits.
        """
        command = torch.add(self._middle, a, alpha=self._half_range)
        if self._differentiable:
            # The value in the dead zone is 0, but the gradient is that of the command.
            limited = command.clamp(*self._limits)
            is_lost = command.detach().abs().le_(self._edge)
            applied = torch.addcmul(limited, limited.detach(), is_lost, value=-1.0)
        elif isinstance(self._edge, Tensor):
            # A product is much faster than a branch that depends on the command.
            applied = command.clamp(*self._limits).mul_(command.abs().gt_(self._edge))
        else:  # all plants have the same dead zone
            applied = torch.hardshrink(command, self._edge).clamp_(*self._limits)
        self._flows.append(applied.clone())  # a copy, as the caller may overwrite `applied`
        return command, applied

    def next(self, samples: int, k: SampleNumber, noise: Tensor, load: Tensor | None) -> Tensor:
        """Return the temperatures y at the next samples, degC, shape (samples, n).

        `samples` is at most `most_samples`. The first of these samples, k, follows the latest
        action. `noise` and `load` hold the coloured noise n and the load w, degC, shape
        (samples, n); None is a load that is always 0.
        """
        if self._parameters.drifts:  # The plants change at the first sample of a block alone.
            self._update_dynamics(k)
        # The temperatures without the terms of earlier temperatures.
        forced = _add_product(noise, self._scale, self._response(samples))
        if load is not None:
            forced = _add_product(forced, self._load_gain, load)
        for output in forced.unbind():
            for lag, alpha in enumerate(self._alpha, start=1):
                output = _add_product(output, alpha, self._outputs[-lag])
            self._outputs.append(output)  # `end_block` shortens the list.
        return torch.stack(self._outputs[-samples:])

    def end_block(self, samples: int) -> None:
        """Forget the latest block, except for its first samples, which steps have returned."""
        # As many temperatures up to the present sample as A needs, and as many flows as B needs
        # with the longest delay.
        order = len(self._parameters.a) - 1
        self._outputs = self._outputs[samples : samples + order]
        del self._flows[: -(self._longest_delay + len(self._parameters.b))]

    def detach(self) -> None:
        """Cut the gradient graph of earlier actions."""
        self._outputs = [row.detach() for row in self._outputs]
        self._flows = [row.detach() for row in self._flows]

    def _update_dynamics(self, k: SampleNumber) -> None:
        """Update the coefficients of equation (28) to the latest change up to sample k."""
        k_of_change = k - k % DRIFT_INTERVAL
        if isinstance(k_of_change, Tensor):
            k_of_change = k_of_change.to(self._zeros.dtype)
        factors = self._dynamics.factors(self._numbers, k_of_change)
        # Tensors of shape (n,), even where all plants have one factor.
        self.factors = [self._zeros + factor for factor in factors]
        self._alpha, self._scale, self._load_gain = self._dynamics.coefficients(*factors)

    def _response(self, samples: int) -> Tensor:
        """Return B(z^-1) u_a(k-d) at the next samples, degC, shape (samples, n)."""
        beta = self._parameters.b
        # One delayed flow for each sample, and earlier flows for the further terms of B.
        rows = samples + len(beta) - 1
        rows_of_all_delays = rows + self._longest_delay - self._shortest_delay
        # The first row is that of the longest delay and the last term of B.
        flows = torch.stack(self._flows[:rows_of_all_delays])
        if isinstance(self._numbers.delay, Tensor):
            flows = flows.gather(0, self._delayed_rows[:rows])  # after each plant's own delay
        response = self._zeros
        for lag, coefficient in enumerate(beta):
            first = len(beta) - 1 - lag  # a further term of B needs earlier flows
            response = torch.add(response, flows[first : first + samples], alpha=coefficient)
        return response


def _add_product(first: Tensor, factor: Number, second: Tensor) -> Tensor:
    """Return first + factor * second in one call of PyTorch, which is faster than two."""
    if isinstance(factor, Tensor):
        return torch.addcmul(first, factor, second)
    return torch.add(first, second, alpha=factor)


class _Window:
    """The latest observations of n plants: set points, errors, outputs and past actions.

    `windows` holds the number of each of the four variables in an observation.
    """

    def __init__(self, windows: Sequence[int], zeros: Tensor) -> None:
        # For each variable, the values in the observations, shape (n,) each, the newest first.
        self._rows = [[zeros] * window for window in windows]

    def reset(self, mask: Tensor, setpoint: Tensor, rest_action: Tensor) -> None:
        """Fill the observations of the plants in `mask` with the values of a plant at rest.

        `setpoint` holds the set points y_d(0), degC, and `rest_action` the actions that command
        a flow of 0 t/h, both of shape (n,).
        """
        zeros = torch.zeros_like(setpoint)
        observed_action = rest_action.clamp(-1.0, 1.0)
        # In the order of `windows`. At rest, the temperature is 0, and so is each earlier set
        # point.
        newest = setpoint, setpoint, zeros, observed_action
        earlier = zeros, zeros, zeros, observed_action
        for rows, newest_value, earlier_value in zip(self._rows, newest, earlier, strict=True):
            for i, row in enumerate(rows):
                value = earlier_value if i else newest_value  # row 0 is the newest
                rows[i] = torch.where(mask, value, row)

    def add(self, setpoint: Tensor, error: Tensor, output: Tensor, action: Tensor) -> Tensor:
        """Add a sample of each plant, and return the observations, shape (n, size).

        The sample consists of set points y_d(k+1), observed errors and outputs, all in degC,
        and normalised actions a(k), each of shape (n,).
        """
        if self._rows[-1]:  # the window of past actions is not empty
            action = action.clamp(-1.0, 1.0)
        for rows, newest in zip(self._rows, (setpoint, error, output, action), strict=True):
            rows.insert(0, newest)
            rows.pop()  # the oldest, or `newest` if the window is empty
        return self.present()

    def present(self) -> Tensor:
        """Return the present observations, shape (n, size), contiguous by column."""
        return torch.stack([row for rows in self._rows for row in rows]).t()

    def detach(self) -> None:
        """Cut the gradient graph of earlier actions."""
        self._rows = [[row.detach() for row in rows] for rows in self._rows]


class _Step(NamedTuple):
    """What a step that ends no episode returns, in tensors of shape (n,)."""

    observed: tuple[Tensor, Tensor, Tensor]  # set points, errors and measured outputs, degC
    rewards: Tensor  # without the cost of changed actions
    terminations: Tensor
    truncations: Tensor
    infos: Infos  # without commanded and applied flows

    def detach(self) -> _Step:
        """Return the same step without the gradient graph of earlier actions."""
        infos = {name: values.detach() for name, values in self.infos.items()}
        setpoint, error, output = self.observed  # no set point depends on an action
        observed = setpoint, error.detach(), output.detach()
        return self._replace(observed=observed, rewards=self.rewards.detach(), infos=infos)


def _outside_inference_mode(method: Any) -> Any:
    """Return a method that computes ordinary tensors, even within `torch.inference_mode`.

    Outside the inference mode, later steps could neither use tensors of the inference mode in a
    gradient graph nor return tensors that the caller may overwrite.
    """

    @functools.wraps(method)
    def run(*args: Any) -> Any:
        if not torch.is_inference_mode_enabled():
            return method(*args)
        with torch.inference_mode(False), torch.no_grad():
            return method(*args)

    return run


class MiddlePointTorchEnv(BatchEnv):
    """Vector environment of n plants, with PyTorch tensors as observations and actions.

    `MiddlePointTorchEnv` has the plant, the spaces, the reward, the infos and the arguments of
    `MiddlePointEnv`, and resets plants as `MiddlePointVectorEnv` does. Without random signals
    and ranges, `MiddlePointTorchEnv` and `MiddlePointVectorEnv` return the same values for the
    same actions, up to rounding. Rounding also decides whether a command exactly on the edge of
    the dead zone has an effect.

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
    `MiddlePointVectorEnv`.

    **Gradients.** The gradient of rewards and observations with respect to actions ignores the
    dead zone: a policy can learn from commands in the dead zone, although the true gradient of
    these commands is 0. The applied flow has the gradient 0 beyond the actuator's limits, the
    measured temperature has the gradient 0 beyond the transmitter's span, and with
    `action="change"`, an action has the gradient 0 beyond +-1. `detach` cuts the gradient graph
    for truncated backpropagation. An action affects the temperature after `delay` + 1 samples,
    so fewer samples than that between two calls of `detach` give no gradient through the plant.
    If `differentiable` is False, all gradients with respect to actions are 0, and the
    environment keeps no gradient graph of actions. `torch.func.jacrev` and `torch.func.jacfwd`
    give the same derivatives; `jacfwd` needs `randomness="same"` if the environment draws
    random numbers. `torch.vmap` over environments is not supported. A copy or
    a pickle of the environment, even in the middle of an episode, has no gradient graph of
    earlier actions.

    **Compilation.** A function that calls `step`, such as a loss over many steps, has the same
    values and gradients with `torch.compile`. But the compiled graph breaks within each step,
    and compilation may take minutes, so it is better to compile only the policy.

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
        max_episode_steps: int | None = EPISODE_STEPS,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        differentiable: bool = False,
        **arguments: Any,
    ) -> None:
        """Prepare the plants; the docstring of the class describes the arguments."""
        one_of("render_mode", arguments.pop("render_mode", None), [None])
        super().__init__(num_envs, max_episode_steps, autoreset_mode, arguments)
        parameters = self.parameters
        if dtype not in (torch.float32, torch.float64):
            reject("dtype", dtype, "torch.float32 or torch.float64")
        self.device = torch.device(device)
        self._zeros = torch.zeros(num_envs, dtype=dtype, device=self.device)
        self._generator = torch.Generator(self.device)
        self._generator.seed()  # from the operating system, until `reset` gets a seed
        self.dtype = dtype
        self.differentiable = differentiable
        self.checks_actions = self.device.type == "cpu"
        self._action = self._zeros  # the actions of the last step
        # Parameter values of the plants; a range is replaced by an element for each plant.
        # Until the first `_begin`, these elements are 0.
        self._numbers: dict[str, Any] = dict(vars(parameters.lowest))
        self._numbers |= dict.fromkeys(parameters.ranges, self._zeros)
        self._start: SampleNumber = 0  # clock at k = 0 of all plants or of each plant
        self._change_phases: list[int] = []  # clocks of changes of load or dynamics, modulo 10
        levels = SetPointLevels(parameters)
        setpoint = _RandomSetPoint if levels.random else _RepeatedSetPoint
        random = self._zeros, self._generator  # the last arguments of each `_Signal`
        self._signals: dict[str, Any] = {"setpoint": setpoint(levels, *random)}
        if parameters.is_disturbed:
            self._signals["disturbance"] = _Load(*random)
        for name, c in noise_polynomials(parameters).items():
            self._signals[name] = _Noise(name, c, *random)
        self._plants = _Plants(parameters, self._zeros, differentiable)
        self._wanted_flows = _WantedFlows(parameters, self._zeros)  # for the form "change"
        self._window = _Window(parameters.windows, self._zeros)
        self._block_samples = 0  # number of samples in the latest block
        self._ahead: list[_Step] = []  # the remaining steps of the block, the next step last
        self._most_samples = min(MOST_BLOCK_SAMPLES, self._plants.most_samples)
        if self.device.type == "cpu":
            # On other devices, blocks are as long as possible, as every call takes long. With
            # very many plants, blocks of less than `DRIFT_INTERVAL` samples are no faster.
            samples_in_cache = max(DRIFT_INTERVAL, VALUES_IN_CACHE // num_envs)
            self._most_samples = min(self._most_samples, samples_in_cache)
        if levels.random:  # at most one level of a plant ends in a block
            self._most_samples = min(self._most_samples, levels.shortest)

    __signature__: ClassVar[inspect.Signature] = full_signature(__init__)

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        """Return a copy of the environment, without the gradient graph of earlier actions."""
        return pickle.loads(pickle.dumps(self))

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
        for part in (self._plants, self._window, self._wanted_flows):
            part.detach()
        self._action = self._action.detach()
        self._ahead = [step.detach() for step in self._ahead]

    @_outside_inference_mode
    def _advance(self, a: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Infos]:
        """Move all plants by one sample, and return the results of a step that ends no episode.

        `a` holds the checked normalised actions, shape (num_envs,).
        """
        if self.parameters.action == "change":
            a = self._wanted_flows.change(a)
        command, applied = self._plants.apply(a)
        if not self._ahead:
            self._compute_block()  # which needs the flows up to the present one
        step = self._ahead.pop()
        observations = self._window.add(*step.observed, a)
        rewards = step.rewards
        move_weight = self.parameters.move_weight
        if move_weight:
            rewards = rewards - move_weight * (a - self._action).abs()
            self._action = a.clone()  # a copy, as the caller may overwrite the actions
        infos = step.infos | {"command": command, "applied": applied}
        return observations, rewards, step.terminations, step.truncations, infos

    def _compute_block(self) -> None:
        """Compute what the present step and the next steps return, up to an episode's end."""
        self._end_block()
        # The rows after the next end of an episode would be dropped, and computed again. While
        # a reset is pending, that end has passed.
        samples = max(1, min(self._most_samples, self._next_end - self._clock + 1))
        # Load and dynamics may change at the first sample of the block, which is the present
        # clock, but not at later samples of the block.
        for phase in self._change_phases:
            samples_to_change = (phase - self._clock - 1) % DRIFT_INTERVAL + 1  # 1 to 10
            samples = min(samples, samples_to_change)
        self._block_samples = samples
        k = self._clock - self._start
        blocks = {name: signal.next(samples, k) for name, signal in self._signals.items()}
        if "noise" not in blocks:
            blocks["noise"] = self._zeros.new_zeros(samples, self.num_envs)
        setpoint = blocks["setpoint"]
        output = self._plants.next(samples, k, blocks["noise"], blocks.get("disturbance"))
        reading = output + blocks.pop("measurement_noise", 0.0)
        span = self.parameters.temperature_span
        reading = reading.clamp(-span, span)
        blocks["output"] = output
        blocks["error"] = setpoint - output
        # A copy of the set points, as the caller may overwrite the infos.
        observed = (setpoint.clone(), setpoint - reading, reading)
        observed_rows = [*zip(*(block.unbind() for block in observed), strict=True)]
        rewards = self._rewards(blocks["error"]).unbind()
        terminations = torch.zeros_like(output, dtype=torch.bool).unbind()
        # `BatchEnv.step` truncates the last step of an episode.
        truncations = torch.zeros_like(output, dtype=torch.bool).unbind()
        rows = {name: block.unbind() for name, block in blocks.items()}
        everyone = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        shared: Infos = {f"_{name}": everyone for name in self._info_names}
        if self.parameters.drifts:
            shared |= zip(FACTORS, self._plants.factors, strict=True)
        for i in reversed(range(samples)):  # the next step last, for `pop`
            infos = {name: values[i] for name, values in rows.items()} | shared
            self._ahead.append(
                _Step(observed_rows[i], rewards[i], terminations[i], truncations[i], infos)
            )

    def _end_block(self) -> None:
        """Drop the samples of the latest block that no step has returned."""
        for part in (self._plants, *self._signals.values()):
            part.end_block(self._block_samples - len(self._ahead))
        self._ahead = []
        self._block_samples = 0

    def _rewards(self, error: Tensor) -> Tensor:
        """Return the rewards for control errors, degC, without the cost of changed actions."""
        scale = self.parameters.error_scale
        if self.parameters.reward == "quadratic":
            # The paper's cost, equation (12), scaled and negated.
            return error.square().mul_(-0.5 / scale**2)
        return error.abs().mul_(-1.0 / scale)

    @_outside_inference_mode
    def _begin(self, mask: Mask) -> dict[str, Tensor]:
        """Begin an episode of the plants in `mask`, and return infos at sample k = 0.

        The returned dict leaves out infos that are always 0 at sample k = 0. Each info is a
        tensor of shape (num_envs,), in which the elements of plants outside `mask` have no
        meaning.
        """
        self._end_block()  # as the rest of the block does not have the new episodes
        if mask.all():  # no plant depends on earlier actions any more
            self.detach()
        flags = self._as_array(mask)
        starts = self._starts
        # A number, which is faster, if all plants begin now.
        self._start = self._clock if (starts == self._clock).all() else self._as_array(starts)
        if self.parameters.is_disturbed or self.parameters.drifts:
            # Load and dynamics of a plant change when its sample number k is a multiple of 10.
            # These are Python numbers, as reading a tensor would wait for the device.
            self._change_phases = np.unique(starts % DRIFT_INTERVAL).tolist()
        k = self._clock - self._start
        infos: dict[str, Tensor] = {}
        for name, (low, high) in self.parameters.ranges.items():
            infos[name] = _uniform(low, high, self._zeros, self._generator)
            self._numbers[name] = torch.where(flags, infos[name], self._numbers[name])
        numbers = PlantNumbers(**self._numbers)
        self._plants.reset(flags, k, numbers)
        self._wanted_flows.reset(flags)
        first_values = {
            name: signal.reset(flags, numbers) for name, signal in self._signals.items()
        }
        setpoint = first_values["setpoint"]
        rest_action = self._zeros + action_from_command(0.0, numbers.u_min, numbers.u_max)
        self._action = torch.where(flags, rest_action, self._action)
        self._window.reset(flags, setpoint, rest_action)
        infos |= {"setpoint": setpoint, "error": setpoint}
        if self.parameters.drifts:
            infos |= zip(FACTORS, self._plants.factors, strict=True)
        return infos

    def _final_observations(self, ended: Mask, observations: Tensor) -> Tensor:
        """Return `observations`, with 0 in the rows of plants that are not in `ended`."""
        return torch.where(self._as_array(ended)[:, None], observations, 0)

    def _as_array(self, values: NDArray[Any]) -> Tensor:
        """Return a NumPy array as a new tensor, without waiting for the device."""
        return torch.from_numpy(values).to(self.device, copy=True, non_blocking=True)

    def _prepare(self, mask: Mask, seed: Any) -> None:
        """Restart the random number generator of all plants with the seed, if there is one.

        A ValueError is raised if `seed` is invalid.
        """
        if seed is not None:
            self._generator.manual_seed(checks.seed("seed", seed))
        self._np_random_seed = self._generator.initial_seed()

    def _checked_actions(self, actions: Any) -> Tensor:
        """Return the actions, shape (num_envs,), with 0 for plants whose episode has ended.

        A ValueError is raised if the shape is not (num_envs, 1), or, with `checks_actions`, if
        an action is not finite.
        """
        try:
            column = torch.as_tensor(actions, dtype=self.dtype, device=self.device)
        except NOT_A_NUMBER as error:
            reject("actions", actions, f"numbers ({error})")
        if column.shape != (self.num_envs, 1):
            reject("actions", actions, f"numbers, shape ({self.num_envs}, 1)")
        if not self.differentiable:
            column = column.detach()
        a: Tensor = column.reshape(-1)
        if self._ended is not None:
            a = a.masked_fill(self._as_array(self._ended), 0.0)
        # The sum of squares, which is fast, is finite if all actions are finite and none huge.
        is_finite = not self.checks_actions or math.isfinite(a.dot(a).item())
        if not is_finite and not a.isfinite().all():
            reject("actions", actions, "finite")
        return a


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
        If `env` is not a `MiddlePointEnv` or has wrappers, or if an argument is out of range.
    """
    spec = gymnasium.spec(env) if isinstance(env, str) else env
    if spec.entry_point != "mptc_gym.env:make_env" or spec.additional_wrappers:
        reject("env", env, "the id or the spec of a MiddlePointEnv, without wrappers")
    plant = {
        name: value for name, value in {**spec.kwargs, **arguments}.items() if name in ARGUMENTS
    }
    limit = arguments.pop("max_episode_steps", spec.max_episode_steps)
    envs = MiddlePointTorchEnv(num_envs, max_episode_steps=limit, **{**plant, **arguments})
    envs.spec = replace(spec, max_episode_steps=None if limit == -1 else limit, kwargs=plant)
    return envs
