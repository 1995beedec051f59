"""The plant of one episode as the bounds see it: known coefficients, one row a sample."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mptc_gym import Parameters
from mptc_gym.parameters import PlantNumbers
from mptc_gym.plant import DRIFT_INTERVAL, Dynamics

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Course:
    """What (28) and (29) are at each sample of an episode.

    y(k) = sum_i alpha[k, i] y(k-1-i) + sum_i beta[k, i] u_a(k-d-1-i) + C xi(k) + load[k] w(k).

    Attributes
    ----------
    alpha, beta
        Shapes (samples, order of A) and (samples, length of B).
    c
        Coefficients of C, from z^0 on.
    load
        A(1), shape (samples,).
    delay
        d, samples.
    low, high
        The least and the greatest flow that the actuator can apply, t/h. It can apply 0, even
        if the limits exclude it, if there is a dead zone.
    numbers
        The plant numbers of the episode.
    """

    alpha: Array
    beta: Array
    c: tuple[float, ...]
    load: Array
    delay: int
    low: float
    high: float
    numbers: PlantNumbers[float]

    @property
    def lag(self) -> int:
        """Samples from a flow to the first output that it can show in."""
        shows = np.flatnonzero(self.beta.any(axis=0))
        return self.delay + 1 + int(shows[0]) if len(shows) else len(self.beta)

    def first(self, samples: int) -> Course:
        """Return the same for the first samples."""
        rows = {name: getattr(self, name)[:samples] for name in ("alpha", "beta", "load")}
        return replace(self, **rows)

    def response(self) -> Array:
        """Return G, shape (samples, samples): what one t/h at j adds to y(k) is G[k, j]."""
        samples, order = self.alpha.shape
        G = np.zeros((samples, samples))
        for k in range(1, samples):
            for i in range(min(order, k)):
                G[k] += self.alpha[k, i] * G[k - 1 - i]
            for i, beta in enumerate(self.beta[k]):
                if k - self.delay - 1 - i >= 0:
                    G[k, k - self.delay - 1 - i] += beta
        return G


def course(parameters: Parameters, numbers: PlantNumbers[float], samples: int) -> Course:
    """Return the course of an episode.

    Parameters
    ----------
    parameters
        The environment's.
    numbers
        All plant numbers, as they were drawn.
    samples
        Length of the course.
    """
    dynamics = Dynamics(parameters)
    age = np.arange(samples) // DRIFT_INTERVAL * DRIFT_INTERVAL
    gain, time_constant = dynamics.factors(numbers, age)
    alpha, scale, load = dynamics.coefficients(gain, time_constant)
    ones = np.ones(samples)
    rest = [0.0] if numbers.dead_zone > 0.0 else []
    return Course(
        alpha=np.stack([ones * a for a in alpha], axis=1) if alpha else np.zeros((samples, 0)),
        beta=(ones * scale)[:, np.newaxis] * np.array(parameters.b),
        c=tuple(parameters.c),
        load=ones * load,
        delay=int(numbers.delay),
        low=min([numbers.u_min, *rest]),
        high=max([numbers.u_max, *rest]),
        numbers=numbers,
    )
