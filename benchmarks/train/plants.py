"""Draw random plants for training, with set points, noise and the controllers' knowledge."""

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

from agents.bank import Prior
from agents.hedge import RandomSetpoint
from agents.self_tuning import CLEARANCE, CONSTANT_SPREAD, GAIN_SPREAD, TIME_CONSTANTS
from mptc_gym import PRESETS, Parameters
from mptc_gym.torch_env import MiddlePointTorchEnv

SAMPLES: Final = 1200  # length of an episode
PAPER: Final = Parameters()  # the paper's plant
# Magnitude of the gain of the paper's plant, degC per t/h.
GAIN: Final = abs(sum(PAPER.b) / sum(PAPER.a))
# Pole of the paper's plant that belongs to the dominant time constant.
POLE: Final = float(np.abs(np.roots(PAPER.a)).max())
# Half the actuator's range in the paper's plant, t/h.
HALF_RANGE: Final = (PAPER.range_of("u_max")[1] - PAPER.range_of("u_min")[0]) / 2.0
HARD: Final = PRESETS["hard"]  # arguments of the environment `MiddlePointHard-v0`
# Shortest and longest time for which a random set point of `hard` keeps a level, samples.
HOLD_TIMES: Final = (100, 300)
# A hold time that never ends, samples, for plants whose controllers expect no change of the set
# point.
UNCHANGED: Final = 1e30
DELAYS: Final = 13  # number of delays among the candidate models of each plant
# Standard deviation, before clipping, of the error of an inexact step test: of the logarithm of
# the found time constant divided by the true time constant.
TIME_CONSTANT_SPREAD: Final = 0.35
EXACT_GAIN_SPREAD: Final = 1e-3  # like `GAIN_SPREAD`, for the gain from an exact step test
# Standard deviation, samples, of the prior distribution of the delay for some plants.
DELAY_SPREAD: Final = 4.0
# Logarithm of the prior probability of a model that an exact step test excludes. The prior
# probability is in effect 0.
IMPROBABLE: Final = -200.0
# Ranges of the environment's arguments. The parameter values of all training plants, which are
# new in every episode, are within these ranges.
RANGES: Final[dict[str, Any]] = {
    "delay": (6, 36),
    "dead_zone": (0.0, 8.0),
    "gain_factor": (0.5, 2.0),
    "time_constant_factor": (0.4, 2.5),
    "noise_variance": (0.0, 1.0),
    "measurement_noise_variance": (0.0, 0.2),
    "disturbance_amplitude": (0.0, 2.5),
    "disturbance_interval": (100.0, 300.0),
    "disturbance_walk_variance": (0.0, 0.001),
    "gain_drift": (0.5, 2.0),
    "time_constant_drift": (0.5, 2.0),
}


@dataclass(frozen=True)
class Batch:
    """Random plants for an episode, and what controllers know of the plants in advance."""

    numbers: dict[str, Tensor]
    """Parameter values of the plants, by name of the environment's argument, each of shape
    (n,)."""
    setpoints: Tensor
    """Set points at k = 0 to SAMPLES, degC, shape (SAMPLES + 1, n)."""
    setpoint_ages: Tensor
    """Number of samples since the last change of the set point, shape (SAMPLES + 1, n)."""
    innovations: Tensor
    """White noise xi of equation (28) of the paper, degC, shape (SAMPLES + 1, n)."""
    has_random_setpoint: Tensor
    """Whether a plant is like those of the preset `hard`, shape (n,). Only for these plants do
    the controllers and the loss of the training expect random changes of the set point. The set
    points of all other plants also change, as a surprise."""
    amplitudes: Tensor
    """Largest possible set point of each plant, degC, shape (n,)."""
    random_setpoint: RandomSetpoint
    """Distribution of the set points that the controllers assume, with amplitudes divided by
    `temperature_ranges`. For plants unlike the preset `hard`, the controllers assume that the
    set point never changes."""
    prior: Prior
    """Candidate models of the plants and the models' probabilities, which the controllers know
    in advance."""
    temperature_ranges: np.ndarray[Any, np.dtype[np.float32]]
    """Steady temperature change that half the actuator's range causes in the step test of a
    plant, degC, shape (n,)."""
    edges: np.ndarray[Any, np.dtype[np.float32]]
    """Greatest half width that the dead zone may have, as a share of half the actuator's range,
    shape (n,)."""

    @property
    def signals(self) -> dict[str, Tensor]:
        """Parameter values, set points and noise, for the option "signals" of `reset`.

        The noise, degC, is C xi, with the white noise xi and the polynomial C of equation (28)
        of the paper.
        """
        noise = self.innovations.clone()
        for lag, coefficient in enumerate(PAPER.c[1:], start=1):
            noise[lag:] += coefficient * self.innovations[:-lag]
        return {**self.numbers, "setpoint": self.setpoints, "noise": noise}


