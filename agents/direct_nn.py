"""Implement the paper's neural controller, which learns online from the control error."""

from __future__ import annotations

from dataclasses import dataclass, fields
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.controller import (
    Controller,
    Count,
    Flag,
    Index,
    NotNegative,
    Number,
    Size,
    array_size,
)
from agents.networks import check_array, open_arrays, write_arrays

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)  # arrays have no single truth value
class Weights:
    """Weights and thresholds of one network, or of a batch of networks.

    A network has N inputs, N_1 hidden nodes and one output. The arrays of a batch have a
    leading batch axis in addition to the shapes below.
    """

    W: Array
    """Weights W_ij from input i to hidden node j; shape (N_1, N)."""
    theta_1: Array
    """Thresholds theta_1j of the hidden nodes; shape (N_1,)."""
    W_1: Array
    """Weights W_1j1 from hidden node j to the output; shape (N_1,)."""
    theta_2: Array
    """Threshold theta_21 of the output; shape ()."""

    def save(self, path: str | PathLike[str]) -> None:
        """Write the weights to the `.npz` file `path`, which `load` reads."""
        write_arrays(path, **vars(self))

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Weights:
        """Return the weights in a file that was written by `save`.

        A ValueError is raised if the file is damaged or holds something else.
        """
        with open_arrays(path, "weights") as file:
            arrays = {field.name: file[field.name] for field in fields(cls)}
            return cls(**arrays)


