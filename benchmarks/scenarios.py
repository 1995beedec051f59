"""The cases that controllers are compared on, each with a name, in one place."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mptc_gym import Parameters


@dataclass(frozen=True)
class Scenario:
    """A plant, a set point and a length.

    Attributes
    ----------
    name
        Short name, for options and file names.
    title
        What it is, for headings.
    samples
        Length of a run, samples.
    arguments
        Arguments of the environment that are not its defaults.
    """

    name: str
    title: str
    samples: int
    arguments: dict[str, Any] = field(default_factory=dict)

    @property
    def parameters(self) -> Parameters:
        """All arguments of the environment."""
        return Parameters(**self.arguments)


# The text of the paper gives the plants and not the set point, which only its figures show. Two
# are used here: the environment's square wave between +5 and -5 degC, 300 samples each, over
# two periods; and a step to 5 degC that is held.
_PLANTS: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("", "dead zone 5 t/h, no noise (Figs 5 and 10)", {}),
    ("-dead-zone-7", "dead zone 7 t/h, no noise (Figs 6 and 7)", {"dead_zone": 7.0}),
    ("-noise", "dead zone 5 t/h, R = 0.5 °C² (Figs 8, 9 and 11)", {"noise_variance": 0.5}),
)
_SETPOINTS: tuple[tuple[str, str, int, dict[str, Any]], ...] = (
    ("square", "square wave", 1200, {}),
    ("constant", "constant set point", 600, {"setpoint": 5.0}),
)

SCENARIOS: dict[str, Scenario] = {
    setpoint + plant: Scenario(
        name=setpoint + plant,
        title=f"{setpoint_title}, {plant_title}",
        samples=samples,
        arguments={**plant_arguments, **setpoint_arguments},
    )
    for setpoint, setpoint_title, samples, setpoint_arguments in _SETPOINTS
    for plant, plant_title, plant_arguments in _PLANTS
}


def other_plant(
    *, delay: int = 18, gain: float = 1.0, time_constant: float = 1.0
) -> dict[str, Any]:
    """Return the environment's arguments for a relative of the paper's plant.

    Parameters
    ----------
    delay
        d, samples.
    gain
        Steady-state gain, as a multiple of the paper's.
    time_constant
        Dominant time constant, as a multiple of the paper's; the gain does not follow it.

    Returns
    -------
    dict
        `a`, `b` and `delay`.
    """
    nominal = Parameters()
    poles = np.roots(nominal.a)  # real, 0.95 and -0.50
    slow = np.argmax(poles)
    poles[slow] **= 1.0 / time_constant  # a pole p decays as exp(-k / time constant)
    a = np.poly(poles)
    b = np.array(nominal.b) * gain * a.sum() / sum(nominal.a)
    return {"a": a.tolist(), "b": b.tolist(), "delay": delay}
