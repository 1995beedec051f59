"""The cases that controllers are compared on, each with a name, in one place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from mptc_gym import PRESETS, Parameters


@dataclass(frozen=True)
class Scenario:
    """A plant, a set point and a length."""

    name: str
    """For options and file names."""
    title: str
    """For headings."""
    samples: int
    """Length of a run."""
    arguments: dict[str, Any] = field(default_factory=dict)
    """Arguments of the environment that are not its defaults."""

    @property
    def parameters(self) -> Parameters:
        """All arguments of the environment."""
        return Parameters(**self.arguments)


# The text of the paper gives the plants and not the set point, which only its figures show. Two
# are used here: the environment's square wave between +5 and -5 degC, 300 samples each, over
# two periods; and a step to 5 degC that is held.
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
    # What a boiler does all day. At 5 degC the flow that is needed stays outside the dead zone.
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
    """Return the cases of a plant that is not the paper's, given its name and arguments.

    They are the set points of the paper's cases on this plant; or, if the arguments say what
    the set point is, one case with theirs.
    """
    own = {"setpoint", "setpoint_amplitude", "setpoint_period"} & set(arguments)
    cases = [("run", "its own set point", 1200, {})] if own else SETPOINTS
    return {
        setpoint: Scenario(setpoint, f"{title}, {name}", samples, {**arguments, **more})
        for setpoint, title, samples, more in cases
    }
