"""Keep the episodes of many plants in PyTorch: times, plant numbers, external values.

Times are counted in steps of the environment, which computes blocks of samples ahead. If some
plants are reset before `step` has returned all samples of a block, the unused samples at the
end of the block are dropped, and computed anew for all plants.
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

    The result is None if PyTorch cannot convert `values`.
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
    due_rows: list[int]  # rows at which the load or the dynamics of some plant change

    def age(self, row: int) -> Tensor | int:
        """Return the sample k of a row, shape (n,), or one number for all plants."""
        return self.first_time + row - self.starts

    def ages(self, device: torch.device) -> Tensor:
        """Return the sample k of all rows, on the given device.

        The shape is (samples, n), or (samples, 1) if all episodes began at one time.
        """
        return torch.arange(self.samples, device=device)[:, None] + self.age(0)


class Restart(NamedTuple):
    """The start of an episode of some plants, perhaps in the middle of a block."""

    mask: Tensor  # True for the plants whose episode begins, shape (n,)
    unused_rows: int  # rows at the end of the latest block that no `step` has returned


class History:
    """The latest values of a quantity of n plants.

    Attributes
    ----------
    rows : list of Tensor
        The values, one tensor of shape (n,) for each sample, the oldest first: some samples
        before the latest block, then the samples of the block.
    """

    def __init__(self, zeros: Tensor, length: int) -> None:
        """Begin with values of 0, shape (n,), and keep `length` samples before each block."""
        self.rows = [zeros] * length
        self._length = length

    def extend(self, block: Sequence[Tensor]) -> None:
        """Add the values of a block, each of shape (n,), and forget values of older blocks."""
        self.rows = [*self.rows[len(self.rows) - self._length :], *block]

    def reset(self, restart: Restart, newest: Tensor | None = None) -> None:
        """Begin an episode of the plants in `restart.mask`, with values of 0.

        Samples that no step has returned are forgotten for all plants. If `newest`, shape (n,),
        is given, the values at k = 0 are not 0, but `newest`.
        """
        end = len(self.rows) - restart.unused_rows
        rows = self.rows[end - self._length : end]
        self.rows = [row.masked_fill(restart.mask, 0.0) for row in rows]
        if self.rows and newest is not None:
            self.rows[-1] = torch.where(restart.mask, newest, self.rows[-1])

    def detach(self) -> None:
        """Cut the gradient graph from the values to earlier actions."""
        self.rows = [row.detach() for row in self.rows]


class Episodes:
    """The present episodes of n plants: when the episodes began, and the plant numbers.

    Attributes
    ----------
    zeros : Tensor
        Zeros of the device and type to use, shape (n,).
    generator : torch.Generator
        The source of all random numbers.
    numbers : dict
        The plant numbers by name, floats or tensors of shape (n,).
    starts : Tensor or int
        The time at which each plant's episode began, shape (n,), or one time for all plants, in
        steps of the environment.
    """

    def __init__(self, parameters: Parameters, zeros: Tensor) -> None:
        """Prepare the plant numbers of n plants, before the first reset.

        `zeros`, shape (n,), has the device and the type of all tensors.
        """
        self.zeros = zeros
        self.generator = torch.Generator(zeros.device)
        self.generator.seed()  # from the operating system, until `reset` gets a seed
        self._ranges = parameters.ranges
        tensor_names = set(self._ranges)
        # If one limit of the actuator is random, both limits are tensors: PyTorch clamps either
        # between two numbers or between two tensors.
        limits = {"u_min", "u_max"}
        if limits & tensor_names:
            tensor_names |= limits
        self.numbers: dict[str, Number] = {}
        for name, lowest in vars(parameters.lowest).items():
            self.numbers[name] = zeros + lowest if name in tensor_names else float(lowest)
        self.starts: Tensor | int = 0
        # Load and drifting dynamics change when the age of an episode is a multiple of
        # `DRIFT_INTERVAL`: when the time, divided by `DRIFT_INTERVAL`, leaves the remainder of
        # an episode's start. The remainders are on the host, so that nothing waits for the
        # device.
        self._due_remainders: set[int] = set()

    def reset(
        self,
        restart: Restart,
        time: int,
        starts: NDArray[np.int64],
        external: Mapping[str, "ExternalValues"],
    ) -> dict[str, Tensor]:
        """Begin an episode of some plants, and return the plant numbers that are ranges.

        Parameters
        ----------
        restart
            Which plants begin an episode.
        time
            The present time, in steps of the environment.
        starts
            The time at which each plant's episode began, shape (n,): `time` for plants whose
            episode begins.
        external
            Plant numbers from outside, by name, in place of random numbers.

        Returns
        -------
        dict of Tensor
            The plant numbers by name, shape (n,). Elements of other plants have no meaning.
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
        """Return the block of `samples` samples from the time `first_time` on.

        The block also lists the rows at which the load or the dynamics of some plant change.
        """
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

        The numbers are integers if `is_integer` is True, but have the type of `zeros`.
        """
        numbers = torch.empty_like(self.zeros)
        numbers.uniform_(low, high + is_integer, generator=self.generator)
        if is_integer:
            numbers = numbers.floor()
        return numbers.clamp(max=high)


class ExternalValues:
    """A signal, or a plant number, that is read from a tensor instead of being random.

    After its last episode, the tensor is read from its first episode on again. After the last
    sample of an episode in the tensor, a signal keeps its last value.

    Attributes
    ----------
    last_sample : int
        The last sample k of an episode for which the tensor has a value.
    """

    def __init__(self, values: Tensor) -> None:
        """Store values, degC, of a signal of n plants, shape (episodes, samples, n).

        A plant number, such as a delay, is a signal of one sample in the number's own unit.
        """
        self._values = values
        # The index of each plant's present episode, shape (n,).
        self._episode = torch.full_like(values[0, 0], -1, dtype=torch.int64)
        self.last_sample = values.shape[1] - 1

    def reset(self, restart: Restart) -> Tensor:
        """Begin the next episode of the plants in `restart.mask`; return values at k = 0.

        The values have the shape (n,).
        """
        self._episode = self._episode + restart.mask
        return self._at(torch.zeros_like(self._episode)[None])[0]

    def next(self, block: Block) -> Tensor:
        """Return the values at the samples of a block, shape (samples, n)."""
        return self._at(block.ages(self._values.device))

    def _at(self, ages: Tensor) -> Tensor:
        """Return the values of the present episodes at given samples k, shape (samples, n).

        `ages` are the samples k, of shape (samples, n), or (samples, 1) for all plants.
        """
        episodes, samples, _ = self._values.shape
        # With episodes and samples as one axis, an episode begins every `samples` rows.
        values = self._values.flatten(0, 1)
        first_rows = (self._episode % episodes) * samples
        return values.gather(0, first_rows + ages.clamp(max=samples - 1))


def read_external(
    signals: Any, parameters: Parameters, zeros: Tensor
) -> dict[str, ExternalValues]:
    """Return the signals and plant numbers in `options["signals"]` of a reset, by name.

    A ValueError is raised for an unknown name, and for values that have the wrong shape, are
    not finite or out of range.

    Parameters
    ----------
    signals
        `options["signals"]`, as in `MiddlePointTorchEnv`; None if there is no such option.
    parameters
        The arguments of the environment.
    zeros
        Zeros of the device and type to use, shape (n,).
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
            values = values[:, None]  # adds the axis of samples: a plant number has one sample
        else:
            values = _finite_values(path, value, zeros, 2, f"(samples, {n})")
        external[name] = ExternalValues(values)
    return external


