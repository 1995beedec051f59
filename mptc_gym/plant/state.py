"""Return quantities of plants that a policy cannot observe, for use in training."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

from mptc_gym.plant.dynamics import DRIFT_INTERVAL, Dynamics
from mptc_gym.plant.parameters import Parameters, PlantNumbers, slowest_pole


class PlantState(NamedTuple):
    """Quantities of n plants that a policy cannot observe, such as the delay, for training.

    Each field is a NumPy array of float64, or a PyTorch tensor with the environment's data type
    and on the environment's device, of shape (n,).
    """

    delay: Any  # samples
    dead_zone: Any  # half width, t/h
    gain: Any  # in the steady state, degC per t/h
    # The dominant time constant, s; NaN if the plant's slowest pole is not between 0 and 1.
    time_constant: Any
    load: Any  # w, degC


def plant_state(
    parameters: Parameters, numbers: Mapping[str, Any], ages: Any, load: Any
) -> PlantState:
    """Return delay, dead zone, gain, time constant and load of n plants at the present sample.

    Each returned quantity has the shape (n,), and is an array or a tensor, as `load` is.

    Parameters
    ----------
    parameters
        The arguments of the environment.
    numbers
        Parameter values that the latest resets sampled for the arguments that are ranges:
        arrays or tensors of shape (n,), by name of the argument.
    ages
        Number of samples since the start of each plant's episode, shape (n,).
    load
        Load disturbance w(k) of each plant, degC, shape (n,).
    """
    plants: PlantNumbers[Any] = replace(parameters.lowest, **numbers)
    # A gain or time constant that drifts changes only at samples that are multiples of
    # `DRIFT_INTERVAL`.
    changed_at = ages - ages % DRIFT_INTERVAL
    gain_factor, time_constant_factor = Dynamics(parameters).factors(plants, changed_at)
    zeros = load * 0.0  # to give each field the shape and type of the load
    return PlantState(
        delay=zeros + plants.delay,
        dead_zone=zeros + plants.dead_zone,
        gain=zeros + _nominal_gain(parameters) * gain_factor,
        time_constant=zeros + _nominal_time_constant(parameters) * time_constant_factor,
        load=zeros + load,  # a copy
    )


def _nominal_gain(parameters: Parameters) -> float:
    """Return the steady-state gain of `a` and `b`, degC per t/h; inf if `a` sums to 0."""
    denominator = sum(parameters.a)
    return sum(parameters.b) / denominator if denominator else math.inf


def _nominal_time_constant(parameters: Parameters) -> float:
    """Return the dominant time constant in s: 1 / (1 - p) samples for the slowest pole p.

    The returned time constant is NaN unless the slowest pole is real and between 0 and 1.
    """
    pole = slowest_pole(parameters.a)
    if pole.imag != 0.0 or not 0.0 < pole.real < 1.0:
        return math.nan
    return parameters.sampling_interval / (1.0 - pole.real)
