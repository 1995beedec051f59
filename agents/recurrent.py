"""Run trained recurrent networks in NumPy alone."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from agents.law import INPUTS, OUTPUTS
from agents.networks import PRETRAINED, check_array, reading

Array = NDArray[np.floating[Any]]

DEFAULT_FILE: Final = PRETRAINED / "neural-10000.npz"
FORMAT: Final = 1  # of the file


@dataclass(frozen=True)
class RecurrentNetwork:
    """A gated recurrent unit, and two layers behind it that see the inputs, too.

    The weights are those of `torch.nn.GRUCell` and `torch.nn.Linear`, in float32; the rows of
    the cell belong to its reset gate, its update gate and its candidate. With `nodes` of the
    cell and `hidden` nodes between the layers, they have the following shapes.
    """

    input_weights: Array
    """(3 nodes, INPUTS)"""
    input_biases: Array
    """(3 nodes,)"""
    state_weights: Array
    """(3 nodes, nodes)"""
    state_biases: Array
    """(3 nodes,)"""
    hidden_weights: Array
    """(hidden, INPUTS + nodes)"""
    hidden_biases: Array
    """(hidden,)"""
    output_weights: Array
    """(OUTPUTS, hidden + INPUTS)"""
    output_biases: Array
    """(OUTPUTS,)"""
    provenance: Mapping[str, Any] = field(default_factory=dict)
    """Origin of the weights, JSON-serialisable."""

    def __post_init__(self) -> None:
        nodes, hidden = np.shape(self.state_weights)[-1], np.size(self.hidden_biases)
        shapes = {
            "input_weights": (3 * nodes, INPUTS),
            "input_biases": (3 * nodes,),
            "state_weights": (3 * nodes, nodes),
            "state_biases": (3 * nodes,),
            "hidden_weights": (hidden, INPUTS + nodes),
            "hidden_biases": (hidden,),
            "output_weights": (OUTPUTS, hidden + INPUTS),
            "output_biases": (OUTPUTS,),
        }
        for name, shape in shapes.items():
            object.__setattr__(self, name, check_array(name, getattr(self, name), shape))

    @property
    def weights(self) -> dict[str, Array]:
        """The arrays by name."""
        return {name: value for name, value in vars(self).items() if name != "provenance"}

    def initial_state(self, n: int) -> Array:
        """Return the state of n loops at rest, shape (n, nodes)."""
        return np.zeros((n, self.state_weights.shape[1]), np.float32)

    def step(self, inputs: Array, state: Array) -> tuple[Array, Array]:
        """Return the outputs, shape (n, OUTPUTS), and the next state of n loops."""
        from_inputs = inputs @ self.input_weights.T + self.input_biases
        from_state = state @ self.state_weights.T + self.state_biases
        reset_in, update_in, candidate_in = np.split(from_inputs, 3, axis=1)
        reset_state, update_state, candidate_state = np.split(from_state, 3, axis=1)
        reset = _sigmoid(reset_in + reset_state)
        update = _sigmoid(update_in + update_state)
        candidate = np.tanh(candidate_in + reset * candidate_state)
        state = candidate + update * (state - candidate)
        hidden = np.concatenate([inputs, state], axis=1) @ self.hidden_weights.T
        hidden += self.hidden_biases
        hidden *= _sigmoid(hidden)
        outputs = np.concatenate([hidden, inputs], axis=1) @ self.output_weights.T
        outputs += self.output_biases
        return outputs, state

    @classmethod
    def load(cls, path: str | PathLike[str] = DEFAULT_FILE) -> RecurrentNetwork:
        """Read a network written by `save`; errors are those of `agents.networks.reading`."""
        with reading(path, "recurrent network") as file:
            about = json.loads(str(file["about"]))
            if about["format"] != FORMAT:
                raise ValueError(f"its format is {about['format']!r}, not {FORMAT}")
            names = [name for name in cls.__annotations__ if name != "provenance"]
            weights = {name: file[name] for name in names}
            return cls(**weights, provenance=about["provenance"])

    def save(self, path: str | PathLike[str]) -> None:
        """Write the network to a `.npz` file."""
        about = json.dumps({"format": FORMAT, "provenance": dict(self.provenance)})
        arrays: dict[str, Any] = {**self.weights, "about": about}
        with Path(path).open("wb") as file:
            np.savez_compressed(file, **arrays)


def _sigmoid(values: Array) -> Array:
    """Return 1 / (1 + exp(-x)), without an overflow."""
    half: Array = 0.5 + 0.5 * np.tanh(0.5 * values)
    return half
