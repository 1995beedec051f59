"""Generate the external signals of many plants in PyTorch, from one generator.

A signal has two methods, which work on n plants at once, without a loop over plants.
`reset(mask)` begins an episode of the plants in the mask and returns the signal at k = 0, degC,
shape (n,). `next(samples)` returns the following block of samples, degC, shape (samples, n).
All signals share the clock of `Episodes`, which the environment sets before it calls them.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from mptc_gym.parameters import Parameters
from mptc_gym.signals import LOAD_INTERVAL, Levels, colours
from mptc_gym.torch_episodes import LONGEST, Episodes, Given


class Noise:
    """Coloured noise, by name: see `mptc_gym.signals.Noise`."""

    def __init__(self, name: str, c: Sequence[float], episodes: Episodes) -> None:
        self._variance_name = f"{name}_variance"
        self._c = c
        self._order = len(c) - 1
        self._episodes = episodes
        # xi of the samples that C needs from before the latest block, then those of the block.
        self._xi = episodes.zeros.expand(self._order, -1)

    def reset(self, mask: Tensor) -> Tensor:
        """Begin an episode of some plants."""
        self._deviation = self._episodes.numbers[self._variance_name] ** 0.5
        used_rows = len(self._xi) - self._episodes.unused
        self._xi = self._xi[:used_rows].masked_fill(mask, 0.0)
        return self._episodes.zeros

    def next(self, samples: int) -> Tensor:
        """Draw the next samples."""
        order = self._order
        generator = self._episodes.generator
        past = self._xi[len(self._xi) - order :]
        self._xi = past.new_empty(order + samples, past.shape[1])
        self._xi[:order] = past
        noise = self._xi[order:]
        if isinstance(self._deviation, float):
            noise.normal_(0.0, self._deviation, generator=generator)
        else:
            noise.normal_(generator=generator).mul_(self._deviation)
        for lag, coefficient in enumerate(self._c[1:], start=1):
            noise = noise.add(self._xi[order - lag : order - lag + samples], alpha=coefficient)
        return noise


class RandomSetPoint:
    """A set point of random levels, each held for a random number of samples.

    The present level and the next one of each plant are known. This is enough for a block, as
    no block is longer than the shortest level.
    """

    def __init__(self, levels: Levels, episodes: Episodes) -> None:
        self._distribution = levels
        self._episodes = episodes
        zeros = episodes.zeros
        self._rows = torch.arange(LONGEST, dtype=zeros.dtype).to(zeros.device)[:, None]
        # Times of changes are counted from the latest draw, as small floats are fastest.
        self._drawn_at = 0  # the clock of the latest draw
        self._known_until = 0  # the clock up to which the two levels are enough
        self._level = zeros  # of each plant at that time, degC
        self._end = zeros  # when it ends
        self._next_level = zeros  # the level that follows it, degC
        self._next_end = zeros

    def reset(self, mask: Tensor) -> Tensor:
        """Begin an episode of some plants."""
        self._count_from(self._episodes.clock)
        level, length = self._draw()
        self._level = torch.where(mask, level, self._level)
        self._end = torch.where(mask, length, self._end)
        self._known_until = self._drawn_at
        return self._level

    def next(self, samples: int) -> Tensor:
        """Return the next samples."""
        clock = self._episodes.clock
        if clock + samples - 1 > self._known_until:
            self._count_from(clock - 1)
            self._known_until = self._drawn_at + self._distribution.shortest
            self._next_level, length = self._draw()
            self._next_end = self._end + length
        times = self._rows[:samples] + (clock - self._drawn_at)
        has_ended = _is_past(times, self._end)
        return torch.lerp(self._level.expand(samples, -1), self._next_level, has_ended)

    def _draw(self) -> tuple[Tensor, Tensor]:
        """Draw levels, degC, and for how many samples they hold, each of shape (n,)."""
        distribution = self._distribution
        levels = self._episodes.draw_within_one(1)[0] * distribution.amplitude
        lengths = self._episodes.draw(distribution.shortest, distribution.longest, whole=True)
        return levels, lengths

    def _count_from(self, clock: int) -> None:
        """Count times from this time of the clock on; forget levels that have ended by then."""
        passed = clock - self._drawn_at
        has_ended = _is_past(self._end.new_full((), passed), self._end)
        self._level = torch.lerp(self._level, self._next_level, has_ended)
        self._end = torch.lerp(self._end, self._next_end, has_ended) - passed
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


class Load(NamedTuple):
    """The two parts of the load disturbance at a sample, degC, each of shape (n,)."""

    step: Tensor
    walk: Tensor

    def total(self) -> Tensor:
        """Return their sum w(k)."""
        return torch.add(self.step, self.walk)


class Disturbance:
    """The load disturbance, steps and a walk: see `mptc_gym.signals.Disturbance`."""

    def __init__(self, episodes: Episodes) -> None:
        self._episodes = episodes
        # The load at the sample before the latest block, and at those of the block.
        self._loads = [Load(episodes.zeros, episodes.zeros)]

    def reset(self, mask: Tensor) -> Tensor:
        """Begin an episode of some plants."""
        present = self._loads[-1 - self._episodes.unused]
        step = present.step.masked_fill(mask, 0.0)
        walk = present.walk.masked_fill(mask, 0.0)
        self._loads = [Load(step, walk)]
        return self._episodes.zeros

    def next(self, samples: int) -> Tensor:
        """Draw the next samples."""
        load = self._loads[-1]
        total = load.total()
        self._loads = [load]
        totals: list[Tensor] = []
        for row in range(samples):
            if self._episodes.any_due(row):
                load = self._change(load, row)
                total = load.total()
            self._loads.append(load)
            totals.append(total)
        return torch.stack(totals)

    def _change(self, load: Load, row: int) -> Load:
        """Return the load at a row of the block, at which the load of some plants changes."""
        numbers = self._episodes.numbers
        step_draws, walk_draws = self._episodes.draw_within_one(2)
        interval = numbers["disturbance_interval"]
        if isinstance(interval, Tensor):
            interval = interval.clamp(min=LOAD_INTERVAL)
        else:
            interval = max(interval, LOAD_INTERVAL)
        # A step occurs if this number is within +-1, and the number is then uniform there.
        position = step_draws * (interval / LOAD_INTERVAL)
        jumps = _is_past(position.new_ones(()), position.abs())
        level = position * numbers["disturbance_amplitude"]
        # Uniform within +-h, a step of the walk has the variance h^2 / 3.
        width = (3.0 * LOAD_INTERVAL * numbers["disturbance_walk_variance"]) ** 0.5
        walk = load.walk + walk_draws * width
        age = self._episodes.age(row)
        if isinstance(age, Tensor):  # the other plants keep their load
            is_due = (age % LOAD_INTERVAL == 0).to(position.dtype)
            walk = torch.lerp(load.walk, walk, is_due)
            jumps = jumps.mul_(is_due)
        return Load(torch.lerp(load.step, level, jumps), walk)


def _is_past(time: Tensor, change: Tensor) -> Tensor:
    """Return 1 where a time has reached that of a change, and 0 elsewhere.

    The result has the type of the times, as factors of type bool are many times slower.
    """
    since_change = time - change
    return since_change.ge_(since_change.new_zeros(()))


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
