"""Keep start times, parameter values and external signals of many plants in PyTorch.

Times are counted in steps of the environment, except steps that only reset plants. The
environment computes a block of successive samples in advance. If some plants are reset before
`step` has returned all samples of a block, the unused samples at the end of the block are
dropped, and computed again for all plants.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mptc_gym.plant.checks import reject
from mptc_gym.plant.dynamics import DRIFT_INTERVAL
from mptc_gym.plant.parameters import Parameters

MOST_BLOCK_SAMPLES = 64  # most samples in a block, which bounds the memory of a block
SIGNAL_NAMES = ("noise", "setpoint", "disturbance", "measurement_noise")
Number = float | Tensor  # a float for all plants, or an element for each plant, shape (n,)


def as_tensor(values: Any, like: Tensor) -> Tensor | None:
    """Return numbers as a tensor of the type and on the device of `like`.

    None is returned if PyTorch cannot convert `values`.
    """
    try:
        return torch.as_tensor(values, dtype=like.dtype, device=like.device)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        return None


def copy_to_device(array: NDArray[Any], device: torch.device) -> Tensor:
    """Return a NumPy array as a new tensor on a device, without waiting for the device."""
    on_host = torch.from_numpy(array)
    on_device: Tensor = torch.empty(on_host.shape, dtype=on_host.dtype, device=device)
    return on_device.copy_(on_host, non_blocking=True)


class Block(NamedTuple):
    """A block of consecutive samples that are computed at once: one row for each sample."""

    first_time: int  # time of row 0, in steps of the environment
    samples: int  # number of rows
    starts: Tensor | int  # time at k = 0 of each plant, shape (n,), or one time for all plants
    due_rows: list[int]  # rows at which the load or dynamics of some plant can change

    def age(self, row: int) -> Tensor | int:
        """Return the sample number k at a row of the block, shape (n,), or one number."""
        return self.first_time + row - self.starts

    def ages(self, device: torch.device) -> Tensor:
        """Return the sample numbers k at all rows of the block, as a tensor on `device`.

        The returned tensor has the shape (samples, n), or (samples, 1) if the episodes of all
        plants began at one time.
        """
        return torch.arange(self.samples, device=device)[:, None] + self.age(0)


class Restart(NamedTuple):
    """Start of an episode of some plants, perhaps in the middle of a block of samples."""

    mask: Tensor  # True for the plants whose episode begins, shape (n,)
    unused_rows: int  # number of rows of the latest block that no `step` has returned


class History:
    """Latest samples of one variable of n plants, such as the temperature.

    Attributes
    ----------
    rows : list of Tensor
        Values of the variable, one tensor of shape (n,) for each sample, the oldest first: a
        fixed number of samples before the latest block of successive samples, then the samples
        of the block.
    """

    def __init__(self, zeros: Tensor, length: int) -> None:
        """Begin with `length` samples, each equal to `zeros`, shape (n,)."""
        self.rows = [zeros] * length
        self._length = length

    def extend(self, block: Sequence[Tensor]) -> None:
        """Append the samples of `block`, and drop samples that are no longer needed."""
        self.rows = [*self.rows[len(self.rows) - self._length :], *block]

    def reset(self, restart: Restart, newest: Tensor | None = None) -> None:
        """Set all values of the plants in `restart.mask` to 0, for a new episode.

        The last `restart.unused_rows` samples, which no `step` has returned, are dropped for
        all plants. If `newest`, shape (n,), is given, the values of the plants in
        `restart.mask` at sample k = 0 are `newest` instead of 0.
        """
        end = len(self.rows) - restart.unused_rows
        rows = self.rows[end - self._length : end]
        self.rows = [row.masked_fill(restart.mask, 0.0) for row in rows]
        if self.rows and newest is not None:
            self.rows[-1] = torch.where(restart.mask, newest, self.rows[-1])

    def detach(self) -> None:
        """Detach all values from PyTorch's gradient graph of earlier actions."""
        self.rows = [row.detach() for row in self.rows]


