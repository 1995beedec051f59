"""Keep the episodes of many plants in PyTorch: times, plant numbers, values from outside.

The environment computes blocks of samples ahead. Times are counted in steps of the environment.
A reset of some plants may come before the environment has returned all samples of a block. The
unused samples at the end of the block are then dropped, and computed anew for all plants.
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

LONGEST = 64  # most samples in a block, which bounds the memory of a block
SIGNALS = ("noise", "setpoint", "disturbance", "measurement_noise")  # signals from outside
Number = float | Tensor  # a float for all plants, or an element for each plant, shape (n,)


def as_tensor(values: Any, like: Tensor) -> Tensor | None:
    """Return numbers as a tensor of the type and on the device of `like`.

    The result is None if PyTorch cannot convert `values`.
    """
    try:
        return torch.as_tensor(values, dtype=like.dtype, device=like.device)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        return None


class Block(NamedTuple):
    """A block of consecutive samples that are computed at once: one row for each sample."""

    first_time: int  # time of row 0, in steps of the environment
    samples: int  # number of rows
    starts: Tensor | int  # time at k = 0 of each plant, shape (n,), or one time for all plants
    due_rows: list[int]  # rows at which the load and the drifts of some plant are due to change

    def age(self, row: int) -> Tensor | int:
        """Return the sample k of a row, shape (n,), or one number for all plants."""
        return self.first_time + row - self.starts

    def ages(self, device: torch.device) -> Tensor:
        """Return the sample k of all rows, on the given device.

        The shape is (samples, n), or (samples, 1) if the episodes of all plants began at one
        time.
        """
        return torch.arange(self.samples, device=device)[:, None] + self.age(0)


class History:
    """The latest values of a quantity of n plants: one tensor of shape (n,) for each sample.

    Parameters
    ----------
    zeros
        Zeros of the device and type to use, shape (n,).
    length
        How many samples before the latest block are kept.

    Attributes
    ----------
    rows : list of Tensor
        The values, the oldest first: the values of the `length` samples before the latest
        block, then the values of the block.
    """

    def __init__(self, zeros: Tensor, length: int) -> None:
        self.rows = [zeros] * length
        self._length = length

    def extend(self, block: Sequence[Tensor]) -> None:
        """Add the values of a block, each of shape (n,), and forget values of older blocks."""
        self.rows = [*self.rows[len(self.rows) - self._length :], *block]

    def reset(self, mask: Tensor, rows_to_drop: int, newest: Tensor | None = None) -> None:
        """Begin an episode of the plants in a mask, with zeros before sample k = 0.

        Parameters
        ----------
        mask
            True for the plants to reset, shape (n,).
        rows_to_drop
            How many samples at the end of the latest block are dropped, as the environment has
            not returned them.
        newest
            The values at k = 0, shape (n,); None stands for zeros.
        """
        end = len(self.rows) - rows_to_drop
        rows = self.rows[end - self._length : end]
        self.rows = [row.masked_fill(mask, 0.0) for row in rows]
        if self.rows and newest is not None:
            self.rows[-1] = torch.where(mask, newest, self.rows[-1])

    def detach(self) -> None:
        """Cut the gradient graph from the values to earlier actions."""
        self.rows = [row.detach() for row in self.rows]


class Episodes:
    """The present episodes of n plants: when the episodes began, and the plant numbers.

    Parameters
    ----------
    parameters
        The arguments of the environment.
    zeros
        Zeros of the device and type to use, shape (n,).

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
        # `DRIFT_INTERVAL`: when the time, divided by `DRIFT_INTERVAL`, leaves one of these
        # remainders. The remainders are on the host, so that nothing waits for the device.
        self._due_remainders: set[int] = set()

    def reset(
        self,
        mask: Tensor,
        time: int,
        starts: NDArray[np.int64],
        external: Mapping[str, "External"],
    ) -> dict[str, Tensor]:
        """Begin an episode of some plants, and return the plant numbers that are ranges.

        Parameters
        ----------
        mask
            True for the plants whose episode begins, shape (n,).
        time
            The present time, in steps of the environment.
        starts
            The time at which each plant's present episode began, shape (n,): `time` for the
            plants in the mask.
        external
            The plant numbers that come from outside instead of being random, by name.

        Returns
        -------
        dict of Tensor
            The plant numbers by name, shape (n,). Only the elements of plants in the mask have
            a meaning.
        """
        numbers: dict[str, Tensor] = {}
        for name, (low, high) in self._ranges.items():
            is_integer = isinstance(low, int)
            if name in external:
                values = external[name].reset(mask)
            else:
                values = self.draw(low, high, is_integer)
            self.numbers[name] = torch.where(mask, values, self.numbers[name])
            numbers[name] = values.to(torch.int64) if is_integer else values
        if (starts == time).all():
            self.starts = time
        else:
            previous_starts = torch.zeros_like(mask, dtype=torch.int64) + self.starts
            self.starts = previous_starts.masked_fill(mask, time)
        self._due_remainders = set(np.unique(starts % DRIFT_INTERVAL).tolist())
        return numbers

    def block(self, first_time: int, samples: int) -> Block:
        """Return the block of `samples` samples from the time `first_time` on."""
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

    def draw(self, low: float, high: float, is_integer: bool) -> Tensor:
        """Return random numbers, uniform from `low` to `high`, both included.

        The numbers are integers if `is_integer` is True. The result has the shape (n,) and
        always the floating-point type of `zeros`.
        """
        numbers = torch.empty_like(self.zeros)
        numbers.uniform_(low, high + is_integer, generator=self.generator)
        if is_integer:
            numbers = numbers.floor()
        return numbers.clamp(max=high)


