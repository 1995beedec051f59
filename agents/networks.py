"""Run trained feed-forward networks in NumPy alone, and read and write network files.

A network file may come from an untrusted source: nothing in the file is executed.
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

from agents.controller import Controller, Values, check_numbers, integer_from_0, not_negative

Array = NDArray[np.floating[Any]]
# The layers of a network, from the inputs on: a pair of weights, shape (outputs, inputs), and
# biases, shape (outputs,), for each layer.
Layers = Sequence[tuple[Array, Array]]

# Arguments of the environment that determine the observation, in the order of its elements.
WINDOWS: Final = ("setpoint_window", "error_window", "output_window", "action_window")
PRETRAINED: Final = Path(__file__).parent / "pretrained"  # trained networks of this project
# Largest size of all unpacked arrays of a network file, bytes: 64 MiB, hundreds of times what a
# network needs. A larger file could exhaust the memory.
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

    The network is computed in float32, as in its training. The order of additions in a matrix
    product depends on the batch size, so the outputs for the same inputs can differ by about
    1e-6 between batch sizes.

    Parameters
    ----------
    layers
        Weights and biases of each layer. The last layer has no activation.
    activation
        Name of the activation of the hidden layers, a key of `ACTIVATIONS`.
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
    """Return a copy of an array that has an allowed shape and only finite values.

    Parameters
    ----------
    name
        Name of the array, for the message of an error.
    value
        The array to check.
    *shapes
        The allowed shapes.
    dtype
        Type of the copy's elements.

    Raises
    ------
    ValueError
        If the array has another shape, is not numeric, or has a value that is not finite.
    """
    # A number that is too large for float32 becomes infinite, which is refused below.
    with np.errstate(over="ignore"):
        array = np.array(check_numbers(name, value), dtype)
    if array.shape not in shapes:
        raise ValueError(f"{name} must have shape {shapes[-1]}, got {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite")
    return array


def _checked_layers(layers: Layers, inputs: int) -> Layers:
    """Return copies of a network's layers in float32, if their shapes fit.

    A ValueError is raised if there is no layer, if the network has not `inputs` inputs and one
    output, if the shapes of two layers do not fit, or if a value is not finite.
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
        inputs = nodes  # of the next layer
    return checked


@contextmanager
def open_arrays(
    path: str | PathLike[str], contents: str
) -> Iterator[Mapping[str, NDArray[Any]]]:
    """Open an `.npz` file as a mapping of arrays by name, for a `with` statement.

    Nothing in the file is executed.

    Parameters
    ----------
    path
        The file.
    contents
        What the file should hold, in words, for the message of an error.

    Raises
    ------
    ValueError
        If the file is damaged or larger than `LARGEST_FILE`, or if the `with` block raises an
        error, as the contents of the file then are wrong.
    OSError
        If the file cannot be opened.
    """
    with Path(path).open("rb") as raw:
        try:
            with np.load(raw, allow_pickle=False) as file:
                size = sum(member.file_size for member in file.zip.infolist())
                if size > LARGEST_FILE:
                    raise ValueError(f"its arrays have {size:,} bytes, over {LARGEST_FILE:,}")
                yield file
        except Exception as error:  # from zip, zlib, NumPy, JSON or a check
            raise ValueError(f"{path} holds no {contents}, or is damaged: {error}") from error


def write_arrays(path: str | PathLike[str], **arrays: Any) -> None:
    """Write arrays by name to the `.npz` file `path`, which `open_arrays` reads."""
    with Path(path).open("wb") as file:  # as NumPy appends ".npz" to a path without it
        np.savez_compressed(file, **arrays)


