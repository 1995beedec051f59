"""Keep the episodes of many plants in PyTorch: times, plant numbers, values from outside."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mptc_gym.checks import reject
from mptc_gym.parameters import PLANT_NUMBERS, Parameters
from mptc_gym.plant import DRIFT_INTERVAL

LONGEST = 64  # most samples in a block
SIGNALS = ("noise", "setpoint", "disturbance", "measurement_noise")
Number = float | Tensor  # one for all plants, or one per plant, shape (n,)


def as_tensor(values: Any, like: Tensor) -> Tensor | None:
    """Return numbers as a tensor of the type and device of `like`, or None if they are not."""
    try:
        return torch.as_tensor(values, dtype=like.dtype, device=like.device)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        return None


class Episodes:
    """The current episodes of n plants: their starts and plant numbers, and the clock.

    The environment computes blocks of samples ahead. A reset may come before all of a block has
    been used.

    Attributes
    ----------
    zeros : Tensor
        Zeros of the device and type to use, shape (n,).
    generator : torch.Generator
        The source of all random numbers.
    numbers : dict
        The plant numbers by name, floats or tensors of shape (n,).
    clock : int
        Set by the environment: before `next` of a signal, the time of the first sample of the
        block; before `reset`, the time at which the new episodes begin. Times are counted in
        steps of the environment.
    unused : int
        Set by the environment before `reset`: how many samples at the end of the latest block
        have not been used. They lie beyond the clock, and signals drop them.
    """

    def __init__(self, parameters: Parameters, zeros: Tensor) -> None:
        self.zeros = zeros
        self.generator = torch.Generator(zeros.device)
        self.generator.seed()  # from the operating system, until `reset` gets a seed
        self.clock = 0
        self.unused = 0
        self._ranges = parameters.ranges
        tensor_names = set(self._ranges)
        # If one limit is drawn, both are tensors: PyTorch clamps either between two numbers or
        # between two tensors.
        limits = {"u_min", "u_max"}
        if limits & tensor_names:
            tensor_names |= limits
        self.numbers: dict[str, Number] = {}
        for name in PLANT_NUMBERS:
            lowest = float(parameters.range_of(name)[0])
            self.numbers[name] = zeros + lowest if name in tensor_names else lowest
        # The time at the start of each plant's episode, shape (n,), or one time for all plants.
        self._starts: Tensor | int = 0
        # Load and drifting dynamics change when the age of an episode is a multiple of
        # `DRIFT_INTERVAL`. These are the remainders of the clock at which this happens to a
        # plant. They are known on the host, so that nothing has to wait for the device.
        self._has_changes = parameters.drifts or parameters.is_disturbed
        self._due_remainders: set[int] = set()
        self._rows = torch.arange(LONGEST, device=zeros.device)[:, None]

    def reset(
        self, mask: Tensor, starts: NDArray[np.int64], given: Mapping[str, "Given"]
    ) -> dict[str, Tensor]:
        """Begin an episode of some plants, and return the plant numbers that are ranges.

        Parameters
        ----------
        mask
            The plants, shape (n,).
        starts
            The time at the start of each plant's present episode, shape (n,): `clock` for the
            plants in the mask.
        given
            Plant numbers that are not drawn, by name.

        Returns
        -------
        dict of Tensor
            The numbers by name, shape (n,); only those of plants in the mask are of use.
        """
        numbers: dict[str, Tensor] = {}
        for name, (low, high) in self._ranges.items():
            is_integer = isinstance(low, int)
            if name in given:
                values = given[name].reset(mask)
            else:
                values = self.draw(low, high, is_integer)
            self.numbers[name] = torch.where(mask, values, self.numbers[name])
            numbers[name] = values.to(torch.int64) if is_integer else values
        if (starts == self.clock).all():
            self._starts = self.clock
        else:
            previous_starts = torch.zeros_like(mask, dtype=torch.int64) + self._starts
            self._starts = previous_starts.masked_fill(mask, self.clock)
        if self._has_changes:
            self._due_remainders = set(np.unique(starts % DRIFT_INTERVAL).tolist())
        return numbers

    def age(self, row: int) -> Tensor | int:
        """Return k at a row of the block, shape (n,), or one number for all plants."""
        return self.clock + row - self._starts

    def ages(self, samples: int) -> Tensor:
        """Return k at each sample of the block, shape (samples, n), or (samples, 1)."""
        return self._rows[:samples] + self.age(0)

    def any_due(self, row: int) -> bool:
        """Return whether the age of some plant at a row is a multiple of `DRIFT_INTERVAL`."""
        return (self.clock + row) % DRIFT_INTERVAL in self._due_remainders

    def draw_within_one(self, rows: int) -> Tensor:
        """Draw numbers uniformly from -1 to 1, 1 excluded, shape (rows, n)."""
        numbers = self.zeros.new_empty(rows, len(self.zeros))
        return numbers.uniform_(-1.0, 1.0, generator=self.generator)

    def draw(self, low: float, high: float, whole: bool) -> Tensor:
        """Draw numbers uniformly from a range, both ends included, shape (n,).

        `whole` asks for whole numbers.
        """
        numbers = torch.empty_like(self.zeros)
        numbers.uniform_(low, high + whole, generator=self.generator)
        if whole:
            numbers = numbers.floor()
        return numbers.clamp(max=high)


class Given:
    """A signal, or a plant number, that is read from a tensor instead of drawn.

    The values have the shape (episodes, samples, n). After the last episode, the first follows
    again; after the last sample, its value is held. Of a plant number, there is one sample, and
    `reset` returns it.
    """

    def __init__(self, values: Tensor, episodes: Episodes) -> None:
        self._values = values
        self._episodes = episodes
        # The index of each plant's present episode, shape (n,).
        self._episode = torch.full_like(episodes.zeros, -1, dtype=torch.int64)

    def reset(self, mask: Tensor) -> Tensor:
        """Begin the next episode of some plants."""
        self._episode = self._episode + mask
        return self._at(torch.zeros_like(self._episode)[None])[0]

    def next(self, samples: int) -> Tensor:
        """Return the next samples."""
        return self._at(self._episodes.ages(samples))

    def _at(self, ages: Tensor) -> Tensor:
        """Return the values at these ages of the present episodes, shape (samples, n)."""
        episodes, samples, _ = self._values.shape
        rows = self._episode % episodes * samples + ages.clamp(max=samples - 1)
        return self._values.flatten(0, 1).gather(0, rows)


def read_signals(
    signals: Any, parameters: Parameters, episodes: Episodes
) -> tuple[dict[str, Given], int | None]:
    """Check `options["signals"]` of a reset.

    Returns
    -------
    dict of Given
        The signals and plant numbers by name; empty if `signals` is None.
    int or None
        The last sample of an episode that all signals have; None without signals.

    Raises
    ------
    ValueError
        If a name is unknown, or a value has the wrong shape, is not finite or out of range.
    """
    if signals is None:
        return {}, None
    names = {*SIGNALS, *parameters.ranges}
    if not parameters.is_disturbed:
        names.remove("disturbance")
    allowed = f"a dict with some of {sorted(names)}"
    if not isinstance(signals, Mapping):
        reject("options['signals']", signals, allowed)
    if not signals or not names >= {*signals}:
        reject("options['signals']", [*signals], allowed)
    checked: dict[str, Given] = {}
    last_sample: int | None = None
    for name, value in signals.items():
        path = f"options['signals'][{name!r}]"
        if name in parameters.ranges:
            values = _read_values(path, value, 1, episodes.zeros)
            _check_range(path, value, values, parameters.ranges[name])
            checked[name] = Given(values[:, None], episodes)
        else:
            values = _read_values(path, value, 2, episodes.zeros)
            checked[name] = Given(values, episodes)
            last_of_signal = values.shape[1] - 1
            if last_sample is None or last_of_signal < last_sample:
                last_sample = last_of_signal
    return checked, last_sample


def _read_values(path: str, value: Any, dimensions: int, zeros: Tensor) -> Tensor:
    """Return a value as a tensor, checked, with a leading axis for episodes.

    `dimensions` is 1 for plant numbers, shape (n,), and 2 for signals, shape (samples, n), each
    apart from the axis for episodes, which the value may lack.
    """
    n = len(zeros)
    values = as_tensor(value, zeros)
    if values is None:
        reject(path, value, "numbers")
    if values.ndim == dimensions:
        values = values[None]
    if values.ndim != dimensions + 1 or values.shape[-1] != n or not values.numel():
        shape = f"({n},)" if dimensions == 1 else f"(samples, {n})"
        raise ValueError(
            f"{path} must have the shape {shape}, or one more dimension before, of "
            f"episodes, got {tuple(values.shape)}"
        )
    if not values.isfinite().all():
        raise ValueError(f"{path} must be finite")
    return values


def _check_range(path: str, value: Any, values: Tensor, ends: tuple[float, float]) -> None:
    """Refuse plant numbers outside their range, or fractions where it is one of integers."""
    low, high = values.new_tensor(ends)
    fits = bool(((low <= values) & (values <= high)).all())
    if isinstance(ends[0], int):
        fits = fits and bool((values == values.round()).all())
    if not fits:
        reject(path, value, f"within its range, {list(ends)}")
