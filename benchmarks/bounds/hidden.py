"""Estimate what it adds to the least possible error that no controller sees the load.

The bounds assume that the load is known up to k - d - 1. A controller has only the readings of
the transmitter, in which noise hides the load. No bound is known that counts this, so it is
estimated, and reports show the estimate beside the bound under the name "hidden load".

The estimate treats the load as normal, with the variances and correlations that it has. Then
the unknown part of y(k) is normal, too, with a variance that the Kalman filter gives, and the
least possible error follows as in `linear_program.py`: once with the load known up to
k - d - 1, once with readings alone. The difference of the two errors is added to the bound.
Both errors are too large for a load that jumps, which is zero most of the time and large
otherwise; in their difference this cancels for the greater part.
"""

import numpy as np
from numpy.typing import NDArray

from benchmarks.bounds.linear_program import Unknown
from benchmarks.bounds.unknown import (
    filtered_covariance,
    noise_system,
    predicted_variance,
    unknown_of_normal,
)
from benchmarks.loop.linear import LinearModel
from mptc_gym.signals import LOAD_INTERVAL

Array = NDArray[np.float64]

STEPS, WALK = -2, -1  # places of the two parts of the load in the state


def unknown_of_normal_load(model: LinearModel) -> Unknown:
    """Return what remains unknown if the load is normal, and known up to k - d - 1."""
    F, Q = _with_load(model)
    filtered = np.zeros_like(F)  # a known load has no variance
    if model.numbers.measurement_noise_variance > 0.0:
        filtered[:, :STEPS, :STEPS] = filtered_covariance(
            *noise_system(model), model.numbers.measurement_noise_variance
        )
    return unknown_of_normal(predicted_variance(filtered, F, Q, model.lag))


def unknown_of_hidden_load(model: LinearModel) -> Unknown:
    """Return what remains unknown if the load is normal, and seen through readings alone."""
    F, Q = _with_load(model)
    filtered = filtered_covariance(F, Q, model.numbers.measurement_noise_variance)
    return unknown_of_normal(predicted_variance(filtered, F, Q, model.lag))


def _with_load(model: LinearModel) -> tuple[Array, Array]:
    """Return F(k) and Q(k) of the state of (28), followed by the load's steps and its walk.

    x(k) = F(k) x(k-1) + a noise with the covariance Q(k). Both have the shape (samples, size,
    size). The load, degC, is the sum of the steps and the walk.
    """
    numbers = model.numbers
    F_noise, Q_noise = noise_system(model)
    samples = len(F_noise)
    size = F_noise.shape[-1] + 2
    k = np.arange(samples)
    is_change = (k % LOAD_INTERVAL == 0) & (k > 0)
    jump = min(1.0, LOAD_INTERVAL / numbers.disturbance_interval)  # probability
    stays = np.where(is_change, 1.0 - jump, 1.0)  # mean of a level, as a share of the level

    F = np.zeros((samples, size, size))
    F[:, :STEPS, :STEPS] = F_noise
    F[:, STEPS, STEPS] = stays
    F[:, WALK, WALK] = 1.0
    F[:, 0, STEPS] = model.load * stays
    F[:, 0, WALK] = model.load

    # The level is 0 until the first jump, and uniform from then on.
    has_jumped = 1.0 - np.cumprod(stays)  # probability
    level_variance = has_jumped * numbers.disturbance_amplitude**2 / 3.0
    variance_before = np.append(0.0, level_variance[:-1])
    step_variance = level_variance - np.square(stays) * variance_before
    walk_variance = is_change * LOAD_INTERVAL * numbers.disturbance_walk_variance
    Q = np.zeros((samples, size, size))
    Q[:, :STEPS, :STEPS] = Q_noise
    for part, variance in ((STEPS, step_variance), (WALK, walk_variance)):
        enters = np.zeros((samples, size))  # how a change of this part enters the state
        enters[:, 0] = model.load
        enters[:, part] = 1.0
        Q += variance[:, np.newaxis, np.newaxis] * np.einsum("ki,kj->kij", enters, enters)
    return F, Q
