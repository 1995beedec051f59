"""Make random plants to train on, with set points, noise and a controller's prior knowledge."""

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
GAIN: Final = abs(sum(PAPER.b) / sum(PAPER.a))  # magnitude of its gain, degC per t/h
POLE: Final = float(np.abs(np.roots(PAPER.a)).max())  # its pole of the dominant time constant
# Half the range of its actuator, t/h.
HALF_RANGE: Final = (PAPER.range_of("u_max")[1] - PAPER.range_of("u_min")[0]) / 2.0
HARD: Final = PRESETS["hard"]  # arguments of the environment `MiddlePointHard-v0`
# Shortest and longest time for which a random set point of `hard` keeps a level, samples.
HOLDS: Final = (100, 300)
# A hold time that never ends, samples, for set points that do not change at random.
UNCHANGED: Final = 1e30
DELAYS: Final = 13  # number of delays in the bank of models of each plant
# Ranges of the environment's arguments that contain the numbers of all training plants. Every
# episode sets the plant numbers within these ranges.
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
    """An episode of n plants, and what the controllers know of the plants in advance."""

    numbers: dict[str, Tensor]
    """The plant numbers by the names of the environment's arguments, each of shape (n,)."""
    setpoints: Tensor
    """Set points at k = 0 to SAMPLES, degC, shape (SAMPLES + 1, n)."""
    ages: Tensor
    """Number of samples since the last change of the set point, shape (SAMPLES + 1, n)."""
    innovations: Tensor
    """The white noise xi of equation (28) of the paper, degC, shape (SAMPLES + 1, n)."""
    changes_by_surprise: Tensor
    """Whether the set point of a plant changes at random, as in the preset `hard`, shape
    (n,)."""
    amplitudes: Tensor
    """Largest possible set point of each plant, degC, shape (n,)."""
    random_setpoint: RandomSetpoint
    """The distribution of the set points that controllers know; its amplitudes are shares of
    the authority."""
    prior: Prior
    """The prior knowledge of the plants' dynamics, for the bank of models."""
    authorities: np.ndarray[Any, np.dtype[np.float32]]
    """Authority of each plant, degC, shape (n,): the steady change of temperature that half the
    actuator's range causes in the step test."""
    edges: np.ndarray[Any, np.dtype[np.float32]]
    """Greatest half width that the dead zone may have, as a share of half the actuator's range,
    shape (n,)."""

    @property
    def signals(self) -> dict[str, Tensor]:
        """Plant numbers, set points and coloured noise, an option of the environment's reset.

        The noise, degC, is C xi: the white noise after the polynomial C of equation (28) of the
        paper.
        """
        noise = self.innovations.clone()
        for lag, coefficient in enumerate(PAPER.c[1:], start=1):
            noise[lag:] += coefficient * self.innovations[:-lag]
        return {**self.numbers, "setpoint": self.setpoints, "noise": noise}


