"""Check, run and read feed-forward networks, whose files may come from untrusted sources."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.controller import check_numbers

Array = NDArray[np.floating[Any]]
# Weights, shape (outputs, inputs), and biases, shape (outputs,), of each layer.
Layers = Sequence[tuple[Array, Array]]

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

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If the file is damaged or absurdly large, or the `with` block rejects its contents; the
        message says what it should hold.
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
