"""Estimate how much the least possible error grows as no controller can measure the load.

The bounds of `least.py` assume that the load disturbance is known up to the sample k - d - 1,
where d is the plant's delay. A real controller has only the transmitter's readings, in which
noise hides the load. No lower bound is known for controllers with readings alone, so their
least possible error is estimated. Reports show the estimate as "hidden load" beside the bound.

The estimate replaces the load by a normal process with the same variances and correlations.
Then the unknown part of the output y(k) is normal, with a variance that a Kalman filter gives,
and the least possible error follows as in `linear_program.py`. The least possible error is
computed for a normal load that is known up to k - d - 1, and for readings alone. The difference
of the two errors is added to the bound. Both errors are too large for a load that jumps, which
is zero most of the time and large otherwise; most of this excess cancels in the difference.
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
from mptc_gym.plant.signals import LOAD_INTERVAL

Array = NDArray[np.float64]

# Places of the two parts of the load, the piecewise constant part and the random walk, in the
# state vector.
STEPS, WALK = -2, -1


def unknown_of_normal_load(model: LinearModel) -> Unknown:
    """Return the bounds of E|m(k) - n(k)| for a normal load that is known up to k - d - 1.

    Here d is the plant's delay, n(k) the part of the output that is unknown at k - d - 1, and
    m(k) the error without n(k). `model` is the plant, for the samples of an episode.
    """
    F, Q = _with_load(model)
    filtered = np.zeros_like(F)  # a known load has no variance
    if model.numbers.measurement_noise_variance > 0.0:
        filtered[:, :STEPS, :STEPS] = filtered_covariance(
            *noise_system(model), model.numbers.measurement_noise_variance
        )
    return unknown_of_normal(predicted_variance(filtered, F, Q, model.lag))


def unknown_of_hidden_load(model: LinearModel) -> Unknown:
    """Return the bounds of E|m(k) - n(k)| for a normal load and a controller with readings.

    Only the transmitter's readings up to k - d - 1 are known, where d is the plant's delay.
    Here n(k) is the part of the output that is then unknown, and m(k) the error without n(k).
    `model` is the plant, for the samples of an episode.
    """
    F, Q = _with_load(model)
    filtered = filtered_covariance(F, Q, model.numbers.measurement_noise_variance)
    return unknown_of_normal(predicted_variance(filtered, F, Q, model.lag))


def _with_load(model: LinearModel) -> tuple[Array, Array]:
    """Return F(k) and Q(k) of a state-space form of the plant with its load disturbance.

    The state is x(k) = F(k) x(k-1) + v(k), where v(k) is white with the covariance Q(k). The
    first elements of x(k) are a state of equation (28) of the paper, the output first. The last
    two elements are the piecewise constant part and the random walk of the load, degC, whose
    sum is the load. F and Q have the shape (samples, size, size), for the samples of `model`.
    """
    numbers = model.numbers
    F_noise, Q_noise = noise_system(model)
    samples = len(F_noise)
    size = F_noise.shape[-1] + 2
    k = np.arange(samples)
    is_change = (k % LOAD_INTERVAL == 0) & (k > 0)
    jump = min(1.0, LOAD_INTERVAL / numbers.disturbance_interval)  # probability
    # The mean of the piecewise constant part at k, as a share of its value at k - 1.
    stays = np.where(is_change, 1.0 - jump, 1.0)

    F = np.zeros((samples, size, size))
    F[:, :STEPS, :STEPS] = F_noise
    F[:, STEPS, STEPS] = stays
    F[:, WALK, WALK] = 1.0
    F[:, 0, STEPS] = model.load * stays
    F[:, 0, WALK] = model.load

    # The piecewise constant part is 0 until its first jump, and uniformly distributed after it.
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
