"""Run trained recurrent networks in NumPy alone."""

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

DEFAULT_FILE: Final = PRETRAINED / "neural-10000.npz"  # the network of training seed 10,000


@dataclass(frozen=True)
class RecurrentNetwork:
    """A gated recurrent unit followed by a hidden layer and an output layer.

    The network corrects the control law of `agents.law`. Each layer after the recurrent unit
    also receives the network's inputs. Weights and biases are defined as those of
    `torch.nn.GRUCell` and `torch.nn.Linear`, in float32. The rows of the recurrent unit's
    arrays belong to the reset gate, then the update gate, then the candidate state. The
    recurrent unit has `nodes` nodes, and the hidden layer has `hidden` nodes.
    """

    input_weights: Array
    """Weights of the recurrent unit for the inputs, shape (3 nodes, INPUTS)."""
    input_biases: Array
    """Biases of the recurrent unit for the inputs, shape (3 nodes,)."""
    state_weights: Array
    """Weights of the recurrent unit for its last state, shape (3 nodes, nodes)."""
    state_biases: Array
    """Biases of the recurrent unit for its last state, shape (3 nodes,)."""
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
    """How the network was trained, for the network's file; JSON-serialisable."""

    def __post_init__(self) -> None:
        """Replace the arrays by float32 copies; raise a ValueError if a shape does not fit."""
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
        """The arrays of weights and biases, by the names of their fields."""
        return {name: value for name, value in vars(self).items() if name != "provenance"}

    def initial_state(self, n: int) -> Array:
        """Return the network's state before the first sample of n loops, shape (n, nodes)."""
        return np.zeros((n, self.state_weights.shape[1]), np.float32)

    def step(self, inputs: Array, state: Array) -> tuple[Array, Array]:
        """Return the outputs of a sample, shape (n, OUTPUTS), and the next state, (n, nodes).

        Parameters
        ----------
        inputs
            Inputs of n loops at this sample, as `agents.law` computes them, shape (n, INPUTS).
        state
            The state after the last sample, or `initial_state`, shape (n, nodes).
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
        """Return the network in a file that was written by `save`.

        A ValueError is raised if the file is damaged or holds something else.
        """
        with open_arrays(path, "recurrent network") as file:
            settings = read_settings(file)
            names = [name for name in cls.__annotations__ if name != "provenance"]
            weights = {name: file[name] for name in names}
            return cls(**weights, provenance=settings["provenance"])

    def save(self, path: str | PathLike[str]) -> None:
        """Write the network to the `.npz` file `path`, which `load` reads."""
        settings = {"format": FORMAT, "provenance": dict(self.provenance)}
        write_arrays(path, **self.weights, about=json.dumps(settings))


def _sigmoid(values: Array) -> Array:
    """Return 1 / (1 + exp(-x)) for `values` x, in the same shape, without an overflow."""
    activations: Array = 0.5 + 0.5 * np.tanh(0.5 * values)
    return activations
