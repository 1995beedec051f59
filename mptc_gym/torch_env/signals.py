"""Generate set points, noise and loads of many plants in PyTorch, without loops over plants.

All random numbers come from one random number generator. Every signal class has two methods,
`next` and `reset`. `next(block)` returns the samples of the next block, degC, shape (samples,
n). `reset(restart)` begins an episode of some plants, and returns the signal at sample k = 0,
degC, shape (n,).
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mptc_gym.plant.parameters import Parameters
from mptc_gym.plant.signals import LOAD_INTERVAL, SetPointLevels, noise_polynomials
from mptc_gym.torch_env.episodes import Block, Episodes, ExternalValues, History, Restart


class Noise:
    """Noise of many plants or of their transmitters, degC, which is 0 at sample k = 0."""

    def __init__(self, name: str, c: Sequence[float], episodes: Episodes) -> None:
        """Prepare the coloured noise C(z^-1) xi(k), degC, with white noise xi.

        Parameters
        ----------
        name
            Name of the noise: "noise" for the noise n of equation (28) of the paper, or
            "measurement_noise" for the noise of the transmitter.
        c
            Coefficients of the polynomial C(z^-1), beginning with the constant term.
        episodes
            Episodes of the plants, with the variance of the noise and the random number
            generator.
        """
        self._variance_name = f"{name}_variance"
        self._c = c
        self._order = len(c) - 1
        self._episodes = episodes
        # The white noise xi, degC, in rows of shape (n,): the samples before the latest block
        # that the polynomial C needs, and then the samples of the block.
        self._xi = episodes.zeros.expand(self._order, -1)

    def reset(self, restart: Restart) -> Tensor:
        """Begin an episode of plants in `restart.mask`, and return 0, the noise at k = 0."""
        self._deviation = self._episodes.numbers[self._variance_name] ** 0.5
        used_rows = self._xi[: len(self._xi) - restart.unused_rows]
        self._xi = used_rows.masked_fill(restart.mask, 0.0)
        return self._episodes.zeros

    def next(self, block: Block) -> Tensor:
        """Return the noise at the samples of `block`, degC, shape (samples, n)."""
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
    """Set point that takes random levels, each level for a random number of samples.

    No block of samples is longer than the shortest level, so a block needs only the present
    level and the next level of each plant. Times are counted in samples that `next` has
    generated.
    """

    def __init__(self, levels: SetPointLevels, episodes: Episodes) -> None:
        """Prepare to draw random levels and their durations, as `levels` describes."""
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

        The returned set points y_d(0), degC, have the shape (n,).
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
        """Return random levels of the set point, degC, and durations, samples, shape (n,)."""
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
    """Set point that repeats one sequence of levels for all plants."""

    def __init__(self, levels: SetPointLevels, episodes: Episodes) -> None:
        """Store the set point's levels, degC, and their durations, samples, from `levels`."""
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
    """Load disturbance w(k) of many plants, degC: a level that jumps, plus a random walk.

    `mptc_gym.plant.signals.Disturbance` documents the distributions of the level and the random
    walk.
    """

    def __init__(self, episodes: Episodes) -> None:
        """Begin with a load of 0, and draw random numbers from the generator in `episodes`."""
        self._episodes = episodes
        # The load is the sum of two parts, degC: the level, which jumps in random steps, and
        # the random walk.
        self._steps = History(episodes.zeros, length=1)
        self._walk = History(episodes.zeros, length=1)

    def reset(self, restart: Restart) -> Tensor:
        """Begin an episode of plants in `restart.mask`, and return 0, the load at k = 0."""
        self._steps.reset(restart)
        self._walk.reset(restart)
        return self._episodes.zeros

    def next(self, block: Block) -> Tensor:
        """Return the load at the samples of `block`, degC, shape (samples, n)."""
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
        """Return the load's next level and next random walk, degC, both of shape (n,).

        `step` and `walk` are the present level and the present random walk of the load, degC,
        shape (n,). `age` is the sample number k of each plant, shape (n,), or one number for
        all plants. The load of a plant changes only at sample numbers that are multiples of 10
        (`LOAD_INTERVAL`).
        """
        numbers = self._episodes.numbers
        step_draws, walk_draws = self._episodes.draw_within_one(2)
        # The mean number of samples between two jumps of the level.
        interval = numbers["disturbance_interval"]
        if isinstance(interval, Tensor):
            interval = interval.clamp(min=LOAD_INTERVAL)
        else:
            interval = max(interval, LOAD_INTERVAL)
        # A jump occurs if `position` is within +-1. Given a jump, `position` is uniform within
        # +-1, and so gives the new level.
        position = step_draws * (interval / LOAD_INTERVAL)
        jumps = position.abs() <= 1.0
        # A step of the walk is uniform within +-`width`, and so has the variance width^2 / 3.
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
    """Return the signals of an environment by name, without loads and noises always at 0."""
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
