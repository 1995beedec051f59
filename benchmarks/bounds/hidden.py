"""Estimate the least possible error of controllers that cannot measure the load.

A lower bound that `least.py` computes for the error at sample k holds for controllers that know
the load up to the sample k - d - 1. Here, d + 1 is `LinearModel.lag`, the number of samples
from a flow to its first effect on the output. A real controller has only the transmitter's
readings, in which noise hides the load. No lower bound is known for controllers that have only
readings, so this module estimates the least possible error of these controllers. The command
`python -m benchmarks.bounds` prints the estimate in the column "hidden load (estimate)".

The estimate for a hidden load is the least possible error with a known load, plus the increase
of the least possible error from a known load to a hidden load. The increase of the least
possible error is computed for a normally distributed load that has the variances and
correlations of the real load. With a normal load, the part of the output y(k) that is unknown
when the last flow that can affect y(k) is chosen is normally distributed, and a Kalman filter
gives the variance of this part. A load that jumps causes smaller errors than a normal load with
the same variance, but most of this difference cancels when the least possible error with a
known load is subtracted from the least possible error with a hidden load.
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
    """Return lower bounds of the mean errors of a controller that knows the past load.

    The lower bound at sample k holds if the controller knows the load up to sample k - d - 1,
    where d + 1 is `model.lag`, and if the load is normally distributed. `model` is
    the plant at the samples k = 0, 1, ... of an episode.
    """
    F, Q = _with_load(model)
    filtered = np.zeros_like(F)  # The variance of a known load is 0.
    filtered[:, :LOAD_STEPS, :LOAD_STEPS] = noise_covariance(model)
    return bounds_for_normal(predicted_variance(filtered, F, Q, model.lag))


def bounds_with_hidden_load(model: LinearModel) -> ErrorBounds:
    """Return lower bounds of the mean errors if only the transmitter's readings are known.

    The lower bound at sample k holds if the controller knows the readings up to sample
    k - d - 1, where d + 1 is `model.lag`, and if the load is normally distributed.
    `model` is the plant at the samples k = 0, 1, ... of an episode.
    """
    F, Q = _with_load(model)
    filtered = filtered_covariance(F, Q, model.numbers.measurement_noise_variance)
    return bounds_for_normal(predicted_variance(filtered, F, Q, model.lag))


def _with_load(model: LinearModel) -> tuple[Array, Array]:
    """Return the matrices F(k) and Q(k) of the state equation of a plant with its load.

    The load is replaced by a normally distributed load with the same variances.

    The state equation is x(k) = F(k) x(k-1) + v(k), where x(k) is the state of
    `LinearModel.state_space_with_load`, and v(k) is white noise with the covariance matrix
    Q(k). The two returned arrays have the shape (samples, size, size), where size is the length
    of the state x(k).
    """
    numbers = model.numbers
    k = np.arange(len(model.load_factor))
    is_change = (k % LOAD_INTERVAL == 0) & (k > 0)
    jump_probability = min(1.0, LOAD_INTERVAL / numbers.disturbance_interval)
    # The probability that the piecewise constant part of the load does not jump at sample k.
    no_jump_probability = np.where(is_change, 1.0 - jump_probability, 1.0)
    # The piecewise constant part of the load is 0 until the first jump, and uniformly
    # distributed after the first jump.
    probability_of_jump_before = 1.0 - np.cumprod(no_jump_probability)
    level_variance = probability_of_jump_before * numbers.disturbance_amplitude**2 / 3.0
    previous_variance = np.append(0.0, level_variance[:-1])
    step_variance = level_variance - np.square(no_jump_probability) * previous_variance
    walk_variance = is_change * LOAD_INTERVAL * numbers.disturbance_walk_variance
    noise_variance = np.full(len(k), numbers.noise_variance)
    # Variances of the three inputs of the state equation: the white noise of the plant, the
    # jumps of the load and the steps of the load's random walk.
    variances = np.stack([noise_variance, step_variance, walk_variance], axis=1)
    F, E = model.state_space_with_load(no_jump_probability)
    return F, np.einsum("kv,kiv,kjv->kij", variances, E, E)
