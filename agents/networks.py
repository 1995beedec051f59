"""Run trained feed-forward networks, policies among them, in NumPy alone.

Their files may come from untrusted sources: nothing in them is executed.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.controller import Controller, Index, NotNegative, Values, check, check_numbers

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


def check_array(
    name: str, value: ArrayLike, *shapes: tuple[int, ...], dtype: Any = np.float32
) -> NDArray[Any]:
    """Return a copy if it has one of the shapes and is finite; otherwise raise a ValueError."""
    with np.errstate(over="ignore"):  # too large for float32 is infinite there, and refused
        array = np.array(check_numbers(name, value), dtype)
    if array.shape not in shapes:
        raise ValueError(f"{name} must have shape {shapes[-1]}, got {array.shape}")
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


def read_layers(file: Mapping[str, Array], layers: int, prefix: str = "") -> Layers:
    """Return the layers that have the names that `write` gives."""
    return [(file[f"{prefix}W{i}"], file[f"{prefix}b{i}"]) for i in range(layers)]


def write(path: str | PathLike[str], layers: Mapping[str, Layers], **arrays: Any) -> None:
    """Write layers, by the prefix of their names, and other arrays to an `.npz` file."""
    for prefix, each in layers.items():
        for i, (W, b) in enumerate(each):
            arrays |= {f"{prefix}W{i}": W, f"{prefix}b{i}": b}
    with Path(path).open("wb") as file:
        np.savez_compressed(file, **arrays)


@dataclass(frozen=True)
class Increments:
    """Velocity form: the network's output changes the wanted flow, which is 0 at first."""

    max_move: float
    """Change of the wanted flow per sample at an output of 1, as a share of half the range."""
    dead_zone: float = 0.0
    """Half width z of the dead zone to compensate, t/h, or 0. Wanted flows v are spread over
    those that pass: the command is z + (u_max - z) v / u_max above 0, 0 at 0, and below
    -z + (u_min + z) v / u_min. A limit inside the zone is reached by commanding its edge."""

    def __post_init__(self) -> None:
        check("max_move", self.max_move, NotNegative)
        check("dead_zone", self.dead_zone, NotNegative)


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
        The windows that the network expects, by the environment's arguments `setpoint_window`,
        `error_window`, `output_window` and `action_window`; 0 where not named.
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
            name: check(f"observation[{name!r}]", self.observation.get(name, 0), Index)
            for name in WINDOWS
        }
        self.n_obs = sum(self.observation.values())
        if self.activation not in [*ACTIVATIONS]:  # a list: it may be unhashable
            raise ValueError(
                f"activation must be one of {[*ACTIVATIONS]}, got {self.activation!r}"
            )
        self._edge = self.increments.dead_zone if self.increments else 0.0
        self.input_scale = check_array("input_scale", self.input_scale, (self.n_obs,))
        self.layers = check_layers(self.layers, self.n_obs, 1)
        self._remembers = self.increments is not None

    @classmethod
    def load(
        cls, path: str | PathLike[str], *, u_min: float = -10.0, u_max: float = 10.0
    ) -> PolicyNetwork:
        """Read a network written by `save`; errors are those of `reading` and of the limits."""
        with reading(path, "policy network") as file:
            about = json.loads(str(file["about"]))
            if about["format"] != 1:
                raise ValueError(f"its format is {about['format']!r}, not 1")
            increments = about["increments"]
            network = cls(
                read_layers(file, about["layers"]),
                observation=about["observation"],
                input_scale=file["input_scale"],
                activation=about["activation"],
                increments=None if increments is None else Increments(**increments),
                provenance=about["provenance"],
            )
        return replace(network, u_min=u_min, u_max=u_max)  # no errors of a damaged file

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
        write(path, {"": self.layers}, about=json.dumps(about), input_scale=self.input_scale)

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
        self._flow: Values = np.float64(0.0)  # wanted, as a share of half the range

    def _control(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        if rows.shape[1] != self.n_obs:
            raise ValueError(
                f"observation must have {self.n_obs} elements, got {rows.shape[1]}: "
                f"make the environment with the network's `observation`, {self.observation}"
            )
        outputs = forward(self.layers, self.activation, rows * self.input_scale)
        output = np.clip(outputs[:, 0], -1.0, 1.0)
        half_range, z = (self.u_max - self.u_min) / 2.0, self._edge
        if self.increments is None:
            return self.u_min + (output + 1.0) * half_range
        moved, lowest = self._flow + self.increments.max_move * output, self.u_min / half_range
        self._flow = flow = np.clip(moved, lowest, self.u_max / half_range)
        if z == 0.0:
            return self.u_min + (flow - lowest) * half_range
        limit = np.where(flow > 0.0, self.u_max, np.where(flow < 0.0, -self.u_min, 1.0))
        share = np.abs(flow) * (half_range / limit)
        command: NDArray[np.float64] = np.sign(flow) * (z + share * np.maximum(limit - z, 0.0))
        return command
