"""Estimate how much the least possible error grows because no controller measures the load.

The bounds of `least.py` assume that the load is known up to the sample k - d - 1, where d is
the plant's delay. A real controller has only the transmitter's readings, in which noise hides
the load. No lower bound is known for controllers that have only readings, so this module
estimates their least possible error. Reports show the estimate as "hidden load".

The estimate is the bound plus a difference of two errors. Both errors are least possible errors
for a normally distributed load with the variances and correlations of the real load. With a
normal load, the unknown part of the output y(k) is normal, and a Kalman filter gives its
variance. The first error is for controllers that have only readings, and the second error is
for controllers that know the load up to k - d - 1. Both errors are too large for a load that
jumps, which is zero most of the time and large otherwise, but most of this excess cancels in
the difference.
"""

import numpy as np
from numpy.typing import NDArray

from benchmarks.bounds.linear_program import Unknown
from benchmarks.bounds.prediction import (
    filtered_covariance,
    noise_covariance,
    predicted_variance,
)
from benchmarks.bounds.unknown import unknown_of_normal
from benchmarks.loop.linear import LOAD_STEPS, LinearModel
from mptc_gym.plant.signals import LOAD_INTERVAL

Array = NDArray[np.float64]


def unknown_of_normal_load(model: LinearModel) -> Unknown:
    """Return the lower bounds of E|m(k) - n(k)| for a normal load that is known.

    The load is known up to k - d - 1, where d is the plant's delay. Here n(k) is the part of
    the output that is then unknown, and m(k) the error without n(k). `model` is the plant, for
    the samples of an episode.
    """
    F, Q = _with_load(model)
    filtered = np.zeros_like(F)  # A known load has no variance.
    filtered[:, :LOAD_STEPS, :LOAD_STEPS] = noise_covariance(model)
    return unknown_of_normal(predicted_variance(filtered, F, Q, model.lag))


def unknown_of_hidden_load(model: LinearModel) -> Unknown:
    """Return the lower bounds of E|m(k) - n(k)| for a normal load that cannot be measured.

    Only the transmitter's readings up to k - d - 1 are known, where d is the plant's delay.
    Here n(k) is the part of the output that is then unknown, and m(k) the error without n(k).
    `model` is the plant, for the samples of an episode.
    """
    F, Q = _with_load(model)
    filtered = filtered_covariance(F, Q, model.numbers.measurement_noise_variance)
    return unknown_of_normal(predicted_variance(filtered, F, Q, model.lag))


def _with_load(model: LinearModel) -> tuple[Array, Array]:
    """Return F(k) and Q(k) of x(k) = F(k) x(k-1) + v(k) for a plant with a normal load.

    The state x(k) is that of `LinearModel.state_space_with_load`, and v(k) is white with the
    covariance Q(k). F and Q have the shape (samples, size, size), for the samples of `model`.
    """
    numbers = model.numbers
    k = np.arange(len(model.load))
    is_change = (k % LOAD_INTERVAL == 0) & (k > 0)
    jump_probability = min(1.0, LOAD_INTERVAL / numbers.disturbance_interval)
    # The mean of the piecewise constant part at k, as a share of its value at k - 1.
    stays = np.where(is_change, 1.0 - jump_probability, 1.0)
    # The piecewise constant part is 0 until its first jump, and uniformly distributed after it.
    probability_of_jump_before = 1.0 - np.cumprod(stays)
    level_variance = probability_of_jump_before * numbers.disturbance_amplitude**2 / 3.0
    previous_variance = np.append(0.0, level_variance[:-1])
    step_variance = level_variance - np.square(stays) * previous_variance
    walk_variance = is_change * LOAD_INTERVAL * numbers.disturbance_walk_variance
    noise_variance = np.full(len(k), numbers.noise_variance)
    variances = np.stack([noise_variance, step_variance, walk_variance], axis=1)
    F, E = model.state_space_with_load(stays)
    return F, np.einsum("kv,kiv,kjv->kij", variances, E, E)
