"""Read a gain, a time constant and a delay off the step response of a plant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.loop.linear import LinearModel, nominal
from mptc_gym import Parameters

Array = NDArray[np.float64]

LEVELS = 0.283, 0.632  # shares of the final value, at a third of T and at T after the delay


@dataclass(frozen=True)
class StepTest:
    """A first-order model with delay; its fields are arguments of SIMC and `SmithPredictor`."""

    gain: float
    """Steady-state gain, degC per t/h."""
    time_constant: float
    """Time constant, s."""
    delay: float
    """Delay, s, including the one sample that any input takes to show."""
    sampling_interval: float
    """Sampling interval, s."""


def step_test(parameters: Parameters) -> StepTest:
    """Return what an engineer would read off the plant's response to a step of the flow.

    The time constant and the delay follow from the times at which the response reaches 28.3 %
    and 63.2 % of its final value: T = 1.5 (t_63 - t_28), and the delay is t_63 - T (C. L.
    Smith, "Digital Computer Process Control", 1972). As if read off a chart, the gain has four
    digits, the time constant three, and the delay is a whole number of samples.

    A range is replaced by its middle, and a drifting plant is tested at k = 0. The flow moves
    outside the dead zone, and noise and load disturbances average out.

    Raises
    ------
    ValueError
        If the plant is not stable and so reaches no new steady state, or if its gain is 0.
    """
    return read_off(nominal(parameters))


def read_off(plant: LinearModel) -> StepTest:
    """Return what `step_test` returns, of a linear model."""
    response, interval = plant.step_response(), plant.sampling_interval
    early, late = (_first_reached(response / response[-1], level) for level in LEVELS)
    time_constant = 1.5 * (late - early)
    # In samples, u(k) shows at y(k + 1) at the earliest.
    delay = max(1, round(late - time_constant + 1.0))
    return StepTest(
        gain=float(f"{plant.gain:.4g}"),
        time_constant=float(f"{time_constant * interval:.3g}"),
        delay=delay * interval,
        sampling_interval=interval,
    )


def _first_reached(response: Array, level: float) -> float:
    """Return when a response first reaches a level, in samples, by linear interpolation."""
    k = int(np.argmax(response >= level))
    before, after = response[k - 1], response[k]
    return float(k - 1 + (level - before) / (after - before))
