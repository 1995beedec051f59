"""Generate external signals in PyTorch, drawn from one generator, or pass on given ones.

The signals have two methods, for many plants and a block of samples at a time, without a loop
over plants. `reset(mask)` begins an episode of some plants and returns the signal at k = 0,
shape (n,). `next(samples)` returns a block of the samples that follow, degC, shape
(samples, n). All share the clock of `Episodes`.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mptc_gym.checks import reject
from mptc_gym.parameters import PLANT_NUMBERS, Parameters
from mptc_gym.plant import DRIFT_INTERVAL
from mptc_gym.signals import LOAD_INTERVAL, Levels, colours

LONGEST = 64  # most samples in a block
SIGNALS = ("noise", "setpoint", "disturbance", "measurement_noise")
Number = float | Tensor  # one for all plants, or one per plant, shape (n,)


def as_tensor(values: Any, like: Tensor) -> Tensor | None:
    """Return real numbers as a tensor of the type and device of `like`, otherwise None."""
    try:
        return torch.as_tensor(values, dtype=like.dtype, device=like.device)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        return None


class Episodes:
    """The current episodes: clock, starts and plant numbers, shared by signals and plants.

    `zeros`, shape (n,), have the device and type to use; `generator` makes all draws. Before
    a block of samples, `clock` is set to the time of the first, and before a reset to the time
    at which episodes begin; `unused` samples of the latest block, ahead of it, are dropped.
    """

    def __init__(self, parameters: Parameters, zeros: Tensor) -> None:
        self.zeros, self.generator = zeros, torch.Generator(zeros.device)
        self.generator.seed()  # of the system's own, until `reset` is given one
        self.clock = self.unused = 0
        self._ranges = parameters.ranges
        # If one limit is drawn, both are tensors: PyTorch clamps either between two numbers or
        # between two tensors.
        limits = {"u_min", "u_max"}
        tensors = {*self._ranges} | (limits if limits & {*self._ranges} else set())
        self.numbers: dict[str, Number] = {}  # of all plants
        for name in PLANT_NUMBERS:
            low = float(parameters.range_of(name)[0])
            self.numbers[name] = zeros + low if name in tensors else low
        # The clock at the start of each plant's episode, or of all. The host knows at which
        # remainders of the clock one of them is a multiple of `DRIFT_INTERVAL` samples old.
        self._changes = parameters.drifts or parameters.is_disturbed
        self._starts: Tensor | int = 0
        self._due: set[int] = set()
        self._rows = torch.arange(LONGEST, device=zeros.device)[:, None]

    def reset(
        self, mask: Tensor, starts: NDArray[np.int64], given: Mapping[str, "Given"]
    ) -> dict[str, Tensor]:
        """Begin an episode of some plants, and return the numbers that are drawn or given.

        `starts` is the clock at the start of each plant's episode, these included.
        """
        first = {}
        for name, (low, high) in self._ranges.items():
            whole = isinstance(low, int)
            values = given[name].reset(mask) if name in given else self.draw(low, high, whole)
            self.numbers[name] = torch.where(mask, values, self.numbers[name])
            first[name] = values.to(torch.int64) if whole else values
        if (starts == self.clock).all():
            self._starts = self.clock
        else:
            before = torch.zeros_like(mask, dtype=torch.int64) + self._starts
            self._starts = before.masked_fill(mask, self.clock)
        if self._changes:
            self._due = {*np.unique(starts % DRIFT_INTERVAL).tolist()}
        return first

    def age(self, row: int) -> Tensor | int:
        """Return k at a row of the block, shape (n,), or one number for all plants."""
        return self.clock + row - self._starts

    def ages(self, samples: int) -> Tensor:
        """Return k at each sample of the block, shape (samples, n), or (samples, 1)."""
        return self._rows[:samples] + self.age(0)

    def any_due(self, row: int) -> bool:
        """Whether a plant's age is a multiple of `DRIFT_INTERVAL` at a row of the block."""
        return (self.clock + row) % DRIFT_INTERVAL in self._due

    def draw_within_one(self, rows: int) -> Tensor:
        """Draw numbers from -1 to 1, 1 excluded, shape (rows, n)."""
        drawn = self.zeros.new_empty(rows, len(self.zeros))
        return drawn.uniform_(-1.0, 1.0, generator=self.generator)

    def draw(self, low: float, high: float, whole: bool) -> Tensor:
        """Draw numbers from a range, or whole numbers, both ends included; shape (n,)."""
        drawn = torch.empty_like(self.zeros)
        drawn.uniform_(low, high + whole, generator=self.generator)
        return (drawn.floor() if whole else drawn).clamp(max=high)


