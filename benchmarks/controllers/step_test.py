"""What a step test shows of a plant: its gain, its time constant and its delay."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from benchmarks.scenarios import plain
from mptc_gym import Parameters
from mptc_gym.parameters import PLANT_NUMBERS

Array = NDArray[np.float64]

LEVELS = 0.283, 0.632  # shares of the final value, at a third of T and at T after the delay
SETTLED = 1e-5  # share of a transient that is left where the test ends
LONGEST = 1_000_000  # samples; a plant that needs more has no steady state to wait for


@dataclass(frozen=True)
class StepTest:
    """A model of first order with delay. The fields are arguments of SIMC and of Smith.

    Attributes
    ----------
    gain
        Steady-state gain, degC per t/h.
    time_constant
        s.
    delay
        s. The sample that any input takes to show is part of it.
    sampling_interval
        s.
    """

    gain: float
    time_constant: float
    delay: float
    sampling_interval: float


def step_test(parameters: Parameters) -> StepTest:
    """Return what a step of the flow would show an engineer of a plant.

    The time constant and the delay follow from the times at which the response has come to
    28.3 % and 63.2 % of its final value: T = 1.5 (t_63 - t_28), and the delay is t_63 - T (C.
    L. Smith, "Digital Computer Process Control", 1972). As they would be read off a chart, the
    gain has four digits, the time constant three, and the delay is a whole number of samples.

    Parameters
    ----------
    parameters
        The plant's. A range stands for its middle, and a plant that drifts is tested at k = 0.
        The flow moves outside the dead zone, and noise and load disturbances average out.

    Raises
    ------
    ValueError
        If the plant is not stable, so that it comes to no new steady state, or if its gain is
        0.
    """
    tested = nominal(parameters)
    response = step_response(tested)
    interval = tested.sampling_interval
    early, late = (_first_reached(response / response[-1], level) for level in LEVELS)
    time_constant = 1.5 * (late - early)
    # What is sampled shows an input of u(k) at y(k + 1) at the earliest.
    delay = max(1, round(late - time_constant + 1.0))
    gain = sum(tested.b) / sum(tested.a)
    return StepTest(
        gain=float(f"{gain:.4g}"),
        time_constant=float(f"{time_constant * interval:.3g}"),
        delay=delay * interval,
        sampling_interval=interval,
    )


def nominal(parameters: Parameters) -> Parameters:
    """Return (28) and (29) of a plant: ranges at their middle, no drift and no disturbance.

    Gain and time-constant factors are worked into A and B.
    """
    middle: dict[str, Any] = {
        name: sum(parameters.range_of(name)) / 2 for name in PLANT_NUMBERS
    }
    middle["delay"] = round(middle["delay"])
    undisturbed = {
        "measurement_noise_variance": 0.0,
        "disturbance_amplitude": 0.0,
        "disturbance_walk_variance": 0.0,
        "gain_drift": 1.0,
        "time_constant_drift": 1.0,
    }
    return plain(replace(parameters, **{**middle, **undisturbed}))


def step_response(parameters: Parameters, samples: int | None = None) -> Array:
    """Return y(0), y(1), ... after a step of u_a from 0 to 1 t/h at k = 0, degC per t/h.

    Parameters
    ----------
    parameters
        The plant's, without ranges and factors.
    samples
        How many; None for as many as the response takes to settle.

    Raises
    ------
    ValueError
        If it never settles, or settles at 0, and `samples` is None.
    """
    delay = int(parameters.range_of("delay")[0])
    if samples is None:
        slowest = float(np.max(np.abs(np.roots(parameters.a)), initial=0.0))
        if sum(parameters.b) == 0.0:
            raise ValueError(f"b must have a sum other than 0 for a gain, got {parameters.b}")
        settling = math.log(SETTLED) / math.log(slowest) if 0.0 < slowest < 1.0 else 0.0
        if slowest >= 1.0 or settling > LONGEST:
            raise ValueError(f"a must be of a stable plant for a step test, got {parameters.a}")
        # Some more for poles that are repeated, whose transients last longer.
        samples = delay + len(parameters.b) + 2 * math.ceil(settling) + 2
    response: Array = signal.lfilter(
        [0.0] * (delay + 1) + list(parameters.b), parameters.a, np.ones(samples)
    )
    return response


def _first_reached(response: Array, level: float) -> float:
    """Return when a response first comes to a level, in samples, by a line between them."""
    k = int(np.argmax(response >= level))
    before, after = response[k - 1], response[k]
    return float(k - 1 + (level - before) / (after - before))
