"""Compute the variance of the best prediction of a plant's output from readings.

A Kalman filter gives the covariance of the plant's state, given the transmitter's readings up
to a sample. The covariance of the state determines the variance of the best prediction of the
output.
"""

import numpy as np
from numpy.typing import NDArray

from benchmarks.loop.linear import LinearModel

Array = NDArray[np.float64]


def noise_variance(model: LinearModel) -> Array:
    """Return the error variances of the best output predictions, degC^2, shape (samples,).

    The best prediction of the output y(k) uses the transmitter's readings up to the sample
    k - lag, where lag is `model.lag`. `model` is a plant at the samples k = 0, 1, ... of an
    episode. The load of the plant counts as 0.
    """
    F, g = model.state_space()
    Q = np.broadcast_to(model.numbers.noise_variance * np.outer(g, g), F.shape)
    filtered = np.zeros_like(F)  # Readings without noise show the state exactly.
    if model.numbers.measurement_noise_variance > 0.0:
        filtered = filtered_covariance(F, Q, model.numbers.measurement_noise_variance)
    return predicted_variance(filtered, F, Q, model.lag)


def filtered_covariance(F: Array, Q: Array, reading_variance: float) -> Array:
    """Return the covariances of the state x(k), given all readings up to k (Kalman filter).

    Parameters
    ----------
    F, Q
        Matrices of the state equation x(k) = F(k) x(k-1) + v(k), shape (samples, size, size),
        where x(0) = 0 and v(k) is white noise with the covariance matrix Q(k).
    reading_variance
        Variance of the white noise in a reading of the first element of x(k), degC^2.

    Returns
    -------
    ndarray
        Covariances of the state x(k), given all readings up to k, shape (samples, size, size).
    """
    filtered = np.zeros_like(F)
    P = filtered[0]  # 0, as the state x(0) is known
    for k in range(1, len(F)):
        P = F[k] @ P @ F[k].T + Q[k]
        # The reading is that of element 0.
        P = P - np.outer(P[:, 0], P[0]) / (P[0, 0] + reading_variance)
        filtered[k] = P
    return filtered


def predicted_variance(filtered: Array, F: Array, Q: Array, lag: int) -> Array:
    """Return the variance of the output y(k), given the readings up to k - lag, degC^2.

    Parameters
    ----------
    filtered
        Covariances of the state x(k), given the readings up to k, shape (samples, size, size).
    F, Q
        Matrices of the state equation x(k) = F(k) x(k-1) + v(k), shape (samples, size, size),
        where the first element of x(k) is y(k), and v(k) is white noise with the covariance
        matrix Q(k).
    lag
        Number of samples from the last known reading to the predicted output.

    Returns
    -------
    ndarray
        Variances of the output y(k), given the readings up to k - lag, degC^2, shape
        (samples,). For k below `lag`, y(k) is predicted from the state x(0), which is known.
    """
    samples = len(F)
    steps = min(lag, samples)
    # Predictions of the outputs y(k) at all samples k advance together, from `sample` = k - lag
    # to k.
    sample = np.arange(samples) - steps
    P = filtered[np.maximum(sample, 0)]
    for _ in range(steps):
        sample = sample + 1
        from_start = np.maximum(sample, 0)
        advanced = F[from_start] @ P @ F[from_start].transpose(0, 2, 1) + Q[from_start]
        has_begun = sample >= 1  # the step to k = 1 is the first, from the known x(0)
        P = np.where(has_begun[:, np.newaxis, np.newaxis], advanced, P)
    # Rounding errors can make a variance of 0 negative.
    return np.maximum(P[:, 0, 0], 0.0)