class Noise:
    """Coloured noise, by name: see `mptc_gym.signals.Noise`."""

    def __init__(self, name: str, c: Sequence[float], episodes: Episodes) -> None:
        self._variance, self._c, self._order = f"{name}_variance", c, len(c) - 1
        self._episodes = episodes
        self._xi = episodes.zeros.expand(self._order, -1)  # those of the latest block last

    def reset(self, mask: Tensor) -> Tensor:
        """Begin an episode of some plants."""
        self._deviation = self._episodes.numbers[self._variance] ** 0.5
        used = len(self._xi) - self._episodes.unused
        self._xi = self._xi[:used].masked_fill(mask, 0.0)
        return self._episodes.zeros

    def next(self, samples: int) -> Tensor:
        """Draw the next samples."""
        order, generator = self._order, self._episodes.generator
        past = self._xi[len(self._xi) - order :]
        self._xi = past.new_empty(order + samples, past.shape[1])
        self._xi[:order] = past
        noise, deviation = self._xi[order:], self._deviation
        if isinstance(deviation, float):
            noise.normal_(0.0, deviation, generator=generator)
        else:
            noise.normal_(generator=generator).mul_(deviation)
        for lag, coefficient in enumerate(self._c[1:], start=1):
            noise = noise.add(self._xi[order - lag : order - lag + samples], alpha=coefficient)
        return noise


class RandomSetPoint:
    """A set point of random levels, each held for a random number of samples.

    One further level is drawn at a time: blocks are no longer than the shortest level.
    """

    def __init__(self, levels: Levels, episodes: Episodes) -> None:
        self._distribution, self._episodes = levels, episodes
        zeros = episodes.zeros
        # Ends of levels are counted from the clock at the latest draw, as floats are fastest.
        self._rows = torch.arange(LONGEST, dtype=zeros.dtype).to(zeros.device)[:, None]
        self._drawn_at = 0
        # The level of then and where it ends, and the same of the level that follows.
        self._level = self._end = self._next_level = self._next_end = zeros

    def reset(self, mask: Tensor) -> Tensor:
        """Begin an episode of some plants."""
        self._count_from(self._episodes.clock)
        level, hold = self._draw()
        self._level = torch.where(mask, level, self._level)
        self._end = torch.where(mask, hold, self._end)
        self._known_until = self._drawn_at
        return self._level

    def next(self, samples: int) -> Tensor:
        """Return the next samples."""
        clock = self._episodes.clock
        if clock + samples - 1 > self._known_until:
            self._count_from(clock - 1)
            self._known_until = self._drawn_at + self._distribution.shortest
            self._next_level, hold = self._draw()
            self._next_end = self._end + hold
        reached = _is_past(self._rows[:samples] + (clock - self._drawn_at), self._end)
        return torch.lerp(self._level.expand(samples, -1), self._next_level, reached)

    def _draw(self) -> tuple[Tensor, Tensor]:
        """Draw levels, degC, and for how many samples they hold, each of shape (n,)."""
        law = self._distribution
        level = self._episodes.draw_within_one(1)[0] * law.amplitude
        return level, self._episodes.draw(law.shortest, law.longest, whole=True)

    def _count_from(self, clock: int) -> None:
        """Count from a time of the clock, and forget what was before."""
        passed = clock - self._drawn_at
        reached = _is_past(self._end.new_full((), passed), self._end)
        self._level = torch.lerp(self._level, self._next_level, reached)
        self._end = torch.lerp(self._end, self._next_end, reached) - passed
        self._drawn_at = clock


class RepeatedSetPoint:
    """A set point that repeats its levels."""

    def __init__(self, levels: Levels, episodes: Episodes) -> None:
        self._episodes = episodes
        self._values = episodes.zeros.new_tensor(levels.values)
        self._ends = torch.tensor(levels.lengths, device=self._values.device).cumsum(0)
        self._period = sum(levels.lengths)

    def reset(self, mask: Tensor) -> Tensor:
        """Begin an episode of some plants."""
        return self._values[0].expand(len(self._episodes.zeros))

    def next(self, samples: int) -> Tensor:
        """Return the next samples."""
        ages = self._episodes.ages(samples)
        places = torch.bucketize(ages % self._period, self._ends, right=True)
        return self._values[places].expand(samples, len(self._episodes.zeros))


