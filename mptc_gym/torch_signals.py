"""Generate external signals in PyTorch, drawn from one generator, or pass on given ones.

The signals have two methods of those in `mptc_gym.signals`, for many plants and a block of
samples at a time, without a loop over plants. `reset(which)` begins an episode of some plants,
or of all if `which` is None, and returns the signal at k = 0, shape (n,). `next(samples)`
returns the samples that follow, degC, shape (samples, n). The rest of a block is dropped when
an episode begins.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mptc_gym.checks import reject
from mptc_gym.parameters import ARGUMENTS, PLANT_NUMBERS, Parameters
from mptc_gym.plant import DRIFT_INTERVAL
from mptc_gym.signals import LOAD_INTERVAL, Levels, colour_of, is_silent

LONGEST = 64  # most samples in a block
SIGNALS = ("noise", "setpoint", "disturbance", "measurement_noise")
Number = float | Tensor  # one for all plants, or one per plant, shape (n,)


def replaced(old: Tensor, which: Tensor | None, new: Tensor) -> Tensor:
    """Return new values for some plants, old ones for the others; None selects all plants."""
    return new if which is None else torch.where(which, new, old)


def as_tensor(values: Any, like: Tensor) -> Tensor | None:
    """Return real numbers as a tensor of the type and device of `like`, otherwise None."""
    if "complex" in str(getattr(values, "dtype", "")):  # PyTorch would drop the imaginary part
        return None
    try:
        return torch.as_tensor(values, dtype=like.dtype, device=like.device)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        return None


class Episodes:
    """State of the current episodes, shared by signals and plants, and their generator.

    `zeros`, shape (n,), have the device and type to use.
    """

    def __init__(self, parameters: Parameters, zeros: Tensor) -> None:
        self.zeros, self.generator = zeros, torch.Generator(zeros.device)
        self._ranges = {name: parameters.range_of(name) for name in parameters.ranges}
        self._changes = parameters.drifts or parameters.is_disturbed
        # If one limit is drawn, both are tensors: PyTorch clamps either between two numbers or
        # between two tensors.
        limits = {"u_min", "u_max"}
        tensors = {*self._ranges} | (limits if limits & {*self._ranges} else set())
        self.numbers: dict[str, Number] = {}  # of all plants
        for name in PLANT_NUMBERS:
            low = float(parameters.range_of(name)[0])
            self.numbers[name] = zeros + low if name in tensors else low
        # Samples since the plants were created, up to the first sample of the next block; and
        # the number of samples of the last block that have passed.
        self.clock = self.taken = 0
        # The clock at the start of each plant's episode, and its remainders modulo
        # `DRIFT_INTERVAL`, if anything changes that slowly.
        self.starts = torch.zeros_like(zeros, dtype=torch.int64)
        self.phases: set[int] = set()
        self._rows = torch.arange(LONGEST, device=zeros.device)[:, None]

    def reset(
        self,
        which: Tensor | None,
        starts: NDArray[np.int64],
        clock: int,
        handed: Mapping[str, Handed],
    ) -> dict[str, Tensor]:
        """Begin an episode of some plants, and return the numbers that are drawn or given.

        `starts` is the clock at the start of each plant's episode, these included.
        """
        first = {}
        for name, (low, high) in self._ranges.items():
            whole = ARGUMENTS[name].is_integer
            values = (
                handed[name].reset(which) if name in handed else self.within(low, high, whole)
            )
            self.numbers[name] = replaced(self.zeros + self.numbers[name], which, values)
            first[name] = values.to(torch.int64) if whole else values
        begun = self.zeros.new_full((), clock, dtype=torch.int64)
        self.starts = replaced(self.starts, which, begun.expand(len(starts)))
        self._first = int(starts[0]) if (starts == starts[0]).all() else None
        self.phases = {*np.unique(starts % DRIFT_INTERVAL).tolist()} if self._changes else set()
        return first

    def ages(self, samples: int) -> Tensor:
        """Return k at each sample of the next block, shape (samples, n), or (samples, 1)."""
        starts = self.starts[:1] if self._first is not None else self.starts
        return self._rows[:samples] + (self.clock - starts)

    def age(self, clock: int) -> int | Tensor:
        """Return k at a time of the clock, shape (n,), or one number for all plants."""
        if self._first is not None:
            return clock - self._first
        return (clock - self.starts).to(self.zeros.dtype)

    def within_one(self, rows: int) -> Tensor:
        """Draw numbers from -1 to 1, 1 excluded, shape (rows, n)."""
        drawn = self.zeros.new_empty(rows, len(self.zeros))
        return drawn.uniform_(-1.0, 1.0, generator=self.generator)

    def within(self, low: float, high: float, whole: bool) -> Tensor:
        """Draw numbers from a range, or whole numbers, both ends included; shape (n,)."""
        drawn = torch.empty_like(self.zeros)
        drawn.uniform_(low, high + whole, generator=self.generator)
        return (drawn.floor() if whole else drawn).clamp(max=high)


class Noise:
    """Coloured noise, by name: see `mptc_gym.signals.Noise`."""

    def __init__(self, name: str, parameters: Parameters, episodes: Episodes) -> None:
        self._variance, self._c = f"{name}_variance", tuple(colour_of(name, parameters))
        self._episodes = episodes

    def reset(self, which: Tensor | None) -> Tensor:
        """Begin an episode of some plants."""
        zeros = self._episodes.zeros
        self._deviation = self._episodes.numbers[self._variance] ** 0.5
        if which is None:
            self._xi = zeros.expand(len(self._c) - 1, -1)
        else:
            self._xi = self._past().masked_fill(which, 0.0)
        return zeros

    def next(self, samples: int) -> Tensor:
        """Draw the next samples."""
        order, past = len(self._c) - 1, self._past()
        self._xi = past.new_empty(order + samples, past.shape[1])
        self._xi[:order] = past
        drawn, generator = self._xi[order:], self._episodes.generator
        if isinstance(self._deviation, float):
            noise = drawn.normal_(0.0, self._deviation, generator=generator)
        else:
            noise = drawn.normal_(generator=generator).mul_(self._deviation)
        for lag, coefficient in enumerate(self._c[1:], start=1):
            noise = noise.add(self._xi[order - lag : order - lag + samples], alpha=coefficient)
        return noise

    def _past(self) -> Tensor:
        return self._xi[self._episodes.taken :][: len(self._c) - 1]


class RandomSetPoint:
    """A set point of random levels, each held for a random number of samples."""

    def __init__(self, levels: Levels, episodes: Episodes) -> None:
        self._law, self._episodes = levels, episodes
        zeros = episodes.zeros
        self._rows = torch.arange(LONGEST, dtype=zeros.dtype).to(zeros.device)
        # The current level and those to come, each with the sample where it ends: whole numbers
        # in floats, which are fastest.
        self._levels = [(zeros, zeros)]
        # Number of known samples, and of those that have passed, from the same origin.
        self._horizon = self._passed = 0

    def reset(self, which: Tensor | None) -> Tensor:
        """Begin an episode of some plants."""
        self._catch_up()
        (end, level), (hold, first) = self._levels[0], self._drawn()
        self._levels = [(replaced(end, which, hold), replaced(level, which, first))]
        return self._levels[0][1]

    def next(self, samples: int) -> Tensor:
        """Return the next samples, drawn if they are not yet known."""
        shortest, taken = self._law.shortest, self._episodes.taken
        if self._passed + taken + samples > self._horizon:
            self._catch_up()
            self._horizon = max(samples, shortest)
            for _ in range(1 + (self._horizon - 1) // shortest):
                hold, level = self._drawn()
                self._levels.append((self._levels[-1][0] + hold, level))
        else:
            self._passed += taken
        rows = (self._rows[:samples] + (self._passed + 1))[:, None]
        levels = self._levels[0][1].expand(samples, -1)
        for (change, _), (_, level) in pairwise(self._levels):
            levels = torch.lerp(levels, level, _reached(rows, change))
        return levels

    def _drawn(self) -> tuple[Tensor, Tensor]:
        """Draw the lengths of levels, in samples, and the levels, each of shape (n,)."""
        level = self._episodes.within_one(1)[0] * self._law.amplitude
        hold = self._episodes.within(self._law.shortest, self._law.longest, whole=True)
        return hold, level

    def _catch_up(self) -> None:
        """Move the origin to the sample last taken, and keep only the level there."""
        end, level = self._levels[0]
        passed = level.new_full((), self._passed + self._episodes.taken)
        for (change, _), (later, following) in pairwise(self._levels):
            reached = _reached(passed, change)
            end, level = torch.lerp(end, later, reached), torch.lerp(level, following, reached)
        self._levels = [(end - passed, level)]
        self._horizon = self._passed = 0


class RepeatedSetPoint:
    """A set point that repeats its levels."""

    def __init__(self, levels: Levels, episodes: Episodes) -> None:
        self._episodes = episodes
        self._values = episodes.zeros.new_tensor(levels.values)
        self._ends = torch.tensor(levels.lengths, device=self._values.device).cumsum(0)
        self._period = sum(levels.lengths)

    def reset(self, which: Tensor | None) -> Tensor:
        """Begin an episode of some plants."""
        return self._values[0].expand(len(self._episodes.zeros))

    def next(self, samples: int) -> Tensor:
        """Return the next samples."""
        ages, n = self._episodes.ages(samples), len(self._episodes.zeros)
        if len(self._values) == 1:
            return self._values.expand(samples, n)
        places = torch.bucketize(ages % self._period, self._ends, right=True)
        return self._values[places].expand(samples, n)


class Disturbance:
    """The load disturbance, steps and a walk: see `mptc_gym.signals.Disturbance`."""

    def __init__(self, episodes: Episodes) -> None:
        self._episodes = episodes

    def reset(self, which: Tensor | None) -> Tensor:
        """Begin an episode of some plants."""
        zeros = self._episodes.zeros
        # Steps and walk at the sample before the last block, and at those of the block.
        if which is None:
            self._parts = [(zeros, zeros)]
        else:
            step, walk = self._parts[self._episodes.taken]
            self._parts = [(step.masked_fill(which, 0.0), walk.masked_fill(which, 0.0))]
        return zeros

    def next(self, samples: int) -> Tensor:
        """Draw the next samples."""
        clock, phases = self._episodes.clock, self._episodes.phases
        self._parts = [self._parts[self._episodes.taken]]
        total = torch.add(*self._parts[0])
        rows = []
        for now in range(clock, clock + samples):
            if now % LOAD_INTERVAL in phases:
                self._parts.append(self._changed(now))
                total = torch.add(*self._parts[-1])
            else:
                self._parts.append(self._parts[-1])
            rows.append(total)
        return torch.stack(rows)

    def _changed(self, clock: int) -> tuple[Tensor, Tensor]:
        """Return steps and walk after the plants that are due have changed."""
        numbers, (step, walk) = self._episodes.numbers, self._parts[-1]
        drawn = self._episodes.within_one(2)
        interval = numbers["disturbance_interval"]
        if isinstance(interval, Tensor):
            interval = interval.clamp(min=LOAD_INTERVAL)
        else:
            interval = max(interval, LOAD_INTERVAL)
        # A step occurs if this is within +-1, and is then uniform there.
        place = drawn[0] * (interval / LOAD_INTERVAL)
        jumps = _reached(place.new_ones(()), place.abs())
        level = place * numbers["disturbance_amplitude"]
        # Uniform within +-h, a step of the walk has the variance h^2 / 3.
        width = (3.0 * LOAD_INTERVAL * numbers["disturbance_walk_variance"]) ** 0.5
        moved = walk + drawn[1] * width
        if len(self._episodes.phases) > 1:
            turn = ((clock - self._episodes.starts) % LOAD_INTERVAL == 0).to(place.dtype)
            moved, jumps = torch.lerp(walk, moved, turn), jumps.mul_(turn)
        return torch.lerp(step, level, jumps), moved


def _reached(now: Tensor, change: Tensor) -> Tensor:
    """Return 1 where a change has been reached, and 0 elsewhere."""
    # Of the same type, as factors of type bool are many times slower.
    past = now - change
    return past.ge_(past.new_zeros(()))


class Handed:
    """A signal that is given instead of drawn; or a plant number, by `reset` alone.

    The values have the shape (episodes, samples, n). After the last episode, the first follows
    again; after the last sample, its value is held.
    """

    def __init__(self, values: Tensor, episodes: Episodes) -> None:
        self._values, self._episodes = values, episodes
        self._episode = torch.zeros_like(episodes.starts) - 1  # of each plant, from 0 on

    def reset(self, which: Tensor | None) -> Tensor:
        """Begin the next episode of some plants."""
        self._episode = self._episode + (1 if which is None else which)
        return self._at(torch.zeros_like(self._episode)[None])[0]

    def next(self, samples: int) -> Tensor:
        """Return the next samples."""
        return self._at(self._episodes.ages(samples))

    def _at(self, ages: Tensor) -> Tensor:
        count, length, _ = self._values.shape
        rows = self._episode % count * length + ages.clamp(max=length - 1)
        return self._values.flatten(0, 1).gather(0, rows)


Signal = Noise | RandomSetPoint | RepeatedSetPoint | Disturbance | Handed


def drawn_signals(parameters: Parameters, episodes: Episodes) -> dict[str, Signal]:
    """Return the signals of an environment by name, except noise that is always 0."""
    levels = Levels(parameters)
    setpoint = RandomSetPoint if levels.random else RepeatedSetPoint
    signals: dict[str, Signal] = {"setpoint": setpoint(levels, episodes)}
    if parameters.is_disturbed:
        signals["disturbance"] = Disturbance(episodes)
    for name in ("noise", "measurement_noise"):
        if not is_silent(name, parameters):
            signals[name] = Noise(name, parameters, episodes)
    return signals


def handed_signals(
    signals: Any, parameters: Parameters, episodes: Episodes
) -> tuple[dict[str, Handed], int | None]:
    """Check given signals and plant numbers, if any.

    Return them, and the last sample that all signals have, or None without signals.
    """
    if signals is None:
        return {}, None
    n, ranges = len(episodes.zeros), parameters.ranges
    names = {*SIGNALS, *ranges}
    if not parameters.is_disturbed:
        names.remove("disturbance")
    if not isinstance(signals, Mapping) or not signals or not names >= {*signals}:
        given = [*signals] if isinstance(signals, Mapping) else signals
        reject("options['signals']", given, f"a dict with some of {sorted(names)}")
    handed, lengths = {}, []
    for name, given in signals.items():
        path = f"options['signals'][{name!r}]"
        values = as_tensor(given, episodes.zeros)
        if values is None:
            reject(path, given, "numbers")
        shape, dimensions = (f"({n},)", 1) if name in ranges else (f"(samples, {n})", 2)
        if values.ndim == dimensions:
            values = values[None]
        if values.ndim != dimensions + 1 or values.shape[-1] != n or not values.numel():
            raise ValueError(
                f"{path} must have the shape {shape}, or one more dimension before, of "
                f"episodes, got {tuple(values.shape)}"
            )
        if not values.isfinite().all():
            raise ValueError(f"{path} must be finite")
        if name in ranges:
            ends = parameters.range_of(name)
            low, high = values.new_tensor(ends)
            whole = not ARGUMENTS[name].is_integer or bool((values == values.round()).all())
            if not (whole and bool(((low <= values) & (values <= high)).all())):
                reject(path, given, f"within its range, {list(ends)}")
            values = values[:, None]
        else:
            lengths.append(values.shape[1])
        handed[name] = Handed(values, episodes)
    return handed, min(lengths) - 1 if lengths else None
