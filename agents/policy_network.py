"""Run a trained feed-forward policy in NumPy alone."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from agents.actuator import compensate_dead_zone
from agents.controller import Controller, Values, check_count, check_limits, check_number
from agents.networks import ACTIVATIONS, Layers, check_array, check_layers, forward, reading

Array = NDArray[np.float64]

WINDOWS: Final = ("setpoint_window", "error_window", "output_window", "action_window")
_FORMAT = 1  # version of the file format


@dataclass(frozen=True)
class Increments:
    """Velocity form: the network's output changes the wanted flow, which is 0 at first."""

    max_move: float
    """Change of the wanted flow per sample at an output of 1, as a share of half the range."""
    dead_zone: float = 0.0
    """Half width of the dead zone to compensate, t/h; see `compensate_dead_zone`. If it is 0,
    the wanted flow is the command."""

    def __post_init__(self) -> None:
        check_number("max_move", self.max_move, 0)
        check_number("dead_zone", self.dead_zone, 0)


@dataclass(eq=False, kw_only=True)
class PolicyNetwork(Controller):
    """A feed-forward network from the latest observation to an action.

    The observation is multiplied by `input_scale` and passed through the layers. The activation
    follows every layer but the last, whose single output is clipped to [-1, 1]. This output is
    the action or, with `increments`, moves the wanted flow. The layers are run in float32, so a
    loop in a batch can differ from a single one by rounding; see `agents.networks.forward`.

    `u_min` and `u_max` are those of `Controller`.

    Parameters
    ----------
    layers
        Weights, shape (outputs, inputs), and biases, shape (outputs,), of each layer.
    observation
        The windows of the observation that the network expects, by the names of the
        environment's arguments: `setpoint_window`, `error_window`, `output_window`,
        `action_window`. A window that is not named is 0.
    input_scale
        Factor for each element of the observation; shape (n_obs,).
    activation
        Activation of the hidden layers: "elu", "relu", "silu" or "tanh".
    increments
        The velocity form, if the network was trained in it; otherwise None.
    provenance
        Origin of the weights, JSON-serialisable.
    """

    layers: Layers = field(repr=False, kw_only=False)
    observation: Mapping[str, int]
    input_scale: NDArray[np.floating[Any]] = field(repr=False)
    activation: str = "elu"
    increments: Increments | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.observation:
            if name not in WINDOWS:
                raise ValueError(f"observation must name {', '.join(WINDOWS)}, got {name!r}")
        self.observation = {
            name: check_count(f"observation[{name!r}]", self.observation.get(name, 0), 0)
            for name in WINDOWS
        }
        self.n_obs = sum(self.observation.values())
        if self.activation not in [*ACTIVATIONS]:  # a list: it may be unhashable
            raise ValueError(
                f"activation must be one of {[*ACTIVATIONS]}, got {self.activation!r}"
            )
        self._remembers = self.increments is not None
        self._edge = self.increments.dead_zone if self.increments else 0.0
        self.input_scale = check_array("input_scale", self.input_scale, (self.n_obs,))
        self.layers = check_layers(self.layers, self.n_obs, 1)
        self._flow: Values | None = None  # wanted, as a share of half the range

    @classmethod
    def load(
        cls, path: str | PathLike[str], *, u_min: float = -10.0, u_max: float = 10.0
    ) -> PolicyNetwork:
        """Read a network written by `save`; errors are those of `agents.networks.reading`.

        Limits that are not finite and in order are a ValueError, too.
        """
        check_limits(u_min, u_max)  # here: `reading` would report a damaged file
        with reading(path, "policy network") as file:
            about = json.loads(str(file["about"]))
            if about["format"] != _FORMAT:
                raise ValueError(f"its format is {about['format']!r}, not {_FORMAT}")
            increments = about["increments"]
            return cls(
                [(file[f"W{i}"], file[f"b{i}"]) for i in range(about["layers"])],
                observation=about["observation"],
                input_scale=file["input_scale"],
                activation=about["activation"],
                increments=None if increments is None else Increments(**increments),
                provenance=about["provenance"],
                u_min=u_min,
                u_max=u_max,
            )

    def save(self, path: str | PathLike[str]) -> None:
        """Write the network to a `.npz` file."""
        about = {
            "format": _FORMAT,
            "layers": len(self.layers),
            "observation": self.observation,
            "activation": self.activation,
            "increments": None if self.increments is None else asdict(self.increments),
            "provenance": self.provenance,
        }
        arrays: dict[str, Any] = {"about": json.dumps(about), "input_scale": self.input_scale}
        for i, (W, b) in enumerate(self.layers):
            arrays |= {f"W{i}": W, f"b{i}": b}
        with Path(path).open("wb") as file:
            np.savez_compressed(file, **arrays)

    def check_environment(self, parameters: Any, wrapped: str, n: int) -> None:
        """Refuse plants that the network was not made for; see `Controller`."""
        super().check_environment(parameters, wrapped, n)
        given = {name: getattr(parameters, name) for name in WINDOWS}
        if given != self.observation:
            raise ValueError(
                f"env must have the windows that policy wants, {self.observation}, got {given}"
            )

    def reset(self) -> None:
        """Forget the episode, which is the wanted flow in velocity form."""
        super().reset()
        self._flow = None

    def _control(self, observation: Array) -> Values:
        if observation.shape[-1] != self.n_obs:
            raise ValueError(
                f"observation must have {self.n_obs} elements, got {observation.shape[-1]}: "
                f"make the environment with the network's `observation`, {self.observation}"
            )
        outputs = forward(self.layers, self.activation, observation * self.input_scale)
        output: Values = np.clip(outputs[..., 0], -1.0, 1.0)
        half_range, lowest = (self.u_max - self.u_min) / 2.0, -1.0
        if self.increments is not None:
            lowest, highest = self.u_min / half_range, self.u_max / half_range
            before = 0.0 if self._flow is None else self._flow
            moved = before + self.increments.max_move * output
            self._flow = output = np.clip(moved, lowest, highest)
            if self._edge > 0.0:
                return compensate_dead_zone(output, self._edge, self.u_min, self.u_max)
        return self.u_min + (output - lowest) * half_range
