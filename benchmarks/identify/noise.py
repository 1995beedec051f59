"""Parts the noise of a log into what the environment has: (28), a walk, and a transmitter."""

from __future__ import annotations

import numpy as np

from benchmarks.identify.armax import Array
from benchmarks.identify.likelihood import Candidate

POINTS = 1024  # of the spectra
MOSTLY = 0.5  # share of the noise that is white in the temperature, to be the transmitter's
LENGTH = 3  # coefficients of C


def in_the_environment(a: Array, fit: Candidate) -> tuple[dict[str, float], tuple[float, ...]]:
    """Return the variances of the environment's noises, degC^2, and C.

    The noise of the fit is C' xi / (A (1 - z^-1)) with a walk, C xi / A without. The walk is
    what is left of it at frequency 0. Of the rest, the white part is the transmitter's noise if
    it is most of it, as (28) cannot tell the two apart otherwise.

    Returns
    -------
    dict, tuple of float
        `noise_variance`, `measurement_noise_variance` and `disturbance_walk_variance`, and C
        with its leading 1.
    """
    variance = fit.solution.square / max(len(fit.solution.errors) - fit.orders.count, 1)
    c = np.concatenate([[1.0], fit.solution.c])
    of_a = np.abs(np.fft.rfft(a, POINTS)) ** 2
    left = variance * np.abs(np.fft.rfft(c, POINTS)) ** 2
    walk = 0.0
    if fit.orders.walk:
        walk = float(variance * c.sum() ** 2 / a.sum() ** 2)
        step = np.abs(np.fft.rfft([1.0, -1.0], POINTS)) ** 2
        left = (left - left[0]) / np.maximum(step, 1e-12)
        left[0] = left[1]
        left = np.maximum(left, 1e-6 * float(np.mean(np.abs(left))))
    white = float(np.min(left / of_a))
    if white < MOSTLY * float(np.mean(left / of_a)):
        white = 0.0
    if white or fit.orders.walk:
        # The rest as C xi: the factor of its spectrum with all zeros inside the unit circle.
        left = np.maximum(left - white * of_a, 1e-4 * left)
        cepstrum = np.fft.irfft(np.log(left))
        variance = float(np.exp(cepstrum[0]))
        c = np.zeros(LENGTH + 1)
        c[0] = 1.0
        for i in range(1, LENGTH + 1):  # exp of the causal part, term by term
            c[i] = sum(j * cepstrum[j] * c[i - j] for j in range(1, i + 1)) / i
    noise = {
        "noise_variance": variance,
        "measurement_noise_variance": white,
        "disturbance_walk_variance": walk,
    }
    return noise, tuple(c.tolist())
