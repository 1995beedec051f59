"""Declare the paper's figures, and the cases that they show."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from mptc_gym import PRESETS, Parameters


@dataclass(frozen=True)
class Case:
    """What is run for one or more figures."""

    title: str
    arguments: dict[str, Any] = field(default_factory=dict)
    """Arguments of the environment."""
    nodes: int | None = 3
    """Hidden nodes of the network; None for the paper's PI controller."""


@dataclass(frozen=True)
class Figure:
    """One figure of the paper."""

    number: int
    case: str
    """What is run: a name in `CASES`."""
    signals: tuple[str, ...] = ("output",)
    """What it shows, from top to bottom: "output" stands for set point and temperature."""

    @property
    def title(self) -> str:
        """Its heading."""
        return f"Fig. {self.number}: {CASES[self.case].title}"

    @property
    def parameters(self) -> Parameters:
        """The plant's: dead zone and limits are drawn behind the command."""
        return Parameters(**CASES[self.case].arguments)


CASES = {
    "nn": Case("NN, dead zone 5 t/h, R = 0"),
    "nn_dead_zone": Case("NN, dead zone 7 t/h, R = 0", PRESETS["dead-zone-7"]),
    "nn_noise": Case("NN, dead zone 5 t/h, R = 0.5 °C²", PRESETS["noisy"]),
    "pi": Case("PI, dead zone 5 t/h, R = 0", nodes=None),
    "pi_noise": Case("PI, dead zone 5 t/h, R = 0.5 °C²", PRESETS["noisy"], nodes=None),
    "nn_six_nodes": Case("NN, six hidden nodes, dead zone 5 t/h, R = 0", nodes=6),
}
FIGURES = (
    Figure(5, "nn"),
    Figure(6, "nn_dead_zone"),
    Figure(7, "nn_dead_zone", ("command",)),
    Figure(8, "nn_noise"),
    Figure(9, "nn_noise", ("command", "noise")),
    Figure(10, "pi"),
    Figure(11, "pi_noise"),
    Figure(12, "nn_six_nodes"),
)