def environment(n: int) -> MiddlePointTorchEnv:
    """Return a differentiable environment of n plants.

    The observation of a plant consists of the set point and the measured output, degC.
    """
    return MiddlePointTorchEnv(
        n,
        differentiable=True,
        max_episode_steps=SAMPLES,
        setpoint_window=1,
        error_window=0,
        output_window=1,
        **RANGES,
    )


class Sampler:
    """A generator of random training episodes, each with n plants.

    A share of the plants is like those of the preset `hard`. For half of the plants unlike
    `hard`, controllers know the result of an exact step test, and for the other half the result
    of a step test with errors. Set points of plants unlike `hard` change less often than in
    `hard`, and mostly alternate between a positive and a negative value.

    The code of `Sampler` must keep the order of its random draws, so that a training with the
    seed of a published network gives this network.

    Parameters
    ----------
    n
        Number of plants in an episode.
    hard_share
        Share of the plants, from 0 to 1, that are like those of the preset `hard`.
    seed
        Seed of all random numbers.
    """

    def __init__(self, n: int, hard_share: float, seed: int) -> None:
        self._n = n
        self._hard_share = hard_share
        self._generator = torch.Generator()
        self._generator.manual_seed(seed)

    def batch(self) -> Batch:
        """Return n new random plants, with set points and noise for an episode."""
        # A plant is like `hard`, or it has an inexact step test, or it has an exact step test.
        kinds = self._uniform(0.0, 1.0)
        is_hard = kinds < self._hard_share
        is_exact = kinds > (1.0 + self._hard_share) / 2.0
        numbers = self._plant_numbers(is_hard)
        amplitudes = self._amplitudes(numbers["gain_factor"], is_hard)
        setpoints, setpoint_ages = self._setpoints(amplitudes, is_hard)
        innovations = torch.randn(SAMPLES + 1, self._n, generator=self._generator)
        innovations *= numbers["noise_variance"].sqrt()
        innovations[0] = 0.0  # the plant begins at rest
        gain_factors = self._step_test(numbers["gain_factor"], GAIN_SPREAD, is_hard, is_exact)
        time_constant_factors = self._step_test(
            numbers["time_constant_factor"], TIME_CONSTANT_SPREAD, is_hard, is_exact
        )
        prior = self._prior(time_constant_factors, numbers["delay"], is_hard, is_exact)
        widest_zones = self._widest_dead_zones(numbers["dead_zone"], is_hard, is_exact)
        temperature_ranges = (gain_factors * GAIN * HALF_RANGE).numpy()
        random_setpoint = RandomSetpoint(
            shortest=np.where(is_hard, HOLD_TIMES[0], 0.0),
            longest=np.where(is_hard, HOLD_TIMES[1], UNCHANGED),
            amplitude=amplitudes.numpy() / temperature_ranges,
        )
        return Batch(
            numbers=numbers,
            setpoints=setpoints,
            setpoint_ages=setpoint_ages,
            innovations=innovations,
            has_random_setpoint=is_hard,
            amplitudes=amplitudes,
            random_setpoint=random_setpoint,
            prior=prior,
            temperature_ranges=temperature_ranges,
            edges=(widest_zones / HALF_RANGE + CLEARANCE).numpy(),
        )

    def _uniform(self, low: Any, high: Any, *shape: int) -> Tensor:
        """Return random numbers that are uniformly distributed from `low` to `high`.

        The result has the shape `shape` (default: (n,)), to which `low` and `high` broadcast.
        """
        uniform = torch.rand(*(shape or (self._n,)), generator=self._generator)
        values: Tensor = low + uniform * (high - low)
        return values

    def _true_for(self, share: float) -> Tensor:
        """Return random bools, shape (n,), that are True with the probability `share`."""
        return self._uniform(0.0, 1.0) < share

    def _plant_numbers(self, is_hard: Tensor) -> dict[str, Tensor]:
        """Return random parameter values of n plants, by argument name, each of shape (n,).

        Plants like those of the preset `hard` (`is_hard`) have values from the ranges in
        `hard`, and all other plants have values from wider ranges.
        """
        is_noisy = self._true_for(0.65)
        has_load = self._true_for(0.5)
        drifts = self._true_for(0.4)
        log_2 = math.log(2.0)
        wide = {
            "delay": self._uniform(6.0, 37.0).floor(),
            "dead_zone": self._uniform(0.0, 8.0),
            "gain_factor": self._uniform(0.75, 1.6),
            "time_constant_factor": self._uniform(-log_2, log_2).exp(),
            "noise_variance": self._uniform(0.0, 1.0) * is_noisy,
            "measurement_noise_variance": self._uniform(0.0, 0.2)
            * is_noisy
            * self._true_for(0.5),
            "disturbance_amplitude": self._uniform(0.5, 2.5) * has_load,
            "disturbance_interval": self._uniform(100.0, 300.0),
            "disturbance_walk_variance": self._uniform(0.0, 0.001) * has_load * is_noisy,
            "gain_drift": torch.where(drifts, self._uniform(0.6, 1.6), 1.0),
            "time_constant_drift": torch.where(drifts, self._uniform(0.75, 1.35), 1.0),
        }
        numbers = {}
        for name, wide_values in wide.items():
            # An argument of `hard` is a range [low, high] or one number.
            low, high = np.broadcast_to(HARD[name], 2).tolist()
            if name == "delay":
                hard_values = self._uniform(low, high + 1).floor()
            else:
                hard_values = self._uniform(low, high)
            numbers[name] = torch.where(is_hard, hard_values, wide_values)
        return numbers

    def _amplitudes(self, gain_factors: Tensor, is_hard: Tensor) -> Tensor:
        """Return a random amplitude of the set points of each plant, degC, shape (n,).

        Plants like those of the preset `hard` (`is_hard`) have set points of the paper's
        amplitude. For all other plants, the amplitude is within the temperature range of the
        plant, which is in proportion to `gain_factors`, the gains as multiples of the paper's
        gain.
        """
        reachable = 0.95 * GAIN * HALF_RANGE * gain_factors
        amplitudes = torch.where(self._true_for(0.5), 5.0, self._uniform(1.0, 6.0))
        return torch.where(is_hard, PAPER.setpoint_amplitude, amplitudes.minimum(reachable))

    def _setpoints(self, amplitudes: Tensor, is_hard: Tensor) -> tuple[Tensor, Tensor]:
        """Return random set points, degC, and the number of samples since the last change.

        Both returned tensors have the shape (SAMPLES + 1, n). `amplitudes` are the largest set
        points of the plants, degC, shape (n,).
        """
        shortest_hard, longest_hard = HOLD_TIMES
        shortest_other = self._uniform(longest_hard + 10.0, 700.0)
        shortest = torch.where(is_hard, float(shortest_hard), shortest_other)
        longest = torch.where(is_hard, float(longest_hard), shortest + longest_hard)
        count = SAMPLES // shortest_hard + 2  # levels, enough for an episode
        shares = self._uniform(0.0, 1.0, count, self._n)
        lengths = (shortest + shares * (longest + 1.0 - shortest)).floor()
        starts = torch.cat([torch.zeros(1, self._n), lengths.cumsum(0)[:-1]])

        random_levels = self._uniform(-1.0, 1.0, count, self._n)
        signs = torch.where(torch.arange(count)[:, None] % 2 == 0, 1.0, -1.0)
        alternating_levels = signs * random_levels[0].sign()
        alternates = ~is_hard & self._true_for(0.8)
        levels = amplitudes * torch.where(alternates, alternating_levels, random_levels)

        samples = torch.arange(SAMPLES + 1.0)
        samples_of_plants = samples.expand(self._n, -1).contiguous()
        # The number of levels that have started at each sample of each plant, shape
        # (n, SAMPLES + 1): `searchsorted` needs one sorted row for each plant.
        started = torch.searchsorted(starts.T.contiguous(), samples_of_plants, right=True)
        level_numbers = started.T - 1
        setpoint_ages = samples[:, None] - starts.gather(0, level_numbers)
        return levels.gather(0, level_numbers), setpoint_ages

    def _step_test(
        self, factors: Tensor, spread: float, is_hard: Tensor, is_exact: Tensor
    ) -> Tensor:
        """Return the gains or the time constants that step tests of n plants find, shape (n,).

        The true values `factors`, and the found values, are multiples of the paper's gain or
        time constant. For a plant like those of the preset `hard` (`is_hard`), a step test
        finds the middle of the range that `hard` has for the gain or time constant. For a plant
        unlike `hard`, a step test finds the true value if `is_exact` is true, and otherwise a
        value with a random error: the logarithm of the found value divided by the true value is
        normally distributed with the standard deviation `spread`, and clipped to +-2 `spread`.
        """
        middle = sum(HARD["gain_factor"]) / 2.0  # for the time constant, the range is equal
        normal = torch.randn(self._n, generator=self._generator).clamp(-2.0, 2.0)
        log_errors = torch.where(is_exact, 0.0, spread * normal)
        return torch.where(is_hard, middle, factors * log_errors.exp())

    def _prior(
        self, time_constant_factors: Tensor, delays: Tensor, is_hard: Tensor, is_exact: Tensor
    ) -> Prior:
        """Return the candidate models of each plant, and the models' initial probabilities.

        Each plant has one candidate model for each pair of a delay and a time constant. For a
        plant with an exact step test (`is_exact`), the candidate model from the step test has
        in effect the probability 1. For half of the plants unlike the preset `hard`
        (`is_hard`), models with a wrong delay are less probable. `time_constant_factors` are
        the time constants from step tests, as multiples of the paper's time constant, shape
        (n,).
        """
        poles = 1.0 - (1.0 - POLE) / time_constant_factors
        time_constants = -1.0 / torch.log(poles)  # samples
        # Index, from 0, of a plant's true delay among the delays of the candidate models. The
        # index is smaller if the shortest delay would be below 1 sample, and is not used for
        # plants like those of `hard`.
        places = self._uniform(0.0, DELAYS).floor()
        shortest = (delays - places).clamp(min=1.0)
        shortest = torch.where(is_hard, HARD["delay"][0], shortest)
        # The delay of each model minus the plant's delay, samples, shape (DELAYS, n).
        delay_errors = torch.arange(float(DELAYS))[:, None] - (delays - shortest)
        has_delay_prior = ~is_hard & self._true_for(0.5)
        # The prior of the delay, and of the logarithm of the time constant, is a normal
        # distribution.
        delay_terms = -0.5 * (delay_errors / DELAY_SPREAD).square() * has_delay_prior
        time_constant_terms = -0.5 * np.square(np.log(TIME_CONSTANTS) / CONSTANT_SPREAD)
        # The logarithm of each model's probability, shape (DELAYS, time constants, n).
        logarithms = delay_terms[:, None] + torch.from_numpy(time_constant_terms)[:, None]
        has_middle_time_constant = torch.from_numpy(TIME_CONSTANTS == 1.0)[:, None]
        is_step_test = (delay_errors[:, None] == 0.0) & has_middle_time_constant
        logarithms += torch.where(is_exact & ~is_step_test, IMPROBABLE, 0.0)
        return Prior(
            time_constants=(torch.from_numpy(TIME_CONSTANTS)[:, None] * time_constants).numpy(),
            shortest_delays=shortest.numpy(),
            log_probabilities=logarithms.numpy(),
            # Prior standard deviation of the gain, divided by the gain of the step test.
            gain_spread=torch.where(is_exact, EXACT_GAIN_SPREAD, GAIN_SPREAD).numpy(),
        )

    def _widest_dead_zones(
        self, dead_zones: Tensor, is_hard: Tensor, is_exact: Tensor
    ) -> Tensor:
        """Return the half width of the dead zone that controllers assume for each plant, t/h.

        After an exact step test (`is_exact`), controllers assume the true half width. For
        plants like those of the preset `hard` (`is_hard`), controllers assume the greatest half
        width in `hard`. For all other plants, controllers assume a half width that is up to 3
        t/h too large.
        """
        margins = self._uniform(0.0, 3.0) * ~is_exact
        widest = (dead_zones + margins).clamp(max=8.0)
        return torch.where(is_hard, HARD["dead_zone"][1], widest)
