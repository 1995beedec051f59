"""Run trained feed-forward networks, policies among them, in NumPy alone.

Their files may come from untrusted sources: nothing in them is executed.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.actuator import compensate_dead_zone
from agents.controller import (
    Controller,
    Values,
    check_count,
    check_limits,
    check_number,
    check_numbers,
)

Array = NDArray[np.floating[Any]]
# Weights, shape (outputs, inputs), and biases, shape (outputs,), of each layer.
Layers = Sequence[tuple[Array, Array]]

WINDOWS: Final = ("setpoint_window", "error_window", "output_window", "action_window")
PRETRAINED: Final = Path(__file__).parent / "pretrained"  # networks that come with the project
LARGEST: Final = 2**26  # bytes of all arrays, unpacked: hundreds of times what a network needs
ACTIVATIONS: Final[Mapping[str, Callable[[Array], Array]]] = {
    "elu": lambda x: np.where(x > 0.0, x, np.expm1(np.minimum(x, 0.0))),
    "relu": lambda x: np.maximum(x, 0.0),
    "silu": lambda x: x * 0.5 * (1.0 + np.tanh(0.5 * x)),
    "tanh": np.tanh,
}


def forward(layers: Layers, activation: str, inputs: ArrayLike) -> NDArray[np.float64]:
    """Return outputs, shape (..., outputs), for inputs; the last layer has no activation.

    It is computed in float32, in which the networks were trained. BLAS rounds sums of a batch
    in another order than those of a single row, so that they can differ by some 1e-6.
    """
    x = np.asarray(inputs, np.float32)
    *hidden, (last_W, last_b) = layers
    for W, b in hidden:
        x = ACTIVATIONS[activation](x @ W.T + b)
    return (x @ last_W.T + last_b).astype(np.float64)


def check_array(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Return a copy in float32 if the shape fits and all is finite; otherwise a ValueError."""
    with np.errstate(over="ignore"):  # too large for float32 is infinite there, and refused
        array = np.array(check_numbers(name, value), np.float32)
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite")
    return array


def check_layers(layers: Layers, inputs: int, outputs: int) -> list[tuple[Array, Array]]:
    """Return the layers in float32 if each fits the one before it; otherwise a ValueError."""
    if not layers:
        raise ValueError("layers must hold at least one layer, got none")
    checked = []
    for i, (W, b) in enumerate(layers):
        nodes = np.size(b) if i < len(layers) - 1 else outputs
        weights = check_array(f"weights of layers[{i}]", W, (nodes, inputs))
        checked.append((weights, check_array(f"biases of layers[{i}]", b, (nodes,))))
        inputs = nodes
    return checked


@contextmanager
def reading(path: str | PathLike[str], holds: str) -> Iterator[Mapping[str, NDArray[Any]]]:
    """Yield the arrays of an `.npz` file by name. Nothing in the file is executed.

    If it is damaged or absurdly large, or the `with` block rejects its contents, a ValueError
    says what it should hold.
    """
    with Path(path).open("rb") as raw:
        try:
            with np.load(raw, allow_pickle=False) as file:
                size = sum(member.file_size for member in file.zip.infolist())
                if size > LARGEST:
                    raise ValueError(f"its arrays have {size:,} bytes, over {LARGEST:,}")
                yield file
        except Exception as error:  # from zip, zlib, NumPy, JSON or a check
            raise ValueError(f"{path} holds no {holds}, or is damaged: {error}") from error


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
    loop in a batch can differ from a single one by rounding; see `forward`.

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
        """Read a network written by `save`; errors are those of `reading`.

        Limits that are not finite and in order are a ValueError, too.
        """
        check_limits(u_min, u_max)  # here: `reading` would report a damaged file
        with reading(path, "policy network") as file:
            about = json.loads(str(file["about"]))
            if about["format"] != 1:
                raise ValueError(f"its format is {about['format']!r}, not 1")
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
            "format": 1,
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

    def _control(self, observation: NDArray[np.float64]) -> Values:
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
