"""Compute trained feed-forward networks in NumPy, and read and write network files.

Loading a network file from an untrusted source is safe, as no code in the file is executed.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mptc_gym.plant.actuator import command_from_action
from mptc_gym.plant.checks import not_negative, positive
from mptc_gym.plant.parameters import WINDOWS, Parameters

from .controller import Controller, Values

Array = NDArray[np.floating[Any]]
# Layers of a network in the order of computation. Each layer is a pair of weights, shape
# (outputs, inputs), and biases, shape (outputs,).
Layers = Sequence[tuple[Array, Array]]

PRETRAINED: Final = Path(__file__).parent / "pretrained"  # trained networks of this project
FORMAT: Final = 2  # version of the format of network files


def read_arrays(path: str | PathLike[str]) -> dict[str, NDArray[Any]]:
    """Return the arrays in an `.npz` file by name.

    Raises
    ------
    ValueError
        If the file is damaged, or no `.npz` file.
    OSError
        If the file cannot be opened.
    """
    with Path(path).open("rb") as file:
        try:
            return dict(np.load(file, allow_pickle=False))
        except Exception as error:  # from zip, zlib or NumPy
            raise ValueError(f"{path} is no .npz file, or is damaged: {error}") from error


def write_arrays(path: str | PathLike[str], **arrays: Any) -> None:
    """Write named arrays to the `.npz` file `path`."""
    with Path(path).open("wb") as file:  # given a path, NumPy would append ".npz"
        np.savez_compressed(file, **arrays)


@dataclass(eq=False, kw_only=True)
class PolicyNetwork(Controller):
    """A feed-forward network from the latest observation to an action.

    Every layer except the last is followed by the activation function tanh. The single output
    of the last layer, clipped to [-1, 1], is the action. The network is computed in float32, as
    in training. The batch size changes the order of additions in matrix products, so the action
    for an observation can differ by rounding between a batch and a single loop.

    A network with `action="change"` acts in environments with this argument, and only the
    environment knows the flow that results. The attribute `command` of such a network is the
    change of the wanted flow, t/h.

    The arguments `u_min` and `u_max` are described in `Controller`.

    Parameters
    ----------
    layers
        Weights, shape (outputs, inputs), and biases, shape (outputs,), of each layer.
    observation
        Arguments of the environment whose observations the network expects: a dict with any of
        the names `setpoint_window`, `error_window`, `output_window` and `action_window`, where
        a missing name counts as 0.
    action
        Argument of the environment for which the network was trained: "flow" if an action sets
        the flow, and "change" if an action changes the flow.
    max_move
        Argument of the environment for `action="change"`: change of the flow for an action of
        1, as a share of half the flow range.
    compensated_dead_zone
        Argument of the environment for `action="change"`: half width of the dead zone that the
        commanded flow skips, t/h. The network also acts in environments with another one.
    provenance
        Description of the training, of values that JSON can store. The method `save` writes the
        description to the file.
    """

    layers: Layers = field(repr=False, kw_only=False)
    observation: Mapping[str, int]
    action: str = "flow"
    max_move: float = 0.4
    compensated_dead_zone: float = 0.0
    provenance: Mapping[str, Any] = field(default_factory=dict, repr=False)

    # A network has no memory, so the batch size may change at any sample.
    _remembers = False

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check(positive, "max_move")
        self._check(not_negative, "compensated_dead_zone")
        if self.action not in ("flow", "change"):
            raise ValueError(f"action must be 'flow' or 'change', got {self.action!r}")
        self.observation = dict.fromkeys(WINDOWS, 0) | dict(self.observation)
        self.n_obs = sum(self.observation.values())
        # In float32, as in training; copies, as the caller may change the arrays.
        self.layers = [
            (np.array(W, np.float32), np.array(b, np.float32)) for W, b in self.layers
        ]
        # The inputs of a layer are the outputs of the layer before. The last layer has a single
        # output, the action.
        sizes = [self.n_obs, *(b.size for _, b in self.layers)]
        shapes = [W.shape for W, _ in self.layers]
        if shapes != list(zip(sizes[1:], sizes[:-1], strict=True)) or sizes[-1] != 1:
            raise ValueError(
                f"layers must have {self.n_obs} inputs, shapes that fit together, and one "
                f"output, got weights of the shapes {shapes}"
            )

    @property
    def interface(self) -> dict[str, Any]:
        """The arguments of the environment in which the network acts, by name."""
        return {
            **self.observation,
            "action": self.action,
            "max_move": self.max_move,
            "compensated_dead_zone": self.compensated_dead_zone,
        }

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
            If the file is damaged or of another version of this project, or if a flow limit is
            out of range.
        KeyError
            If the file lacks an array of a policy network.
        OSError
            If the file cannot be opened.
        """
        arrays = read_arrays(path)
        settings = json.loads(str(arrays["about"]))
        if settings.pop("format") != FORMAT:
            raise ValueError(f"{path} is of another version of this project")
        number_of_layers = settings.pop("layers")
        layers = [(arrays[f"W{i}"], arrays[f"b{i}"]) for i in range(number_of_layers)]
        return cls(layers, u_min=u_min, u_max=u_max, **settings)

    def save(self, path: str | PathLike[str]) -> None:
        """Write the network, without the flow limits, to the `.npz` file `path`."""
        settings = {
            "format": FORMAT,
            "layers": len(self.layers),
            "observation": self.observation,
            "action": self.action,
            "max_move": self.max_move,
            "compensated_dead_zone": self.compensated_dead_zone,
            "provenance": self.provenance,
        }
        arrays = {}
        for i, (W, b) in enumerate(self.layers):
            arrays[f"W{i}"] = W
            arrays[f"b{i}"] = b
        write_arrays(path, about=json.dumps(settings), **arrays)

    def check_environment(self, parameters: Parameters, n: int) -> None:
        """Raise a ValueError if the network does not fit the plants of an environment.

        The arguments are described in `Controller.check_environment`. In addition to the checks
        of `Controller`, the environment must have the observations and, if actions change the
        flow, the `max_move` of the network's training.
        """
        super().check_environment(parameters, n)
        # Another `compensated_dead_zone` is allowed. If actions set the flow, `max_move` has no
        # effect.
        names = [*WINDOWS, "max_move"] if self.action == "change" else WINDOWS
        expected = {name: self.interface[name] for name in names}
        received = {name: getattr(parameters, name) for name in names}
        if received != expected:
            raise ValueError(
                f"env must have the arguments with which the policy was trained, {expected}, "
                f"got {received}"
            )

    def _control(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the commands u(k) or the changes of the wanted flows, t/h, shape (loops,)."""
        x = rows.astype(np.float32)
        *hidden_layers, (last_W, last_b) = self.layers
        for W, b in hidden_layers:
            x = np.tanh(x @ W.T + b)
        outputs = (x @ last_W.T + last_b).astype(np.float64)
        output: NDArray[np.float64] = np.clip(outputs[:, 0], -1.0, 1.0)  # the only column
        if self.action == "change":
            half_range = (self.u_max - self.u_min) / 2.0
            return self.max_move * half_range * output
        command: NDArray[np.float64] = command_from_action(output, self.u_min, self.u_max)
        return command

    def _action(self, command: Values) -> NDArray[np.float32]:
        """Return the actions that give `command`, in the shape of `command`."""
        if self.action == "change":
            # The inverse of the last lines of `_control`: the action is the network's output.
            half_range = (self.u_max - self.u_min) / 2.0
            return np.asarray(command / (self.max_move * half_range), np.float32)
        return super()._action(command)