@dataclass(eq=False, kw_only=True)
class DirectNNController(Controller):
    """A network of N inputs, N_1 hidden nodes and one output that learns while it controls.

    At each sample k, the controller takes steps A to E of Section 4 of the paper: the command
    is computed with the present weights, and then the weights are updated from the error e(k)
    and the activations of the nodes. The controller knows only one thing about the plant: D(G),
    the direction in which the output moves when the input rises.

    Parameters
    ----------
    u_min
        U_min, the lowest command, t/h: an output of 0 of the network.
    u_max
        U_max, the highest command, t/h: an output of 1 of the network.
    n_inputs
        N, number of inputs, which are the first N elements of the observation.
    n_hidden
        N_1, number of hidden nodes.
    eta
        eta^y, learning rate of W, the weights from the inputs to the hidden nodes.
    eta_1
        eta_1^y, learning rate of W_1, the weights from the hidden nodes to the output.
    eta_theta
        eta_theta^y, learning rate of theta_1, the thresholds of the hidden nodes.
    eta_1_theta
        eta_1theta^y, learning rate of theta_2, the threshold of the output.
    direction
        D(G): -1 for a plant whose output falls when its input rises, 1 for a plant whose output
        rises with its input.
    input_scale
        Factor from elements of the observation, degC, to the inputs X_i of the network. The
        paper does not state this factor.
    weight_scale
        Initial weights and thresholds are random numbers, uniformly distributed in
        [-weight_scale, weight_scale]. The paper only says "selected randomly".
    error_index
        Index of the error e(k), degC, in the observation.
    seed
        Seed of the initial weights.
    num_envs
        Number of loops in a batch, each with its own network; None for a single loop. The
        network of loop i equals that of a single controller with the seed `seed + i`, bit for
        bit.
    learning
        Whether the weights are updated; this attribute can be changed at any time.
    update_interval
        The weights are updated at every `update_interval`-th sample, starting with the first
        sample of an episode.

    Examples
    --------
    >>> import gymnasium, mptc_gym
    >>> from agents import DirectNNController
    >>> env = gymnasium.make("MiddlePoint-v0")
    >>> controller = DirectNNController(seed=0)
    >>> observation, info = env.reset(seed=0)
    >>> for _ in range(1200):
    ...     observation, reward, *_ = env.step(controller.act(observation))
    """

    n_inputs: Size = 6
    n_hidden: Size = 3
    # The learning rates and scales are those of the search `benchmarks.tune nn` in version 0.1.
    eta: NotNegative = 5.3
    eta_1: NotNegative = 0.0303
    eta_theta: NotNegative = 0.0462
    eta_1_theta: NotNegative = 0.0372
    direction: Number = -1
    input_scale: Number = 0.021
    weight_scale: NotNegative = 1.68
    error_index: Index = 3
    seed: Index = 0
    num_envs: int | None = None
    learning: Flag = True
    update_interval: Count = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if abs(self.direction) != 1.0:
            raise ValueError(f"direction must be -1 or 1, got {self.direction!r}")
        if self.num_envs is not None:
            array_size("num_envs", self.num_envs)
        self.n_obs = max(self.n_inputs, self.error_index + 1)
        # Shapes of one network's weights.
        self._shapes = {
            "W": (self.n_hidden, self.n_inputs),
            "theta_1": (self.n_hidden,),
            "W_1": (self.n_hidden,),
            "theta_2": (),
        }
        self.weights = self._initial_weights()

    def _initial_weights(self) -> Weights:
        """Return random initial weights; network i of a batch uses the seed `seed + i`."""
        members = self.num_envs or 1
        generators = [np.random.default_rng(self.seed + i) for i in range(members)]
        arrays: dict[str, Array] = {}
        for name, shape in self._shapes.items():
            scale = self.weight_scale
            draws = [generator.uniform(-scale, scale, shape) for generator in generators]
            arrays[name] = np.array(draws).reshape(self._batch_shape + shape)
        return Weights(**arrays)

    @property
    def _batch_shape(self) -> tuple[int, ...]:
        """The leading axis of the weights of a batch: (num_envs,), or () without a batch."""
        return () if self.num_envs is None else (self.num_envs,)

    @property
    def weights(self) -> Weights:
        """A copy of the current weights; in a batch, each array has a leading batch axis.

        Weights that are assigned must have the shapes of the current weights. In a batch,
        weights without a batch axis are assigned to all networks.

        Raises
        ------
        ValueError
            If an assigned array has a wrong shape or a value that is not finite. The error
            leaves the weights unchanged.
        """
        arrays: dict[str, Array] = {}
        for name, stored in zip(self._shapes, self._arrays, strict=True):
            array = stored.T if self._batch_shape else stored.T[0]
            arrays[name] = np.array(array, order="C")
        return Weights(**arrays)

    @weights.setter
    def weights(self, weights: Weights) -> None:
        """Replace the weights of all networks by copies of `weights`."""
        arrays = []
        for name, shape in self._shapes.items():
            array = check_array(
                f"weights.{name}",
                getattr(weights, name),
                shape,
                self._batch_shape + shape,
                dtype=np.float64,
            )
            batch = np.broadcast_to(array, (self.num_envs or 1, *shape))
            arrays.append(np.array(batch.T, order="C"))
        # The arrays are stored in the order of the fields of `Weights`, and transposed: W has
        # the shape (N, N_1, batch). With the batch axis last, sums over nodes add long rows,
        # which is fast.
        self._arrays = arrays

    def check_environment(self, parameters: Any, wrapped: str, n: int) -> None:
        """Refuse plants that the controller was not made for, by a ValueError.

        The arguments are those of `Controller.check_environment`. In addition to the checks of
        `Controller`, `num_envs` must equal the number of plants, `n`.
        """
        super().check_environment(parameters, wrapped, n)
        if self.num_envs != n:
            raise ValueError(
                f"policy must be made with num_envs={n}, one loop per episode, got "
                f"{self.num_envs or 1}"
            )

    def reset(self) -> None:
        """Begin a new episode, but keep the weights that were learnt."""
        super().reset()
        self._loop_shape = self._batch_shape
        self._sample = 0  # k

    def _control(self, rows: Array) -> Array:
        """Return the commands u(k), t/h, shape (loops,), and update the weights.

        `rows` are the observations, shape (loops, size).
        """
        X = self.input_scale * np.ascontiguousarray(rows[:, : self.n_inputs].T)  # (N, batch)
        e = rows[:, self.error_index]

        W, theta_1, W_1, theta_2 = self._arrays
        X_1 = _sigmoid(_sum_of_rows(W * X[:, np.newaxis]) + theta_1)  # step A
        X_2 = _sigmoid(_sum_of_rows(W_1 * X_1) + theta_2)  # step B
        u = X_2 * (self.u_max - self.u_min) + self.u_min  # last formula of Section 4

        if self.learning and self._sample % self.update_interval == 0:
            delta_1 = e * self.direction * X_2 * (1.0 - X_2)  # equation (27) of the paper
            # The paper's delta uses the weights W_1(k), so it comes before their update.
            delta = delta_1 * W_1 * X_1 * (1.0 - X_1)
            W_1 += self.eta_1 * delta_1 * X_1  # step C
            W += self.eta * delta * X[:, np.newaxis]  # step D
            theta_2 += self.eta_1_theta * delta_1  # step E
            theta_1 += self.eta_theta * delta  # step E
        self._sample += 1
        return u


def _sum_of_rows(terms: Array) -> Array:
    """Return the sum of `terms` over the first axis, added one row after the other.

    With np.sum, the order of additions could depend on the batch size, and a network in a batch
    would not equal a single network bit for bit.
    """
    total: Array = np.add.accumulate(terms, axis=0)[-1]
    return total


def _sigmoid(x: Array) -> Array:
    """Return 1 / (1 + exp(-x)), equation (4) of the paper, without an overflow of exp."""
    activation: Array = 1.0 / (1.0 + np.exp(np.minimum(-x, 700.0)))
    return activation