def read_settings(file: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    """Return the settings in a network file: the JSON object in the array `about`.

    `file` is what `open_arrays` yields. A ValueError is raised if the file has another format
    than `FORMAT`.
    """
    settings: dict[str, Any] = json.loads(str(file["about"]))
    if settings["format"] != FORMAT:
        raise ValueError(f"its format is {settings['format']!r}, not {FORMAT}")
    return settings


@dataclass(frozen=True)
class Increments:
    """Settings of the velocity form, in which a network's output changes a *wanted flow*.

    The wanted flow is 0 at the start of an episode. The command follows from the wanted flow by
    a compensation of the actuator's dead zone.
    """

    max_move: float
    """Change of the wanted flow per sample if the network's output is 1, as a share of half the
    actuator's range."""
    dead_zone: float = 0.0
    """Half width z of the dead zone that is compensated, t/h; 0 for no compensation. A wanted
    flow v of 0 gives the command 0, a positive v gives z + (u_max - z) v / u_max, and a
    negative v gives -z + (u_min + z) v / u_min. If a limit of the flow lies inside the dead
    zone, the edge of the dead zone is commanded instead of this limit."""

    def __post_init__(self) -> None:
        not_negative("max_move", self.max_move)
        not_negative("dead_zone", self.dead_zone)


@dataclass(eq=False, kw_only=True)
class PolicyNetwork(Controller):
    """A feed-forward network from the latest observation to an action.

    The observation is multiplied by `input_scale` and passed through the layers. An activation
    follows every layer but the last layer, whose single output is clipped to [-1, 1]. The
    clipped output is the action or, with `increments`, changes a wanted flow. The layers are
    computed in float32, so the action for an observation can differ by rounding between a batch
    and a single loop; see `forward`.

    The arguments `u_min` and `u_max` are those of `Controller`.

    Parameters
    ----------
    layers
        Weights, shape (outputs, inputs), and biases, shape (outputs,), of each layer.
    observation
        The observation that the network expects: the environment's arguments `setpoint_window`,
        `error_window`, `output_window` and `action_window`, by name. An argument that is not
        named is 0.
    input_scale
        Factor for each element of the observation; shape (n_obs,).
    activation
        Activation of the hidden layers: "elu", "relu", "silu" or "tanh".
    increments
        Settings of the velocity form; None if the network's output is the action itself.
    provenance
        How the network was trained, for the network's file; JSON-serialisable.
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
            name: integer_from_0(f"observation[{name!r}]", self.observation.get(name, 0))
            for name in WINDOWS
        }
        self.n_obs = sum(self.observation.values())
        if self.activation not in [*ACTIVATIONS]:  # a list, as `activation` may be unhashable
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
        """Return the network in a file that was written by `save`.

        Parameters
        ----------
        path
            The file.
        u_min, u_max
            Limits of the actuator, t/h, as of `Controller`; files do not hold limits.

        Raises
        ------
        ValueError
            If the file is damaged or holds something else, or if a limit is out of range.
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
        # Outside the `with` block: invalid limits do not mean that the file is damaged.
        return replace(network, u_min=u_min, u_max=u_max)

    def save(self, path: str | PathLike[str]) -> None:
        """Write the network, without the limits of the flow, to the `.npz` file `path`."""
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
        """Refuse plants that the network was not made for, by a ValueError.

        The arguments are those of `Controller.check_environment`. In addition to the checks of
        `Controller`, the plants must have the observation that the network expects.
        """
        super().check_environment(parameters, wrapped, n)
        windows = {name: getattr(parameters, name) for name in WINDOWS}
        if windows != self.observation:
            raise ValueError(
                f"env must have the windows that policy wants, {self.observation}, "
                f"got {windows}"
            )

    def reset(self) -> None:
        """Set the wanted flow of the velocity form to 0, before a new episode."""
        super().reset()
        # The wanted flow, in units of half the actuator's range.
        self._flow: Values = np.float64(0.0)

    def _control(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the commands u(k), t/h, shape (loops,), and update the wanted flow.

        `rows` are the observations, shape (loops, n_obs); any other size raises a ValueError.
        """
        if rows.shape[1] != self.n_obs:
            raise ValueError(
                f"observation must have {self.n_obs} elements, got {rows.shape[1]}: "
                f"make the environment with the network's `observation`, {self.observation}"
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
        """Return the commands for the wanted flows, t/h, with the dead zone compensated.

        The rule is that of `Increments.dead_zone`. `edge` is the half width of the dead zone,
        t/h, and the commands have the shape (loops,).
        """
        flow = self._flow
        half_range = (self.u_max - self.u_min) / 2.0
        # The limit in the direction of the flow, t/h; any number other than 0 for a flow of 0.
        limit = np.where(flow > 0.0, self.u_max, np.where(flow < 0.0, -self.u_min, 1.0))
        share = np.abs(flow) * (half_range / limit)
        size = edge + share * np.maximum(limit - edge, 0.0)
        command: NDArray[np.float64] = np.sign(flow) * size
        return command
