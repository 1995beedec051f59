"""What comes from outside in PyTorch: drawn from one generator, or handed in.

All of it is made for a block of samples at a time, without a loop over plants.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

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

    def normal(self, out: Tensor, deviation: Number) -> Tensor:
        """Fill a tensor, shape (samples, n), with normal numbers around 0, and return it."""
        if isinstance(deviation, float):
            return out.normal_(0.0, deviation, generator=self.generator)
        return out.normal_(generator=self.generator).mul_(deviation)

    def within_one(self, rows: int) -> Tensor:
        """Draw numbers from -1 to 1, the latter excluded, shape (rows, n)."""
        drawn = self.nothing.new_empty(rows, len(self.nothing))
        return drawn.uniform_(-1.0, 1.0, generator=self.generator)

    def within(self, low: float, high: float, *, whole: bool) -> Tensor:
        """Draw numbers between two, or whole numbers, both ends included; shape (n,)."""
        drawn = torch.empty_like(self.nothing)
        drawn.uniform_(low, high + whole, generator=self.generator)
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

    def rest(self, which: Tensor | None, taken: int, variance: Number) -> None:
        """Begin an episode of some plants, or of all, after so many of the last samples.

        The variance, degC^2, is that of all plants from now on.
        """
        order = len(self._c) - 1
        self._deviation = variance**0.5
        if which is None:
            self._xi = self._draws.nothing.expand(order, -1)
        else:
            self._xi = self._xi[taken : taken + order].masked_fill(which, 0.0)

    def take(self, samples: int, taken: int) -> Tensor:
        """Make the next samples, after so many of the last ones; degC, shape (samples, n)."""
        order = len(self._c) - 1
        past = self._xi[taken : taken + order]
        self._xi = past.new_empty(order + samples, past.shape[1])
        self._xi[:order] = past
        noise = self._draws.normal(self._xi[order:], self._deviation)
        for lag, coefficient in enumerate(self._c[1:], start=1):
            noise = noise.add(self._xi[order - lag : order - lag + samples], alpha=coefficient)
        return noise


class Held:
    """A set point that holds each random level for a random number of samples.

    Parameters
    ----------
    levels
        How large they are, and how long they hold.
    draws
        Where they come from.
    """

    def __init__(self, levels: Levels, draws: Draws) -> None:
        self._levels, self._draws = levels, draws
        self._rows = torch.arange(LONGEST, dtype=draws.nothing.dtype).to(draws.nothing.device)
        # The present level, and in how many samples it changes: whole numbers of type float,
        # with which a processor is quickest. Then each change to come, in how many samples it
        # is, and what the level and the next change are from there.
        self._level = self._left = draws.nothing
        self._ahead: list[tuple[Tensor, Tensor, Tensor]] = []
        self._horizon = self._passed = 0  # samples that it is known for, and that are over

    def rest(self, which: Tensor | None, taken: int) -> Tensor:
        """Begin an episode of some plants, or of all, after so many of the last samples.

        Returns
        -------
        Tensor
            The levels that all plants have then, shape (n,).
        """
        self._catch_up(taken)
        level, hold = self._following()
        if which is not None:
            level = torch.where(which, level, self._level)
            hold = torch.where(which, hold, self._left)
        self._level, self._left = level, hold
        return level

    def take(self, samples: int, taken: int) -> Tensor:
        """Make the next samples, after so many of the last ones; shape (samples, n)."""
        shortest = self._levels.shortest
        if self._passed + taken + samples > self._horizon:
            self._catch_up(taken)
            self._horizon, left = max(samples, shortest), self._left
            for _ in range(1 + (self._horizon - 1) // shortest):
                level, hold = self._following()
                self._ahead.append((left, level, left + hold))
                left = left + hold
        else:
            self._passed += taken
        # Known are the samples that the next change is away from that before the first one.
        rows = (self._rows[:samples] + (self._passed + 1))[:, None]
        levels = self._level.expand(samples, -1)
        for change, level, _ in self._ahead:
            levels = torch.lerp(levels, level, _reached(rows, change))
        return levels

    def _following(self) -> tuple[Tensor, Tensor]:
        """Draw levels, and for how many samples they hold, each of shape (n,)."""
        levels = self._levels
        level = self._draws.within_one(1)[0] * levels.amplitude
        return level, self._draws.within(levels.shortest, levels.longest, whole=True)

    def _catch_up(self, taken: int) -> None:
        """Bring level and next change to where so many more samples have been taken."""
        passed = self._level.new_full((), self._passed + taken)
        for change, level, next_change in self._ahead:
            reached = _reached(passed, change)
            self._level = torch.lerp(self._level, level, reached)
            self._left = torch.lerp(self._left, next_change, reached)
        self._left = self._left - passed
        self._ahead, self._horizon, self._passed = [], 0, 0


class Load:
    """Load disturbances, as of `Disturbance` in `mptc_gym.signals`: steps and a walk.

    Parameters
    ----------
    numbers
        The plant numbers by name, those of the moment when a load changes.
    draws
        Where all is drawn from.
    """

    def __init__(self, numbers: Mapping[str, Number], draws: Draws) -> None:
        self._numbers, self._draws = numbers, draws

    def rest(
        self, which: Tensor | None, taken: int, starts: Tensor, phases: Collection[int]
    ) -> None:
        """Begin an episode of some plants, or of all, after so many of the last samples.

        `starts`, shape (n,), are the clock at the beginning of each plant's episode, and
        `phases` their remainders when divided by `LOAD_INTERVAL`.
        """
        self._starts, self._phases = starts, phases
        nothing = self._draws.nothing
        # Steps and walk of the sample before the last block, and of those in it.
        if which is None:
            self._parts = [(nothing, nothing)]
        else:
            # None have been made where loads are handed in.
            step, walk = self._parts[min(taken, len(self._parts) - 1)]
            self._parts = [(step.masked_fill(which, 0.0), walk.masked_fill(which, 0.0))]

    def take(self, samples: int, taken: int, clock: int) -> Tensor:
        """Make the samples from one of the clock on, after so many of the last ones.

        Returns
        -------
        Tensor
            w, degC, shape (samples, n).
        """
        self._parts = [self._parts[taken]]
        total = torch.add(*self._parts[0])
        rows = []
        for now in range(clock, clock + samples):
            if now % LOAD_INTERVAL in self._phases:
                self._parts.append(self._changed(now))
                total = torch.add(*self._parts[-1])
            else:
                self._parts.append(self._parts[-1])
            rows.append(total)
        return torch.stack(rows)

    def _changed(self, clock: int) -> tuple[Tensor, Tensor]:
        """Return steps and walk once those have changed whose turn it is."""
        numbers, (step, walk) = self._numbers, self._parts[-1]
        drawn = self._draws.within_one(2)
        interval = at_least(numbers["disturbance_interval"], LOAD_INTERVAL)
        # It jumps if this is within +-1, and is then uniform there.
        place = drawn[0] * (interval / LOAD_INTERVAL)
        jumps = _reached(place.new_ones(()), place.abs())
        level = place * numbers["disturbance_amplitude"]
        # Uniform within +-h, a step of the walk has the variance h^2 / 3.
        width = (3.0 * LOAD_INTERVAL * numbers["disturbance_walk_variance"]) ** 0.5
        moved = walk + drawn[1] * width
        if len(self._phases) > 1:
            turn = ((clock - self._starts) % LOAD_INTERVAL == 0).to(place.dtype)
            moved, jumps = torch.lerp(walk, moved, turn), jumps.mul_(turn)
        return torch.lerp(step, level, jumps), moved


def _reached(now: Tensor, change: Tensor) -> Tensor:
    """Return 1 where a change has been reached, and 0 elsewhere."""
    # Of the type of these: to use numbers of type bool as factors takes many times as long.
    past = now - change
    return past.ge_(past.new_zeros(()))


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