class Episodes:
    """Present episodes of n plants, with the parameter values of each plant.

    Attributes
    ----------
    zeros : Tensor
        Zeros, shape (n,), with the device and the data type of all tensors of the environment.
    generator : torch.Generator
        Random number generator of the environment.
    numbers : dict
        Parameter values of the plants by name, as floats or as tensors of shape (n,).
    starts : Tensor or int
        Start time of each plant's episode, in steps of the environment, shape (n,), or one
        start time for all plants.
    """

    def __init__(self, parameters: Parameters, zeros: Tensor) -> None:
        """Prepare the parameter values of n plants, before the first reset.

        `zeros` holds n zeros, with the device and the data type of all tensors of the
        environment.
        """
        self.zeros = zeros
        self.generator = torch.Generator(zeros.device)
        self.generator.seed()  # from the operating system, until `reset` gets a seed
        self._ranges = parameters.ranges
        tensor_names = set(self._ranges)
        self.numbers: dict[str, Number] = {}
        for name, lowest in vars(parameters.lowest).items():
            self.numbers[name] = zeros + lowest if name in tensor_names else float(lowest)
        self.starts: Tensor | int = 0
        # The load and the drifting dynamics of a plant change when the sample number k of the
        # plant is a multiple of `DRIFT_INTERVAL`: when the time and the start time of the
        # plant's episode leave equal remainders, divided by `DRIFT_INTERVAL`. The remainders
        # are Python numbers, so that reading a remainder does not wait for the device.
        self._due_remainders: set[int] = set()

    def reset(
        self,
        restart: Restart,
        time: int,
        starts: NDArray[np.int64],
        external: Mapping[str, "ExternalValues"],
    ) -> dict[str, Tensor]:
        """Begin an episode of some plants, and return new values of arguments that are ranges.

        Parameters
        ----------
        restart
            Plants whose episode begins.
        time
            Present time, in steps of the environment.
        starts
            Start time of each plant's episode, in steps of the environment, shape (n,): for
            plants whose episode begins, the start time is `time`.
        external
            Parameter values that the user gives, by name, in place of random values.

        Returns
        -------
        dict of Tensor
            New values of the arguments that are ranges, by name of the argument, shape (n,).
            Elements of plants outside `restart.mask` have no meaning.
        """
        numbers: dict[str, Tensor] = {}
        for name, (low, high) in self._ranges.items():
            is_integer = isinstance(low, int)
            if name in external:
                values = external[name].reset(restart)
            else:
                values = self.draw(low, high, is_integer=is_integer)
            self.numbers[name] = torch.where(restart.mask, values, self.numbers[name])
            numbers[name] = values.to(torch.int64) if is_integer else values
        self.starts = time
        if (starts != time).any():
            self.starts = copy_to_device(starts, self.zeros.device)
        self._due_remainders = set(np.unique(starts % DRIFT_INTERVAL).tolist())
        return numbers

    def block(self, first_time: int, samples: int) -> Block:
        """Return a block of `samples` samples, whose row 0 is at the time `first_time`."""
        due_rows = [
            row
            for row in range(samples)
            if (first_time + row) % DRIFT_INTERVAL in self._due_remainders
        ]
        return Block(first_time, samples, self.starts, due_rows)

    def draw_within_one(self, rows: int) -> Tensor:
        """Return random numbers, uniform from -1 to 1 (1 excluded), shape (rows, n)."""
        numbers = self.zeros.new_empty(rows, len(self.zeros))
        return numbers.uniform_(-1.0, 1.0, generator=self.generator)

    def draw(self, low: float, high: float, *, is_integer: bool) -> Tensor:
        """Return random numbers, uniform from `low` to `high`, both included, shape (n,).

        If `is_integer` is True, the numbers are integers in a tensor of floats.
        """
        numbers = torch.empty_like(self.zeros)
        numbers.uniform_(low, high + is_integer, generator=self.generator)
        if is_integer:
            numbers = numbers.floor()
        return numbers.clamp(max=high)


