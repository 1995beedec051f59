"""Describe plants to a teacher, by numbers that a policy cannot see."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from mptc_gym.parameters import PLANT_NUMBERS, Parameters, PlantNumbers, slowest_pole
from mptc_gym.plant import DRIFT_INTERVAL, Dynamics


class PlantState(NamedTuple):
    """What a teacher may know of n plants at the present sample.

    Each field has the shape (n,). The fields are NumPy arrays of float64, or tensors of the
    type and on the device of the environment.
    """

    delay: Any  # samples
    dead_zone: Any  # half width, t/h
    gain: Any  # in the steady state, degC per t/h
    time_constant: Any  # the dominant time constant, s; NaN if A of (28) has none
    load: Any  # w, degC


def plant_state(
    parameters: Parameters, numbers: Mapping[str, Any], ages: Any, load: Any
) -> PlantState:
    """Return the state of n plants at the present sample.

    Parameters
    ----------
    parameters
        The arguments of the plants.
    numbers
        The numbers that were drawn for the arguments that are ranges, by name, shape (n,).
    ages
        The sample k of the episode of each plant, shape (n,).
    load
        The load w(k) of each plant, degC, shape (n,).
    """
    nominal = {name: parameters.range_of(name)[0] for name in PLANT_NUMBERS}
    plants: PlantNumbers[Any] = PlantNumbers(**{**nominal, **numbers})
    # Dynamics that drift change at samples that are multiples of the interval.
    changed_at = ages - ages % DRIFT_INTERVAL
    gain_factor, time_constant_factor = Dynamics(parameters).factors(plants, changed_at)
    zeros = load * 0.0
    return PlantState(
        delay=zeros + plants.delay,
        dead_zone=zeros + plants.dead_zone,
        gain=zeros + _nominal_gain(parameters) * gain_factor,
        time_constant=zeros + _nominal_time_constant(parameters) * time_constant_factor,
        load=zeros + load,
    )


def _nominal_gain(parameters: Parameters) -> float:
    """Return B(1) / A(1) of (28), degC per t/h; infinite for an integrating plant."""
    denominator = sum(parameters.a)
    return sum(parameters.b) / denominator if denominator else math.inf


def _nominal_time_constant(parameters: Parameters) -> float:
    """Return 1 / (1 - p) of the slowest pole p, s; NaN unless p is between 0 and 1."""
    pole = slowest_pole(parameters.a)
    if pole.imag != 0.0 or not 0.0 < pole.real < 1.0:
        return math.nan
    return parameters.sampling_interval / (1.0 - pole.real)
