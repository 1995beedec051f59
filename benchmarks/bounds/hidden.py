"""Estimate how much the least possible error grows because no controller measures the load.

The bounds of `least.py` assume that the load is known up to the sample k - d - 1, where d is
the plant's delay. A real controller has only the transmitter's readings, in which noise hides
the load. No lower bound is known for controllers that have only readings, so this module
estimates their least possible error. Reports show the estimate as "hidden load".

The estimate is the bound plus the increase of the least possible error from a known load to a
hidden load, for a load that is normally distributed with the variances and correlations of the
real load. With a normal load, the unknown part of the output y(k) is normal, and a Kalman
filter gives the variance of this part. A load that jumps causes smaller errors than a normal
load with the same variance, but most of this difference cancels when the two least possible
errors are subtracted.
"""

import numpy as np
from numpy.typing import NDArray

from benchmarks.bounds.linear_program import ErrorBounds
from benchmarks.bounds.prediction import (
    filtered_covariance,
    noise_covariance,
    predicted_variance,
)
from benchmarks.bounds.unknown import bounds_for_normal
from benchmarks.loop.linear import LOAD_STEPS, LinearModel
from mptc_gym.plant.signals import LOAD_INTERVAL

Array = NDArray[np.float64]


def bounds_with_known_load(model: LinearModel) -> ErrorBounds:
    """Return the lower bounds of the mean errors at k for a load that is known up to k - d - 1.

    Here d is the plant's delay, and the load is taken to be normal. `model` is the plant, for
    the samples k = 0, 1, ... of an episode.
    """
    F, Q = _with_load(model)
    filtered = np.zeros_like(F)  # A known load has no variance.
    filtered[:, :LOAD_STEPS, :LOAD_STEPS] = noise_covariance(model)
    return bounds_for_normal(predicted_variance(filtered, F, Q, model.lag))


def bounds_with_hidden_load(model: LinearModel) -> ErrorBounds:
    """Return the lower bounds of the mean errors at k for readings up to k - d - 1 alone.

    Here d is the plant's delay, and the load is unknown and taken to be normal. `model` is the
    plant, for the samples k = 0, 1, ... of an episode.
    """
    F, Q = _with_load(model)
    filtered = filtered_covariance(F, Q, model.numbers.measurement_noise_variance)
    return bounds_for_normal(predicted_variance(filtered, F, Q, model.lag))


def _with_load(model: LinearModel) -> tuple[Array, Array]:
    """Return F(k) and Q(k) of x(k) = F(k) x(k-1) + v(k) for a plant with a normal load.

    The state x(k) is the state of `LinearModel.state_space_with_load`, and v(k) is white with
    the covariance Q(k). F and Q have the shape (samples, size, size).
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