class ExternalValues:
    """A signal, or a parameter of the plants, whose values the user gives in a tensor.

    After the last episode in the tensor, the next episode of a plant uses the first episode in
    the tensor again. Beyond the last sample in the tensor, a signal keeps its last value.

    Attributes
    ----------
    last_sample : int
        Last sample number k of an episode for which the tensor has a value.
    """

    def __init__(self, values: Tensor) -> None:
        """Store the values of a signal of n plants, degC, shape (episodes, samples, n).

        For a parameter of the plants, such as the delay, the number of samples is 1, and the
        values have the unit of the parameter.
        """
        self._values = values
        # The index of each plant's present episode, shape (n,).
        self._episode = torch.full_like(values[0, 0], -1, dtype=torch.int64)
        self.last_sample = values.shape[1] - 1

    def reset(self, restart: Restart) -> Tensor:
        """Begin an episode of plants in `restart.mask`, and return all plants' values at k = 0.

        The returned values have the shape (n,).
        """
        self._episode = self._episode + restart.mask
        return self._at(torch.zeros_like(self._episode)[None])[0]

    def next(self, block: Block) -> Tensor:
        """Return the values at the samples of `block`, shape (samples, n)."""
        return self._at(block.ages(self._values.device))

    def _at(self, ages: Tensor) -> Tensor:
        """Return the values of the present episodes at the sample numbers `ages`.

        `ages` has the shape (samples, n), or (samples, 1) for all plants. The returned values
        have the shape (samples, n).
        """
        episodes, samples, _ = self._values.shape
        # With episodes and samples as one axis, an episode begins every `samples` rows.
        values = self._values.flatten(0, 1)
        first_rows = (self._episode % episodes) * samples
        return values.gather(0, first_rows + ages.clamp(max=samples - 1))


def read_external(
    signals: Any, parameters: Parameters, zeros: Tensor
) -> dict[str, ExternalValues]:
    """Return the signals and parameter values in `options["signals"]` of a reset, by name.

    A ValueError is raised for an unknown name, and for values that have the wrong shape, are
    not finite or out of range. `signals` is `options["signals"]`, as in `MiddlePointTorchEnv`,
    or None without that option. `zeros` holds n zeros, with the device and the data type of all
    tensors of the environment.
    """
    if signals is None:
        return {}
    names = {*SIGNAL_NAMES, *parameters.ranges}
    if not parameters.is_disturbed:
        names.remove("disturbance")
    allowed = f"a dict with some of {sorted(names)}"
    if not isinstance(signals, Mapping):
        reject("options['signals']", signals, allowed)
    if not signals or not names >= {*signals}:
        reject("options['signals']", [*signals], allowed)
    n = len(zeros)
    external: dict[str, ExternalValues] = {}
    for name, value in signals.items():
        path = f"options['signals'][{name!r}]"
        if name in parameters.ranges:
            values = _finite_values(path, value, zeros, 1, f"({n},)")
            _check_range(path, values, parameters.ranges[name])
            values = values[:, None]  # adds the axis of samples, of length 1
        else:
            values = _finite_values(path, value, zeros, 2, f"(samples, {n})")
        external[name] = ExternalValues(values)
    return external


def _finite_values(path: str, value: Any, zeros: Tensor, dimensions: int, shape: str) -> Tensor:
    """Return numbers of the user as a tensor that has a leading dimension of episodes.

    The numbers `value` may lack the leading dimension of episodes. The numbers of one episode
    have `dimensions` dimensions, of which the last has the size n of `zeros`. A ValueError is
    raised if a number is not finite, or if `value` has a wrong shape; the message contains the
    texts `path`, which names the numbers, and `shape`, the right shape.
    """
    values = as_tensor(value, zeros)
    if values is None:
        reject(path, value, "numbers")
    shape_of_values = tuple(values.shape)
    if values.ndim == dimensions:
        values = values[None]
    has_shape = values.ndim == dimensions + 1 and values.shape[-1] == len(zeros)
    if not has_shape or not values.numel():
        raise ValueError(
            f"{path} must have the shape {shape}, or a leading dimension of episodes before "
            f"this shape, got {shape_of_values}"
        )
    if not values.isfinite().all():
        raise ValueError(f"{path} must be finite")
    return values


def _check_range(path: str, values: Tensor, ends: tuple[float, float]) -> None:
    """Raise a ValueError if one of `values` is not in the range of an argument.

    `ends` are the lower and the upper end of the range. If the ends of the range are integers,
    all values must be integers. The error message contains the text `path` as the name of the
    values.
    """
    low, high = values.new_tensor(ends)
    fits = (low <= values) & (values <= high)
    if isinstance(ends[0], int):
        fits &= values == values.round()
    if not fits.all():
        reject(path, values, f"within the range of this argument, {list(ends)}")
