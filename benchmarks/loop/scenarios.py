"""Define the cases on which controllers are compared."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from mptc_gym import PRESETS, Parameters


@dataclass(frozen=True)
class Scenario:
    """A plant, a set point and the length of a run."""

    name: str
    """Name in options and file names."""
    title: str
    """Title in headings."""
    samples: int
    """Length of a run, samples."""
    arguments: dict[str, Any] = field(default_factory=dict)
    """Arguments of the environment that differ from the defaults."""

    @property
    def parameters(self) -> Parameters:
        """All arguments of the environment."""
        return Parameters(**self.arguments)


# The text of the paper describes the plants; only its figures show the set point. Two set
# points are used here: the environment's square wave between +5 and -5 degC, 300 samples each,
# over two periods; and a step to 5 degC.
_PLANTS = (
    ("", "paper", "dead zone 5 t/h, no noise (Figs 5 and 10)"),
    ("-dead-zone-7", "dead-zone-7", "dead zone 7 t/h, no noise (Figs 6 and 7)"),
    ("-noise", "noisy", "dead zone 5 t/h, R = 0.5 °C² (Figs 8, 9 and 11)"),
)
SETPOINTS: tuple[tuple[str, str, int, dict[str, Any]], ...] = (
    ("square", "square wave", 1200, {}),
    ("constant", "constant set point", 600, {"setpoint": 5.0}),
)

SCENARIOS: dict[str, Scenario] = {
    setpoint + suffix: Scenario(
        name=setpoint + suffix,
        title=f"{setpoint_title}, {plant_title}",
        samples=samples,
        arguments={**PRESETS[preset], **arguments},
    )
    for setpoint, setpoint_title, samples, arguments in SETPOINTS
    for suffix, preset, plant_title in _PLANTS
} | {
    # A boiler's daily duty. At 5 degC the required flow stays outside the dead zone.
    "load": Scenario(
        "load",
        "load steps within ±1.5 °C at a held set point, dead zone 5 t/h, no noise",
        1200,
        {"setpoint": 5.0, "disturbance_amplitude": 1.5, "disturbance_interval": 200.0},
    )
}


PRESET_SCENARIOS: dict[str, Scenario] = {
    name: Scenario(name, f"preset {name}", 1200, dict(arguments))
    for name, arguments in PRESETS.items()
}


def scenarios_of(name: str, arguments: Mapping[str, Any]) -> dict[str, Scenario]:
    """Return the cases for another plant, given its name and arguments.

    They use the set points of the paper's cases, unless the arguments define a set point: then
    there is one case, with that set point.
    """
    own = {"setpoint", "setpoint_amplitude", "setpoint_period"} & set(arguments)
    cases = [("run", "its own set point", 1200, {})] if own else SETPOINTS
    return {
        setpoint: Scenario(setpoint, f"{title}, {name}", samples, {**arguments, **more})
        for setpoint, title, samples, more in cases
    }
