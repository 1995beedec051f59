"""Generate the external signals of many plants in PyTorch, from one random number generator.

A signal class has two methods, which work on n plants at once, without a loop over plants.
`next(block)` returns the samples of the next block, degC, shape (samples, n). `reset(restart)`
begins an episode of some plants, and returns the signal at sample k = 0, degC, shape (n,).
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mptc_gym.plant.parameters import Parameters
from mptc_gym.plant.signals import LOAD_INTERVAL, SetPointLevels, noise_polynomials
from mptc_gym.torch_env.episodes import Block, Episodes, ExternalValues, History, Restart


class Noise:
    """The plant's noise or the transmitter's noise, for many plants; 0 at k = 0."""

    def __init__(self, name: str, c: Sequence[float], episodes: Episodes) -> None:
        """Prepare the coloured noise C(z^-1) xi(k), degC, with white noise xi.

        Parameters
        ----------
        name
            "noise" for the noise n of equation (28) of the paper, or "measurement_noise" for
            the noise of the transmitter.
        c
            The coefficients of the polynomial C, from z^0 on.
        episodes
            The present episodes, which hold the variance and the random number generator.
        """
        self._variance_name = f"{name}_variance"
        self._c = c
        self._order = len(c) - 1
        self._episodes = episodes
        # The white noise xi, degC, in rows of shape (n,): the samples before the latest block
        # that the polynomial C needs, and then the samples of the block.
        self._xi = episodes.zeros.expand(self._order, -1)

    def reset(self, restart: Restart) -> Tensor:
        """Begin an episode of the plants in `restart.mask`; return zeros, shape (n,)."""
        self._deviation = self._episodes.numbers[self._variance_name] ** 0.5
        used_rows = self._xi[: len(self._xi) - restart.unused_rows]
        self._xi = used_rows.masked_fill(restart.mask, 0.0)
        return self._episodes.zeros

    def next(self, block: Block) -> Tensor:
        """Return the noise of the samples of a block, degC, shape (samples, n)."""
        order = self._order
        generator = self._episodes.generator
        past = self._xi[len(self._xi) - order :]
        self._xi = past.new_empty(order + block.samples, past.shape[1])
        self._xi[:order] = past
        noise = self._xi[order:]  # a view: the new white noise is written into `_xi`
        if isinstance(self._deviation, float):
            noise.normal_(0.0, self._deviation, generator=generator)
        else:
            noise.normal_(generator=generator).mul_(self._deviation)
        for lag, coefficient in enumerate(self._c[1:], start=1):
            first = order - lag
            noise = noise.add(self._xi[first : first + block.samples], alpha=coefficient)
        return noise


class RandomSetPoint:
    """A set point of random levels, each level held for a random number of samples.

    The present and the next level of each plant are enough for a block of samples, as no block
    is longer than the shortest level. Times are counted in samples of the signal.
    """

    def __init__(self, levels: SetPointLevels, episodes: Episodes) -> None:
        """Draw from the ranges of levels and lengths in `levels`, from the first reset on."""
        self._distribution = levels
        self._episodes = episodes
        zeros = episodes.zeros
        self._time = 0  # time of the latest sample
        self._known_until = 0  # the time up to which the present and the next level are enough
        self._level = zeros  # present level of each plant, degC
        self._next_level = zeros  # the level after the present level, degC
        self._level_end = zeros.to(torch.int64)  # the time at which the present level ends
        self._next_level_end = self._level_end

    def reset(self, restart: Restart) -> Tensor:
        """Begin an episode of the plants in `restart.mask`, and return the first set points.

        The set points y_d(0), degC, have the shape (n,).
        """
        self._time -= restart.unused_rows
        self._forget_past_levels()
        levels, lengths = self._draw()
        self._level = torch.where(restart.mask, levels, self._level)
        self._level_end = torch.where(restart.mask, self._time + lengths, self._level_end)
        self._known_until = self._time
        return self._level

    def next(self, block: Block) -> Tensor:
        """Return the set points of the samples of a block, degC, shape (samples, n)."""
        last_time = self._time + block.samples
        if last_time > self._known_until:
            self._forget_past_levels()
            # The next level holds at least as long as the shortest level.
            self._known_until = self._time + self._distribution.shortest
            self._next_level, lengths = self._draw()
            self._next_level_end = self._level_end + lengths
        times = torch.arange(self._time + 1, last_time + 1, device=self._level.device)
        self._time = last_time
        return torch.where(times[:, None] >= self._level_end, self._next_level, self._level)

    def _draw(self) -> tuple[Tensor, Tensor]:
        """Draw a level, degC, and its length, samples, for each plant: two of shape (n,)."""
        distribution = self._distribution
        levels = self._episodes.draw_within_one(1)[0] * distribution.amplitude
        lengths = self._episodes.draw(
            distribution.shortest, distribution.longest, is_integer=True
        )
        return levels, lengths.to(torch.int64)

    def _forget_past_levels(self) -> None:
        """Make the next level the present level of each plant whose present level has ended."""
        has_ended = self._level_end <= self._time
        self._level = torch.where(has_ended, self._next_level, self._level)
        self._level_end = torch.where(has_ended, self._next_level_end, self._level_end)


class RepeatedSetPoint:
    """A set point that repeats a sequence of levels, which all plants share."""

    def __init__(self, levels: SetPointLevels, episodes: Episodes) -> None:
        """Take the levels, degC, and their lengths, samples, from `levels`."""
        self._n = len(episodes.zeros)
        self._levels = episodes.zeros.new_tensor(levels.values)
        # The samples of a period at which the levels end.
        self._ends = torch.tensor(levels.lengths, device=self._levels.device).cumsum(0)
        self._period = sum(levels.lengths)

    def reset(self, restart: Restart) -> Tensor:
        """Return the first level of the set point for all plants, degC, shape (n,)."""
        return self._levels[0].expand(self._n)

    def next(self, block: Block) -> Tensor:
        """Return the set points of the samples of a block, degC, shape (samples, n)."""
        samples_of_period = block.ages(self._ends.device) % self._period
        # The index of the level is the number of ends that a sample has reached.
        indices = torch.bucketize(samples_of_period, self._ends, right=True)
        return self._levels[indices].expand(-1, self._n)


class Disturbance:
    """The load disturbance w(k), degC, of many plants: the sum of steps and a random walk.

    `mptc_gym.plant.signals.Disturbance` describes the distribution of steps and walk.
    """

    def __init__(self, episodes: Episodes) -> None:
        """Begin with a load of 0; `episodes` holds plant numbers and generator."""
        self._episodes = episodes
        # The two parts of the load, steps and walk, degC.
        self._steps = History(episodes.zeros, 1)
        self._walk = History(episodes.zeros, 1)

    def reset(self, restart: Restart) -> Tensor:
        """Begin an episode, with a load of 0, of the plants in `restart.mask`; return zeros."""
        self._steps.reset(restart)
        self._walk.reset(restart)
        return self._episodes.zeros

    def next(self, block: Block) -> Tensor:
        """Return the load at the samples of a block, degC, shape (samples, n)."""
        step = self._steps.rows[-1]
        walk = self._walk.rows[-1]
        steps: list[Tensor] = []
        walks: list[Tensor] = []
        for row in range(block.samples):
            if row in block.due_rows:
                step, walk = self._change(step, walk, block.age(row))
            steps.append(step)
            walks.append(walk)
        self._steps.extend(steps)
        self._walk.extend(walks)
        return torch.stack(steps).add_(torch.stack(walks))

    def _change(self, step: Tensor, walk: Tensor, age: Tensor | int) -> tuple[Tensor, Tensor]:
        """Return the next values of the two parts of the load, degC, each of shape (n,).

        Parameters
        ----------
        step, walk
            The present values of the sum of steps and of the random walk, degC, shape (n,).
        age
            The sample k of each plant, shape (n,), or one number for all plants. The load of a
            plant changes only if k is a multiple of `LOAD_INTERVAL`.
        """
        numbers = self._episodes.numbers
        step_draws, walk_draws = self._episodes.draw_within_one(2)
        # The mean number of samples between two jumps of the sum of steps.
        interval = numbers["disturbance_interval"]
        if isinstance(interval, Tensor):
            interval = interval.clamp(min=LOAD_INTERVAL)
        else:
            interval = max(interval, LOAD_INTERVAL)
        # A jump occurs if `position` is within +-1. Given a jump, `position` is uniform within
        # +-1, and so gives the new level.
        position = step_draws * (interval / LOAD_INTERVAL)
        jumps = position.abs() <= 1.0
        # A step of the walk is uniform within +-h and so has the variance h^2 / 3.
        width = (3.0 * LOAD_INTERVAL * numbers["disturbance_walk_variance"]) ** 0.5
        next_walk = walk + walk_draws * width
        if isinstance(age, Tensor):  # the episodes of the plants began at different times
            is_due = age % LOAD_INTERVAL == 0
            jumps &= is_due
            next_walk = torch.where(is_due, next_walk, walk)
        level = position * numbers["disturbance_amplitude"]
        return torch.where(jumps, level, step), next_walk


Signal = Noise | RandomSetPoint | RepeatedSetPoint | Disturbance | ExternalValues


def make_signals(parameters: Parameters, episodes: Episodes) -> dict[str, Signal]:
    """Return the signals of an environment by name, without those that are always 0."""
    levels = SetPointLevels(parameters)
    signals: dict[str, Signal] = {}
    if levels.random:
        signals["setpoint"] = RandomSetPoint(levels, episodes)
    else:
        signals["setpoint"] = RepeatedSetPoint(levels, episodes)
    if parameters.is_disturbed:
        signals["disturbance"] = Disturbance(episodes)
    for name, c in noise_polynomials(parameters).items():
        signals[name] = Noise(name, c, episodes)
    return signals