class External:
    """A signal, or a plant number, that is read from a tensor instead of being random.

    After the last episode in the tensor, the first episode follows again. After the last sample
    of an episode, the value of this sample is held. A plant number has one sample, which
    `reset` returns.

    Parameters
    ----------
    values
        The values of the signal, degC, or of the plant number, shape (episodes, samples, n).

    Attributes
    ----------
    last_sample : int
        The last sample k of an episode that has a value of its own.
    """

    def __init__(self, values: Tensor) -> None:
        self._values = values
        # The index of each plant's present episode, shape (n,).
        self._episode = torch.full_like(values[0, 0], -1, dtype=torch.int64)
        self.last_sample = values.shape[1] - 1

    def reset(self, mask: Tensor, rows_to_drop: int = 0) -> Tensor:
        """Begin the next episode of the plants in `mask`; return the values at k = 0.

        The values have the shape (n,). `rows_to_drop` is an argument of every signal, but is
        not needed: `next` reads the values by the sample k alone.
        """
        self._episode = self._episode + mask
        return self._at(torch.zeros_like(self._episode)[None])[0]

    def next(self, block: Block) -> Tensor:
        """Return the values at the samples of a block, shape (samples, n)."""
        return self._at(block.ages(self._values.device))

    def _at(self, ages: Tensor) -> Tensor:
        """Return the values of the present episodes at given samples k, shape (samples, n).

        `ages` are the samples k, of shape (samples, n), or (samples, 1) for all plants.
        """
        episodes, samples, _ = self._values.shape
        rows = self._episode % episodes * samples + ages.clamp(max=samples - 1)
        return self._values.flatten(0, 1).gather(0, rows)


def read_signals(signals: Any, parameters: Parameters, zeros: Tensor) -> dict[str, External]:
    """Return the signals and parameters of the plants in `options["signals"]` of a reset.

    Parameters
    ----------
    signals
        A dict of values by name, as in `MiddlePointTorchEnv`; None for no signals from outside.
    parameters
        The arguments of the environment.
    zeros
        Zeros of the device and type to use, shape (n,).

    Raises
    ------
    ValueError
        If a name is unknown, or if values have the wrong shape, are not finite or out of range.
    """
    if signals is None:
        return {}
    names = {*SIGNALS, *parameters.ranges}
    if not parameters.is_disturbed:
        names.remove("disturbance")
    allowed = f"a dict with some of {sorted(names)}"
    if not isinstance(signals, Mapping):
        reject("options['signals']", signals, allowed)
    if not signals or not names >= {*signals}:
        reject("options['signals']", [*signals], allowed)
    checked: dict[str, External] = {}
    for name, value in signals.items():
        ends = parameters.ranges.get(name)
        path = f"options['signals'][{name!r}]"
        checked[name] = External(_read_values(path, value, ends, zeros))
    return checked


def _read_values(
    path: str, value: Any, ends: tuple[float, float] | None, zeros: Tensor
) -> Tensor:
    """Return the values of a signal or a plant number, shape (episodes, samples, n).

    Parameters
    ----------
    path
        What an error message calls the values.
    value
        Numbers of shape (samples, n) for a signal, or (n,) for a plant number, or with a
        leading dimension of episodes.
    ends
        The lowest and the highest value of a plant number; None stands for a signal.
    zeros
        Zeros of the device and type to use, shape (n,).

    Raises
    ------
    ValueError
        If the values are no finite numbers, or are of a wrong shape or out of range.
    """
    n = len(zeros)
    shape = f"(samples, {n})" if ends is None else f"({n},)"
    values = as_tensor(value, zeros)
    if values is None:
        reject(path, value, "numbers")
    shape_of_values = tuple(values.shape)
    if ends is not None and values.ndim:
        values = values.unsqueeze(-2)  # adds the axis of samples: a plant number has one sample
    if values.ndim == 2:
        values = values[None]  # adds the axis of episodes, of length 1
    if values.ndim != 3 or values.shape[-1] != n or not values.numel():
        raise ValueError(
            f"{path} must have the shape {shape}, or one more dimension before it, of "
            f"episodes, got {shape_of_values}"
        )
    if not values.isfinite().all():
        raise ValueError(f"{path} must be finite")
    if ends is not None:
        low, high = values.new_tensor(ends)
        fits = (low <= values) & (values <= high)
        if isinstance(ends[0], int):
            fits &= values == values.round()
        if not fits.all():
            reject(path, value, f"within the range of this argument, {list(ends)}")
    return values