def environment(n: int) -> MiddlePointTorchEnv:
    """Return a differentiable environment of n plants.

    An observation of a plant is the set point and the measured output, degC.
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
    """A generator of random batches of n plants for training.

    A share of the plants is like the plants of the preset `hard`. Half of the other plants are
    known by an exact step test, and the other half by a step test with errors. The set points
    of all plants that are not like `hard` last longer than those of `hard`, and mostly
    alternate between a positive and a negative value.

    Parameters
    ----------
    n
        Number of plants in a batch.
    hard_share
        Share of the plants that are like those of `hard`.
    seed
        Seed of all random numbers.
    """

    def __init__(self, n: int, hard_share: float, seed: int) -> None:
        self._n = n
        self._hard_share = hard_share
        self._generator = torch.Generator()
        self._generator.manual_seed(seed)

    def batch(self) -> Batch:
        """Return a new random batch of n plants for an episode."""
        kind = self._uniform(0.0, 1.0)
        hard = kind < self._hard_share
        exact = kind > (1.0 + self._hard_share) / 2.0
        numbers = self._numbers(hard)
        reach = 0.95 * GAIN * HALF_RANGE * numbers["gain_factor"]
        amplitudes = torch.where(self._some(0.5), 5.0, self._uniform(1.0, 6.0))
        amplitudes = torch.where(hard, PAPER.setpoint_amplitude, amplitudes.minimum(reach))
        setpoints, ages = self._setpoints(amplitudes, hard)
        innovations = torch.randn(SAMPLES + 1, self._n, generator=self._generator)
        innovations *= numbers["noise_variance"].sqrt()
        innovations[0] = 0.0  # the plant begins at rest
        prior, gains = self._knowledge(numbers, hard, exact)
        widest = numbers["dead_zone"] + self._uniform(0.0, 3.0) * ~exact
        widest = torch.where(hard, HARD["dead_zone"][1], widest.clamp(max=8.0))
        authorities = (gains * GAIN * HALF_RANGE).numpy()
        random_setpoint = RandomSetpoint(
            shortest=np.where(hard, HOLDS[0], 0.0),
            longest=np.where(hard, HOLDS[1], UNCHANGED),
            amplitude=amplitudes.numpy() / authorities,
        )
        return Batch(
            numbers=numbers,
            setpoints=setpoints,
            ages=ages,
            innovations=innovations,
            changes_by_surprise=hard,
            amplitudes=amplitudes,
            random_setpoint=random_setpoint,
            prior=prior,
            authorities=authorities,
            edges=(widest / HALF_RANGE + CLEARANCE).numpy(),
        )

    def _uniform(self, low: Any, high: Any, *shape: int) -> Tensor:
        """Return random numbers that are uniformly distributed from `low` to `high`.

        The shape is `shape`, or (n,) by default; `low` and `high` broadcast against it.
        """
        uniform = torch.rand(*(shape or (self._n,)), generator=self._generator)
        values: Tensor = low + uniform * (high - low)
        return values

    def _normal(self) -> Tensor:
        """Return standard normal random numbers, limited to [-2, 2], shape (n,)."""
        return torch.randn(self._n, generator=self._generator).clamp(-2.0, 2.0)

    def _some(self, share: float) -> Tensor:
        """Return bools, shape (n,), each of which is True with the probability `share`."""
        return self._uniform(0.0, 1.0) < share

    def _numbers(self, hard: Tensor) -> dict[str, Tensor]:
        """Return random plant numbers by the names of the environment's arguments.

        `hard` says which plants are like those of the preset `hard`, shape (n,). The numbers of
        the other plants come from wider ranges. Each array of numbers has the shape (n,).
        """
        noisy, loaded, drifts = self._some(0.65), self._some(0.5), self._some(0.4)
        octave = math.log(2.0)
        others = {
            "delay": self._uniform(6.0, 37.0).floor(),
            "dead_zone": self._uniform(0.0, 8.0),
            "gain_factor": self._uniform(0.75, 1.6),
            "time_constant_factor": self._uniform(-octave, octave).exp(),
            "noise_variance": self._uniform(0.0, 1.0) * noisy,
            "measurement_noise_variance": self._uniform(0.0, 0.2) * noisy * self._some(0.5),
            "disturbance_amplitude": self._uniform(0.5, 2.5) * loaded,
            "disturbance_interval": self._uniform(100.0, 300.0),
            "disturbance_walk_variance": self._uniform(0.0, 0.001) * loaded * noisy,
            "gain_drift": torch.where(drifts, self._uniform(0.6, 1.6), 1.0),
            "time_constant_drift": torch.where(drifts, self._uniform(0.75, 1.35), 1.0),
        }
        numbers = {}
        for name, values in others.items():
            low, high = np.broadcast_to(HARD[name], 2).tolist()
            if name == "delay":
                like_hard = self._uniform(low, high + 1).floor()
            else:
                like_hard = self._uniform(low, high)
            numbers[name] = torch.where(hard, like_hard, values)
        return numbers

    def _setpoints(self, amplitudes: Tensor, hard: Tensor) -> tuple[Tensor, Tensor]:
        """Return random set points, degC, and the number of samples since their last change.

        `amplitudes` are the largest set points, degC, and `hard` says which plants are like
        those of the preset `hard`, both of shape (n,). Both results have the shape
        (SAMPLES + 1, n).
        """
        n, (shortest, longest) = self._n, HOLDS
        low = torch.where(hard, float(shortest), self._uniform(longest + 10.0, 700.0))
        high = torch.where(hard, float(longest), low + longest)
        count = SAMPLES // shortest + 2
        lengths = (low + self._uniform(0.0, 1.0, count, n) * (high + 1.0 - low)).floor()
        starts = torch.cat([torch.zeros(1, n), lengths.cumsum(0)[:-1]])
        levels = self._uniform(-1.0, 1.0, count, n)
        signs = torch.where(torch.arange(count)[:, None] % 2 == 0, 1.0, -1.0)
        alternates = ~hard & self._some(0.8)
        levels = amplitudes * torch.where(alternates, signs * levels[0].sign(), levels)
        samples = torch.arange(SAMPLES + 1.0)
        times = samples.expand(n, -1).contiguous()
        places = torch.searchsorted(starts.T.contiguous(), times, right=True)
        number = places.T - 1  # of the level at each sample
        return levels.gather(0, number), samples[:, None] - starts.gather(0, number)

    def _knowledge(
        self, numbers: dict[str, Tensor], hard: Tensor, exact: Tensor
    ) -> tuple[Prior, Tensor]:
        """Return the prior knowledge of the plants, and the gains of their step tests.

        The bank of every plant has the same number of models. For a plant with an exact step
        test, the model of the step test has the probability 1.

        Parameters
        ----------
        numbers
            The plant numbers, by the names of the environment's arguments.
        hard
            Whether a plant is like those of the preset `hard`, shape (n,).
        exact
            Whether the step test of a plant is exact, shape (n,).

        Returns
        -------
        prior : Prior
            Models and probabilities, for the bank of models.
        gains : Tensor
            Gains of the step tests, as multiples of the paper's gain, shape (n,).
        """
        middle = sum(HARD["gain_factor"]) / 2.0  # of gain and time constant in `hard`
        wrong = {"gain_factor": GAIN_SPREAD, "time_constant_factor": 0.35}
        known = {}
        for name, spread in wrong.items():
            off = torch.where(exact, 0.0, spread * self._normal())
            known[name] = torch.where(hard, middle, numbers[name] * off.exp())
        constants = -1.0 / torch.log(1.0 - (1.0 - POLE) / known["time_constant_factor"])
        place = self._uniform(0.0, DELAYS).floor()  # of the plant's delay in the bank
        shortest = (numbers["delay"] - place).clamp(min=1.0)
        shortest = torch.where(hard, HARD["delay"][0], shortest)
        off = torch.arange(float(DELAYS))[:, None] - (numbers["delay"] - shortest)
        graded = ~hard & self._some(0.5)
        of_delay = -0.5 * (off / 4.0).square() * graded
        is_middle = torch.from_numpy(TIME_CONSTANTS == 1.0)
        excluded = exact & ~((off[:, None] == 0.0) & is_middle[:, None])
        of_constants = -0.5 * np.square(np.log(TIME_CONSTANTS) / CONSTANT_SPREAD)
        logarithms = of_delay[:, None] + torch.from_numpy(of_constants)[:, None]
        logarithms = logarithms + torch.where(excluded, -200.0, 0.0)
        prior = Prior(
            time_constants=(torch.from_numpy(TIME_CONSTANTS)[:, None] * constants).numpy(),
            shortest_delays=shortest.numpy(),
            log_probabilities=logarithms.numpy(),
            gain_spread=torch.where(exact, 1e-3, GAIN_SPREAD).numpy(),
        )
        return prior, known["gain_factor"]
