"""Read a gain, a time constant and a delay off the step response of a plant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.loop.linear import nominal
from mptc_gym import Parameters

Array = NDArray[np.float64]

LEVELS = 0.283, 0.632  # shares of the final value, at a third of T and at T after the delay


@dataclass(frozen=True)
class StepTest:
    """A model of first order with delay. The fields are arguments of SIMC and of Smith."""

    gain: float
    """Steady-state gain, degC per t/h."""
    time_constant: float
    """s."""
    delay: float
    """s. The sample that any input takes to show is part of it."""
    sampling_interval: float
    """s."""


def step_test(parameters: Parameters) -> StepTest:
    """Return what a step of the flow would show an engineer of a plant.

    The time constant and the delay follow from the times at which the response has come to
    28.3 % and 63.2 % of its final value: T = 1.5 (t_63 - t_28), and the delay is t_63 - T (C.
    L. Smith, "Digital Computer Process Control", 1972). As they would be read off a chart, the
    gain has four digits, the time constant three, and the delay is a whole number of samples.

    A range stands for its middle, and a plant that drifts is tested at k = 0. The flow moves
    outside the dead zone, and noise and load disturbances average out.

    Raises
    ------
    ValueError
        If the plant is not stable, so that it comes to no new steady state, or if its gain is
        0.
    """
    tested = nominal(parameters)
    response = tested.step_response()
    interval = tested.sampling_interval
    early, late = (_first_reached(response / response[-1], level) for level in LEVELS)
    time_constant = 1.5 * (late - early)
    # What is sampled shows an input of u(k) at y(k + 1) at the earliest.
    delay = max(1, round(late - time_constant + 1.0))
    return StepTest(
        gain=float(f"{tested.gain:.4g}"),
        time_constant=float(f"{time_constant * interval:.3g}"),
        delay=delay * interval,
        sampling_interval=interval,
    )


def _first_reached(response: Array, level: float) -> float:
    """Return when a response first comes to a level, in samples, by a line between them."""
    k = int(np.argmax(response >= level))
    before, after = response[k - 1], response[k]
    return float(k - 1 + (level - before) / (after - before))
