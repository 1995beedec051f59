"""What comes from outside in PyTorch: drawn from one generator, or handed in.

All of it is made for a block of samples at a time, without a loop over plants.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from mptc_gym.signals import FOREVER, LOAD_INTERVAL, Levels

LONGEST = 64  # samples of a block
Number = float | Tensor  # the same for all plants, or one for each, shape (n,)


def at_least(number: Number, least: float) -> Number:
    """Return a number, or the limit where it is below."""
    return number.clamp(min=least) if isinstance(number, Tensor) else max(number, least)


class Draws:
    """Random numbers of one generator, of a type and on a device.

    Parameters
    ----------
    generator
        Where they come from; on the device.
    nothing
        Zeros of that type and device, shape (n,).
    """

    def __init__(self, generator: torch.Generator, nothing: Tensor) -> None:
        self.generator, self.nothing = generator, nothing
        self._place: Any = {"dtype": nothing.dtype, "device": nothing.device}

    def normal(self, out: Tensor, deviation: Number) -> Tensor:
        """Fill a tensor, shape (samples, n), with normal numbers around 0, and return it."""
        if isinstance(deviation, float):
            return out.normal_(0.0, deviation, generator=self.generator)
        return out.normal_(generator=self.generator).mul_(deviation)

    def uniform(self, rows: int) -> Tensor:
        """Draw numbers from 0 to 1, the latter excluded, shape (rows, n)."""
        return torch.rand(rows, len(self.nothing), generator=self.generator, **self._place)

    def within(self, low: float, high: float, *, whole: bool) -> Tensor:
        """Draw numbers between two, or whole numbers, both ends included; shape (n,)."""
        drawn = low + self.uniform(1)[0] * (high - low + whole)
        return (drawn.floor() if whole else drawn).clamp(max=high)


class Noise:
    """Coloured noise, from k = 1 on: C(z^-1) xi(k) of (28), where xi is 0 before.

    Parameters
    ----------
    c
        Coefficients of C, from z^0 on.
    draws
        Where xi comes from.
    """

    def __init__(self, c: Sequence[float], draws: Draws) -> None:
        self._c, self._draws = tuple(c), draws
        self.rest(None, 0)

    def rest(self, which: Tensor | None, taken: int) -> None:
        """Begin an episode of some plants, or of all, after so many of the last samples."""
        order = len(self._c) - 1
        if which is None:
            self._xi = self._draws.nothing.expand(order, -1)
        else:
            self._xi = self._xi[taken : taken + order].masked_fill(which, 0.0)

    def take(self, samples: int, taken: int, variance: Number) -> Tensor:
        """Make the next samples, after so many of the last ones; degC, shape (samples, n)."""
        order = len(self._c) - 1
        past = self._xi[taken : taken + order]
        self._xi = past.new_empty(order + samples, past.shape[1])
        self._xi[:order] = past
        xi = self._draws.normal(self._xi[order:], variance**0.5)
        noise = xi if order else xi.clone()
        for lag, coefficient in enumerate(self._c[1:], start=1):
            noise = noise.add(self._xi[order - lag : order - lag + samples], alpha=coefficient)
        return noise


class Held:
    """A signal that holds each level for a random or fixed number of samples.

    Parameters
    ----------
    shortest
        The fewest samples for which a level is held.
    following
        Returns what comes after a state, shape (parts, n), and for how many samples it holds.
        The signal is the sum of the parts.
    nothing
        Zeros of the type and device, shape (n,).
    """

    def __init__(
        self,
        shortest: int,
        following: Callable[[Tensor], tuple[Tensor, Tensor | int]],
        nothing: Tensor,
    ) -> None:
        self._shortest, self._following = shortest, following
        self._nothing = nothing
        self._rows = torch.arange(LONGEST, dtype=nothing.dtype, device=nothing.device)[:, None]
        # What comes next: in how many samples the state changes, and the state and the next
        # change then.
        # Counts are whole numbers of type float, with which a processor is quickest; or one
        # int if it is the same for all plants.
        self._ahead: list[tuple[Any, Tensor, Any]] = []
        self._state = nothing[None]
        self._left: Any = 0
        self._horizon = self._passed = 0  # samples that it is known for, and that are over

    def rest(self, which: Tensor | None, taken: int, state: Tensor, hold: Tensor | int) -> None:
        """Begin some plants, or all, with a state that holds for a number of samples.

        Before, so many of the last samples have been taken.
        """
        if which is not None:
            self._catch_up(taken)
            state = torch.where(which, state, self._state)
            hold = torch.where(which, hold, self._left + self._nothing)
        self._state, self._left, self._ahead = state, hold, []
        self._horizon = self._passed = 0

    def take(self, samples: int, taken: int) -> Tensor:
        """Make the next samples, after so many of the last ones; shape (samples, n)."""
        if self._passed + taken + samples > self._horizon:
            self._catch_up(taken)
            self._foresee(max(samples, self._shortest))
        else:
            self._passed += taken
        level, first = self._state.sum(0), self._passed
        if all(isinstance(change, int) for change, _, _ in self._ahead):
            levels = [level] * samples
            for change, state, _ in self._ahead:
                after = max(change - 1 - first, 0)
                levels[after:] = [state.sum(0)] * len(levels[after:])
            return torch.stack(levels)
        # Known are the samples that the next change is away from that before the first one.
        rows = self._rows[:samples] + (first + 2)
        for change, state, _ in self._ahead:
            level = torch.lerp(level, state.sum(0), (rows - change).clamp_(0.0, 1.0))
        return level

    def _foresee(self, samples: int) -> None:
        """Make the changes of the next samples."""
        state, left = self._state, self._left
        for _ in range(1 + (samples - 1) // self._shortest):
            state, hold = self._following(state)
            self._ahead.append((left, state, left + hold))
            left = left + hold
        self._horizon = samples

    def _catch_up(self, taken: int) -> None:
        """Bring state and next change to where so many more samples have been taken."""
        passed = self._passed + taken
        for change, state, next_change in self._ahead:
            if isinstance(change, int):
                if change <= passed:
                    self._state, self._left = state, next_change
            else:
                over = (passed + 1 - change).clamp_(0.0, 1.0)
                self._state = torch.lerp(self._state, state, over)
                self._left = torch.lerp(self._left, next_change, over)
        if self._ahead:
            self._left = self._left - passed
        self._ahead, self._horizon, self._passed = [], 0, 0


def random_levels(levels: Levels, draws: Draws) -> Callable[[Tensor], tuple[Tensor, Tensor]]:
    """Return how random set points follow on one another."""
    choices = levels.longest - levels.shortest + 1

    def following(_: Tensor) -> tuple[Tensor, Tensor]:
        drawn = draws.uniform(2)
        length = (drawn[1] * choices).floor_().clamp_(max=choices - 1)
        return (2.0 * drawn[:1] - 1.0) * levels.amplitude, length + levels.shortest

    return following


def disturbances(
    numbers: Mapping[str, Number], draws: Draws
) -> Callable[[Tensor], tuple[Tensor, int]]:
    """Return how load disturbances go on: see `Disturbance` in `mptc_gym.signals`.

    Parameters
    ----------
    numbers
        The plant numbers by name, those of the moment when it goes on.
    draws
        Where all is drawn from.
    """

    def following(state: Tensor) -> tuple[Tensor, int]:
        drawn = draws.uniform(2)
        interval = at_least(numbers["disturbance_interval"], LOAD_INTERVAL)
        # It jumps if this is below 1, and is then uniform from 0 to there.
        place = drawn[0] * interval / LOAD_INTERVAL
        jumps = (1.0 - place).sign_().clamp_(min=0.0)
        level = (2.0 * place - 1.0) * numbers["disturbance_amplitude"]
        # Uniform within +-h, a step of the walk has the variance h^2 / 3.
        width = (3.0 * LOAD_INTERVAL * numbers["disturbance_walk_variance"]) ** 0.5
        walk = state[1] + (2.0 * drawn[1] - 1.0) * width
        return torch.stack((torch.lerp(state[0], level, jumps), walk)), LOAD_INTERVAL

    return following


class Repeated:
    """A set point that is not random, as a function of k.

    Parameters
    ----------
    levels
        What is repeated.
    nothing
        Zeros of the type and device, shape (n,).
    """

    def __init__(self, levels: Levels, nothing: Tensor) -> None:
        lengths = torch.tensor(levels.lengths, device=nothing.device)
        self.values = nothing.new_tensor(levels.values)
        self._ends = lengths.cumsum(0)
        self._period = sum(levels.lengths)

    def at(self, ages: Tensor) -> Tensor:
        """Return the levels at some k."""
        if len(self.values) == 1:
            return self.values.expand(ages.shape)
        return self.values[torch.bucketize(ages % self._period, self._ends, right=True)]


class Given:
    """Signals and plant numbers that are handed in instead of being drawn.

    Parameters
    ----------
    tensors
        Signals, shape (episodes, samples, n), and numbers, shape (episodes, n), by name. After
        the last episode comes the first one again.
    nothing
        Zeros of the type and device, shape (n,).

    Attributes
    ----------
    last : int
        The last sample that all signals have.
    """

    def __init__(self, tensors: Mapping[str, Tensor], nothing: Tensor) -> None:
        self._tensors = tensors
        self._episodes = nothing.to(torch.int64) - 1  # of each plant, from 0 on
        lengths = (each.shape[1] for each in tensors.values() if each.ndim == 3)
        self.last = min(lengths, default=FOREVER) - 1

    def __contains__(self, name: str) -> bool:
        return name in self._tensors

    def rest(self, which: Tensor | None) -> None:
        """Begin the next episode of some plants, or of all."""
        self._episodes = self._episodes + (1 if which is None else which)

    def number(self, name: str) -> Tensor:
        """Return a plant number of the present episodes, shape (n,)."""
        numbers = self._tensors[name]
        return numbers.gather(0, (self._episodes % len(numbers))[None])[0]

    def at(self, name: str, ages: Tensor) -> Tensor:
        """Return a signal of the present episodes at some k, shape (samples, n) as theirs is.

        Beyond the end the last value is held.
        """
        signals = self._tensors[name]
        length = signals.shape[1]
        rows = self._episodes % len(signals) * length + ages.clamp(max=length - 1)
        return signals.flatten(0, 1).gather(0, rows)
