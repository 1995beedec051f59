"""Compute trained recurrent networks in NumPy, without PyTorch."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from agents.law import INPUTS, OUTPUTS
from agents.networks import (
    FORMAT,
    PRETRAINED,
    check_array,
    open_arrays,
    read_settings,
    write_arrays,
)

Array = NDArray[np.floating[Any]]

DEFAULT_FILE: Final = PRETRAINED / "neural-10000.npz"  # trained with the seed 10,000


@dataclass(frozen=True)
class RecurrentNetwork:
    """A gated recurrent unit followed by a hidden layer and an output layer.

    The network corrects the control law in `agents.law`. The hidden layer and the output layer
    also receive the inputs of the network. Weights and biases are defined as in
    `torch.nn.GRUCell` and `torch.nn.Linear`, in float32. The rows of the recurrent unit's
    arrays are ordered by reset gate, update gate and candidate state. In the shapes of the
    arrays, `nodes` is the number of nodes of the recurrent unit, and `hidden` the number of
    nodes of the hidden layer.
    """

    input_weights: Array
    """Weights of the recurrent unit for the inputs, shape (3 nodes, INPUTS)."""
    input_biases: Array
    """Biases of the recurrent unit for the inputs, shape (3 nodes,)."""
    state_weights: Array
    """Weights of the recurrent unit for the previous state, shape (3 nodes, nodes)."""
    state_biases: Array
    """Biases of the recurrent unit for the previous state, shape (3 nodes,)."""
    hidden_weights: Array
    """Weights of the hidden layer for inputs and state, shape (hidden, INPUTS + nodes)."""
    hidden_biases: Array
    """Biases of the hidden layer, shape (hidden,)."""
    output_weights: Array
    """Weights of the output layer for the hidden layer and the inputs, shape (OUTPUTS, hidden +
    INPUTS)."""
    output_biases: Array
    """Biases of the output layer, shape (OUTPUTS,)."""
    provenance: Mapping[str, Any] = field(default_factory=dict)
    """Description of the training, of values that JSON can store. The method `save` writes the
    description to the file."""

    def __post_init__(self) -> None:
        """Replace the weights by float32 copies; a wrong shape raises a ValueError."""
        nodes = np.shape(self.state_weights)[-1]
        hidden = np.size(self.hidden_biases)
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
            array = check_array(name, getattr(self, name), shape)
            object.__setattr__(self, name, array)  # as the dataclass is frozen

    @property
    def weights(self) -> dict[str, Array]:
        """All weights and biases: a dict from field names to arrays."""
        return {name: value for name, value in vars(self).items() if name != "provenance"}

    def initial_state(self, n: int) -> Array:
        """Return the recurrent unit's state at the start of an episode, shape (n, nodes)."""
        return np.zeros((n, self.state_weights.shape[1]), np.float32)

    def step(self, inputs: Array, state: Array) -> tuple[Array, Array]:
        """Return the outputs, (n, OUTPUTS), and the recurrent unit's next state, (n, nodes).

        Parameters
        ----------
        inputs
            Inputs of the network for n loops at one sample, shape (n, INPUTS).
        state
            State of the recurrent unit after the previous sample, or from `initial_state`,
            shape (n, nodes).
        """
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
        """Return the network in an `.npz` file that the method `save` has written.

        A ValueError is raised if the file is damaged or contains no recurrent network.
        """
        with open_arrays(path, "recurrent network") as file:
            settings = read_settings(file)
            names = [name for name in cls.__annotations__ if name != "provenance"]
            weights = {name: file[name] for name in names}
            return cls(**weights, provenance=settings["provenance"])

    def save(self, path: str | PathLike[str]) -> None:
        """Write the network to the `.npz` file `path`."""
        settings = {"format": FORMAT, "provenance": dict(self.provenance)}
        write_arrays(path, **self.weights, about=json.dumps(settings))


def _sigmoid(values: Array) -> Array:
    """Return 1 / (1 + exp(-values)), computed without an overflow."""
    activations: Array = 0.5 + 0.5 * np.tanh(0.5 * values)
    return activations
