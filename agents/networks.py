"""Compute trained feed-forward networks in NumPy, and read and write network files.

Loading a network file from an untrusted source is safe, as no code in the file is executed.
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

from agents.controller import Controller, Values, check_numbers, from_0, not_negative

Array = NDArray[np.floating[Any]]
# Layers of a network in the order of computation. Each layer is a pair of weights, shape
# (outputs, inputs), and biases, shape (outputs,).
Layers = Sequence[tuple[Array, Array]]

# Arguments of the environment that choose the elements of an observation, in their order.
WINDOWS: Final = ("setpoint_window", "error_window", "output_window", "action_window")
PRETRAINED: Final = Path(__file__).parent / "pretrained"  # trained networks of this project
# Largest total size of the unpacked arrays in a network file, bytes. A larger file could
# exhaust the memory, and no network of this project needs a hundredth of 64 MiB.
LARGEST_FILE: Final = 2**26
FORMAT: Final = 1  # version of the format of network files
# The activation functions of hidden layers, by name.
ACTIVATIONS: Final[Mapping[str, Callable[[Array], Array]]] = {
    "elu": lambda x: np.where(x > 0.0, x, np.expm1(np.minimum(x, 0.0))),
    "relu": lambda x: np.maximum(x, 0.0),
    "silu": lambda x: x * 0.5 * (1.0 + np.tanh(0.5 * x)),
    "tanh": np.tanh,
}


def forward(layers: Layers, activation: str, inputs: ArrayLike) -> NDArray[np.float64]:
    """Return the outputs of a feed-forward network, shape (..., outputs).

    The network is computed in float32, as in training. The batch size changes the order of
    additions in matrix products, so outputs for the same inputs can differ by about 1e-6
    between batch sizes.

    Parameters
    ----------
    layers
        Weights and biases of each layer. The last layer has no activation function.
    activation
        Name of the activation function of the hidden layers, a key of `ACTIVATIONS`.
    inputs
        Inputs of the network, shape (..., inputs).
    """
    x = np.asarray(inputs, np.float32)
    activate = ACTIVATIONS[activation]
    *hidden_layers, (last_W, last_b) = layers
    for W, b in hidden_layers:
        x = activate(x @ W.T + b)
    return (x @ last_W.T + last_b).astype(np.float64)


def check_array(
    name: str, value: ArrayLike, *shapes: tuple[int, ...], dtype: Any = np.float32
) -> NDArray[Any]:
    """Return a copy of an array after a check that its shape is allowed and its values finite.

    Parameters
    ----------
    name
        Name of the array for error messages.
    value
        The array to check.
    *shapes
        Allowed shapes of the array.
    dtype
        NumPy type of the returned copy.

    Raises
    ------
    ValueError
        If the array is not numeric, has a shape that is not allowed, or has a value that is not
        finite.
    """
    # A number that is too large for float32 becomes infinite, which is an error below.
    with np.errstate(over="ignore"):
        array = np.array(check_numbers(name, value), dtype)
    if array.shape not in shapes:
        raise ValueError(f"{name} must have shape {shapes[-1]}, got {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite")
    return array


def _checked_layers(layers: Layers, inputs: int) -> Layers:
    """Return float32 copies of the layers of a network after a check of shapes and values.

    A ValueError is raised if `layers` is empty, if the shapes of layers do not fit together, if
    the network does not have `inputs` inputs and one output, or if a value is not finite.
    """
    if not layers:
        raise ValueError("layers must hold at least one layer, got none")
    checked = []
    for i, (W, b) in enumerate(layers):
        is_last = i == len(layers) - 1
        nodes = 1 if is_last else np.size(b)
        weights = check_array(f"weights of layers[{i}]", W, (nodes, inputs))
        biases = check_array(f"biases of layers[{i}]", b, (nodes,))
        checked.append((weights, biases))
        inputs = nodes  # number of inputs of the next layer
    return checked


@contextmanager
def open_arrays(
    path: str | PathLike[str], contents: str
) -> Iterator[Mapping[str, NDArray[Any]]]:
    """Open an `.npz` file as a mapping of arrays by name, for a `with` statement.

    Parameters
    ----------
    path
        Path of the file.
    contents
        Expected contents of the file in words, such as "weights", for error messages.

    Raises
    ------
    ValueError
        If the file is damaged or its arrays are larger than `LARGEST_FILE`. An error in the
        `with` block becomes a ValueError, because the file then has wrong contents.
    OSError
        If the file cannot be opened.
    """
    with Path(path).open("rb") as raw:
        try:
            with np.load(raw, allow_pickle=False) as file:
                size = sum(member.file_size for member in file.zip.infolist())
                if size > LARGEST_FILE:
                    raise ValueError(
                        f"the unpacked arrays have {size:,} bytes, over {LARGEST_FILE:,}"
                    )
                yield file
        except Exception as error:  # from zip, zlib, NumPy, JSON or a check
            raise ValueError(f"{path} holds no {contents}, or is damaged: {error}") from error


def write_arrays(path: str | PathLike[str], **arrays: Any) -> None:
    """Write named arrays to the `.npz` file `path`."""
    with Path(path).open("wb") as file:  # given a path, NumPy would append ".npz"
        np.savez_compressed(file, **arrays)


def read_settings(file: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    """Return the settings in a network file: the JSON object in the array `about`.

    The argument `file` is an open network file, from `open_arrays`. A ValueError is raised if
    the format version in the settings is not `FORMAT`.
    """
    settings: dict[str, Any] = json.loads(str(file["about"]))
    if settings["format"] != FORMAT:
        raise ValueError(f"the format version must be {FORMAT}, got {settings['format']!r}")
    return settings


@dataclass(frozen=True)
class Increments:
    """Settings of a controller in velocity form, whose network outputs changes of the flow.

    The wanted flow is 0 at the start of an episode. At each sample, the wanted flow changes by
    `max_move` times the output of the network, and is clipped to the flow limits. The command
    is the wanted flow with a compensation of the actuator's dead zone.
    """

    max_move: float
    """Change of the wanted flow per sample for the network output 1, as a share of half the
    flow range of the actuator."""
    dead_zone: float = 0.0
    """Half width z of the compensated dead zone, t/h; 0 for no compensation. The command is z +
    (u_max - z) v / u_max for a positive wanted flow v, t/h, -z + (u_min + z) v / u_min for a
    negative v, and 0 for v = 0. A flow limit inside the dead zone is replaced by the edge of
    the dead zone."""

    def __post_init__(self) -> None:
        not_negative("max_move", self.max_move)
        not_negative("dead_zone", self.dead_zone)


@dataclass(eq=False, kw_only=True)
class PolicyNetwork(Controller):
    """A feed-forward network from the latest observation to an action.

    The input of the network is the observation times `input_scale`. Every layer except the last
    is followed by an activation function, and the single output of the last layer is clipped to
    [-1, 1]. Without `increments`, the clipped output is the action. The network is computed in
    float32, so the action for an observation can differ by rounding between a batch and a
    single loop.

    The arguments `u_min` and `u_max` are described in `Controller`.

    Parameters
    ----------
    layers
        Weights, shape (outputs, inputs), and biases, shape (outputs,), of each layer.
    observation
        Arguments of the environment whose observations the network expects: a dict with any of
        the names `setpoint_window`, `error_window`, `output_window` and `action_window`, where
        a missing name counts as 0.
    input_scale
        Factors by which the elements of an observation are multiplied, shape (n_obs,).
    activation
        Activation function of the hidden layers: "elu", "relu", "silu" or "tanh".
    increments
        Settings with which the network's output changes a wanted flow; None if the network's
        output is the action.
    provenance
        Description of the training, of values that JSON can store. The method `save` writes the
        description to the file.
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
                raise ValueError(
                    f"observation must have only the keys {', '.join(WINDOWS)}, got {name!r}"
                )
        self.observation = {
            name: from_0(f"observation[{name!r}]", self.observation.get(name, 0))
            for name in WINDOWS
        }
        self.n_obs = sum(self.observation.values())
        if self.activation not in [*ACTIVATIONS]:  # a list, as a dict needs a hashable key
            raise ValueError(
                f"activation must be one of {[*ACTIVATIONS]}, got {self.activation!r}"
            )
        self.input_scale = check_array("input_scale", self.input_scale, (self.n_obs,))
        self.layers = _checked_layers(self.layers, self.n_obs)
        if self.increments is None:
            self._remembers = False
        else:
            self._edge = self.increments.dead_zone

    @classmethod
    def load(
        cls, path: str | PathLike[str], *, u_min: float = -10.0, u_max: float = 10.0
    ) -> PolicyNetwork:
        """Return the network in an `.npz` file that the method `save` has written.

        Parameters
        ----------
        path
            Path of the file.
        u_min, u_max
            Lower and upper limit of the actuator's flow, t/h. A network file does not contain
            flow limits.

        Raises
        ------
        ValueError
            If the file is damaged or contains no policy network, or if a flow limit is out of
            range.
        OSError
            If the file cannot be opened.
        """
        with open_arrays(path, "policy network") as file:
            settings = read_settings(file)
            increments = settings["increments"]
            if increments is not None:
                increments = Increments(**increments)
            network = cls(
                [(file[f"W{i}"], file[f"b{i}"]) for i in range(settings["layers"])],
                observation=settings["observation"],
                input_scale=file["input_scale"],
                activation=settings["activation"],
                increments=increments,
                provenance=settings["provenance"],
            )
        # Outside the `with` block, an error for invalid flow limits does not blame the file.
        return replace(network, u_min=u_min, u_max=u_max)

    def save(self, path: str | PathLike[str]) -> None:
        """Write the network, without the flow limits, to the `.npz` file `path`."""
        settings = {
            "format": FORMAT,
            "layers": len(self.layers),
            "observation": self.observation,
            "activation": self.activation,
            "increments": None if self.increments is None else asdict(self.increments),
            "provenance": self.provenance,
        }
        arrays = {}
        for i, (W, b) in enumerate(self.layers):
            arrays[f"W{i}"] = W
            arrays[f"b{i}"] = b
        write_arrays(path, about=json.dumps(settings), input_scale=self.input_scale, **arrays)

    def check_environment(self, parameters: Any, wrapped: str, n: int) -> None:
        """Raise a ValueError if the network does not fit the plants of an environment.

        The arguments are described in `Controller.check_environment`. In addition to the checks
        of `Controller`, the environment must have the observations that the network expects.
        """
        super().check_environment(parameters, wrapped, n)
        windows = {name: getattr(parameters, name) for name in WINDOWS}
        if windows != self.observation:
            raise ValueError(
                f"env must have the observations that policy expects, "
                f"{self.observation}, got {windows}"
            )

    def reset(self) -> None:
        """Set the wanted flow to 0, before a new episode."""
        super().reset()
        # Wanted flow of the velocity form, as a share of half the flow range.
        self._flow: Values = np.float64(0.0)

    def _control(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the commands u(k), t/h, shape (loops,), and update the wanted flow.

        A ValueError is raised unless the observations `rows` have the shape (loops, n_obs).
        """
        if rows.shape[1] != self.n_obs:
            raise ValueError(
                f"observation must have {self.n_obs} elements, got {rows.shape[1]}: "
                f"make the environment with the arguments {self.observation}"
            )
        outputs = forward(self.layers, self.activation, rows * self.input_scale)
        output = np.clip(outputs[:, 0], -1.0, 1.0)
        half_range = (self.u_max - self.u_min) / 2.0
        if self.increments is None:
            return self.u_min + (output + 1.0) * half_range
        lowest = self.u_min / half_range
        highest = self.u_max / half_range
        moved = self._flow + self.increments.max_move * output
        self._flow = np.clip(moved, lowest, highest)
        if self.increments.dead_zone == 0.0:
            return self.u_min + (self._flow - lowest) * half_range
        return self._compensated(self.increments.dead_zone)

    def _compensated(self, edge: float) -> NDArray[np.float64]:
        """Return commands for the wanted flows, 0 or outside the dead zone, t/h, (loops,).

        `edge` is the half width of the dead zone, t/h.
        """
        flow = self._flow
        half_range = (self.u_max - self.u_min) / 2.0
        # Size of the flow limit in the direction of the wanted flow, t/h. For a flow of 0, the
        # size does not matter, but 0 would cause a division by 0.
        limit = np.where(flow > 0.0, self.u_max, np.where(flow < 0.0, -self.u_min, 1.0))
        share = np.abs(flow) * (half_range / limit)
        size = edge + share * np.maximum(limit - edge, 0.0)
        command: NDArray[np.float64] = np.sign(flow) * size
        return command
