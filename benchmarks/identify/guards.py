"""Say why no controller should be tuned on a model."""

from __future__ import annotations

import numpy as np

from benchmarks.identify.armax import Array
from benchmarks.identify.model import Model
from benchmarks.identify.plant import settling
from benchmarks.lib.statistics import ENDS

LAGS = 40  # largest lag of the autocorrelation, samples


def doubts(model: Model, longest_delay: int) -> list[str]:
    """Return why no controller should be tuned on a model, a sentence each; none if it may.

    `longest_delay` is the longest that was looked for, samples.
    """
    share, rival = model.held_out
    gain, constant = model.estimates["gain"], model.estimates["time_constant"]
    outside = [name for name, (value, low, high) in model.estimates.items()
               if not low <= value <= high]  # fmt: skip
    # Autocorrelations that are larger than chance allows, and large enough to matter.
    large = np.mean(np.abs(autocorrelation(model.errors)) > max(0.1, chance(model.errors)))
    found = [
        (bool(model.fault), model.fault and f"{model.fault.what} {model.fault.advice}"),
        (gain.low < 0.0 < gain.high,
         "Not even the direction is known in which the temperature answers the flow. Move the "
         "flow to and fro a dozen times, further than here, and hold it until the temperature "
         "has settled."),
        (model.estimates["delay"].high >= longest_delay - 1,
         f"The delay may be longer than was looked for, {longest_delay} samples: try a longer "
         "--longest-delay, or a longer sampling interval."),
        (share < 0.5,
         "The model leaves more than half open: the noise hides the response, or it changes. "
         "Move the flow further, and look for other inputs (--disturbance)."),
        # An impulse response has fewer assumptions, and more noise: 2 % of the variance.
        (1.0 - rival < 0.5 * (1.0 - share) - 0.02,
         "The model leaves more than twice as much open as an impulse response: its form does "
         "not fit. Make a test with steps that are held until the temperature has settled."),
        (bool(outside) or not constant.low <= constant.high < np.inf,
         f"The most likely {' and '.join(outside).replace('_', ' ')} lies outside its own "
         "interval: the log supports several models that differ. Record a longer log."),
        (outside_band(model) > 0.1,
         "More than a tenth of the model's step response is outside its own band: the log "
         "supports several models that differ. Record a longer log."),
        (large > 0.25,
         f"The prediction errors are far from white ({100 * large:.0f} % of their "
         "autocorrelations are large): the plant or its disturbances are not of the model's "
         "form."),
    ]  # fmt: skip
    return [str(sentence) for holds, sentence in found if holds]


def chance(errors: Array) -> float:
    """Return what 95 % of the autocorrelations of white noise stay below."""
    return 1.96 / float(np.sqrt(np.isfinite(errors).sum()))


def autocorrelation(errors: Array) -> Array:
    """Return the autocorrelation of prediction errors at lags 1 to `LAGS`."""
    known = np.isfinite(errors)
    centred = np.where(known, errors - np.mean(errors[known]), 0.0)
    whole: Array = np.correlate(centred, centred, "full")[len(centred) - 1 :]
    lags: Array = whole[1 : LAGS + 1] / max(whole[0], 1e-300)
    return lags


def band(model: Model, samples: int) -> tuple[Array, Array]:
    """Return the ends of the step response's 95 % band."""
    possible = np.array([plant.step_response(samples) for plant in model.possible])
    low, high = np.quantile(possible, ENDS, axis=0)
    return low, high


def outside_band(model: Model) -> float:
    """Return the share of the step response that lies outside its own band."""
    samples = settling(model.plant)
    response = model.plant.step_response(samples)
    low, high = band(model, samples)
    slack = 0.01 * np.max(np.abs(response))
    return float(np.mean((response < low - slack) | (response > high + slack)))