def _finite_values(path: str, value: Any, zeros: Tensor, dimensions: int, shape: str) -> Tensor:
    """Return numbers of the user as a tensor that has a leading dimension of episodes.

    A ValueError is raised if `value` holds no finite numbers, or has a wrong shape.

    Parameters
    ----------
    path
        What an error message calls the numbers.
    value
        The numbers, with or without the dimension of episodes.
    zeros
        Zeros of the device and type to use, shape (n,).
    dimensions
        Number of dimensions without the dimension of episodes; the last has the size n.
    shape
        The shape of the numbers of one episode, for an error message.
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
            f"{path} must have the shape {shape}, or one more dimension before it, of "
            f"episodes, got {shape_of_values}"
        )
    if not values.isfinite().all():
        raise ValueError(f"{path} must be finite")
    return values


def _check_range(path: str, values: Tensor, ends: tuple[float, float]) -> None:
    """Raise a ValueError if a plant number is outside the range from which it is drawn.

    `path` is what the message calls the plant number. If the ends of the range are integers,
    the plant number must be an integer.
    """
    low, high = values.new_tensor(ends)
    fits = (low <= values) & (values <= high)
    if isinstance(ends[0], int):
        fits &= values == values.round()
    if not fits.all():
        reject(path, values, f"within the range of this argument, {list(ends)}")