class Disturbance:
    """The load disturbance, steps and a walk: see `mptc_gym.signals.Disturbance`."""

    def __init__(self, episodes: Episodes) -> None:
        self._episodes = episodes
        # Steps and walk at the sample before the latest block, and at those of the block.
        self._parts = [(episodes.zeros, episodes.zeros)]

    def reset(self, mask: Tensor) -> Tensor:
        """Begin an episode of some plants."""
        step, walk = self._parts[-1 - self._episodes.unused]
        self._parts = [(step.masked_fill(mask, 0.0), walk.masked_fill(mask, 0.0))]
        return self._episodes.zeros

    def next(self, samples: int) -> Tensor:
        """Draw the next samples."""
        parts = self._parts[-1]
        self._parts, total, rows = [parts], torch.add(*parts), []
        for row in range(samples):
            if self._episodes.any_due(row):
                parts = self._change(*parts, row)
                total = torch.add(*parts)
            self._parts.append(parts)
            rows.append(total)
        return torch.stack(rows)

    def _change(self, step: Tensor, walk: Tensor, row: int) -> tuple[Tensor, Tensor]:
        """Return steps and walk after the plants that are due have changed."""
        numbers, drawn = self._episodes.numbers, self._episodes.draw_within_one(2)
        interval = numbers["disturbance_interval"]
        if isinstance(interval, Tensor):
            interval = interval.clamp(min=LOAD_INTERVAL)
        else:
            interval = max(interval, LOAD_INTERVAL)
        # A step occurs if this is within +-1, and is then uniform there.
        place = drawn[0] * (interval / LOAD_INTERVAL)
        jumps = _is_past(place.new_ones(()), place.abs())
        level = place * numbers["disturbance_amplitude"]
        # Uniform within +-h, a step of the walk has the variance h^2 / 3.
        width = (3.0 * LOAD_INTERVAL * numbers["disturbance_walk_variance"]) ** 0.5
        moved, age = walk + drawn[1] * width, self._episodes.age(row)
        if isinstance(age, Tensor):
            due = (age % LOAD_INTERVAL == 0).to(place.dtype)
            moved, jumps = torch.lerp(walk, moved, due), jumps.mul_(due)
        return torch.lerp(step, level, jumps), moved


def _is_past(now: Tensor, change: Tensor) -> Tensor:
    """Return 1 where a change has been reached, and 0 elsewhere."""
    # Of the same type, as factors of type bool are many times slower.
    past = now - change
    return past.ge_(past.new_zeros(()))


class Given:
    """A signal that is given instead of drawn; or a plant number, by `reset` alone.

    The values have the shape (episodes, samples, n). After the last episode, the first follows
    again; after the last sample, its value is held.
    """

    def __init__(self, values: Tensor, episodes: Episodes) -> None:
        self._values, self._episodes = values, episodes
        self._episode = torch.full_like(episodes.zeros, -1, dtype=torch.int64)  # of each plant

    def reset(self, mask: Tensor) -> Tensor:
        """Begin the next episode of some plants."""
        self._episode = self._episode + mask
        return self._at(torch.zeros_like(self._episode)[None])[0]

    def next(self, samples: int) -> Tensor:
        """Return the next samples."""
        return self._at(self._episodes.ages(samples))

    def _at(self, ages: Tensor) -> Tensor:
        count, length, _ = self._values.shape
        rows = self._episode % count * length + ages.clamp(max=length - 1)
        return self._values.flatten(0, 1).gather(0, rows)


Signal = Noise | RandomSetPoint | RepeatedSetPoint | Disturbance | Given


def make_signals(parameters: Parameters, episodes: Episodes) -> dict[str, Signal]:
    """Return the signals of an environment by name, except noise that is always 0."""
    levels = Levels(parameters)
    setpoint = RandomSetPoint if levels.random else RepeatedSetPoint
    signals: dict[str, Signal] = {"setpoint": setpoint(levels, episodes)}
    if parameters.is_disturbed:
        signals["disturbance"] = Disturbance(episodes)
    for name, c in colours(parameters).items():
        signals[name] = Noise(name, c, episodes)
    return signals


def read_signals(
    signals: Any, parameters: Parameters, episodes: Episodes
) -> tuple[dict[str, Given], int | None]:
    """Check given signals and plant numbers, if any.

    Return them, and the last sample that all signals have, or None without signals.
    """
    if signals is None:
        return {}, None
    n, ranges = len(episodes.zeros), parameters.ranges
    names = {*SIGNALS, *ranges} - ({"disturbance"} if not parameters.is_disturbed else set())
    if not isinstance(signals, Mapping) or not signals or not names >= {*signals}:
        got = [*signals] if isinstance(signals, Mapping) else signals
        reject("options['signals']", got, f"a dict with some of {sorted(names)}")
    read, lengths = {}, []
    for name, got in signals.items():
        path = f"options['signals'][{name!r}]"
        values = as_tensor(got, episodes.zeros)
        if values is None:
            reject(path, got, "numbers")
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
            ends = ranges[name]
            low, high = values.new_tensor(ends)
            whole = isinstance(ends[0], float) or bool((values == values.round()).all())
            if not (whole and bool(((low <= values) & (values <= high)).all())):
                reject(path, got, f"within its range, {list(ends)}")
            values = values[:, None]
        else:
            lengths.append(values.shape[1])
        read[name] = Given(values, episodes)
    return read, min(lengths) - 1 if lengths else None
