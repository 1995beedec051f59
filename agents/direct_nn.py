"""Implement the paper's neural controller, trained online from the plant's output error."""

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
    check,
)
from agents.networks import check_array, reading, write

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)  # arrays have no single truth value
class Weights:
    """Weights and thresholds of one network, or of many along a leading batch axis."""

    W: Array
    """W_ij, from input i to hidden node j; shape (N_1, N)."""
    theta_1: Array
    """theta_1j, thresholds of the hidden nodes; shape (N_1,)."""
    W_1: Array
    """W_1j1, from hidden node j to the output; shape (N_1,)."""
    theta_2: Array
    """theta_21, threshold of the output; shape ()."""

    def save(self, path: str | PathLike[str]) -> None:
        """Write the weights to a `.npz` file."""
        write(path, {}, **vars(self))

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Weights:
        """Read weights written by `save`; errors are those of `agents.networks.reading`."""
        with reading(path, "weights") as file:
            return cls(**{field.name: file[field.name] for field in fields(cls)})


@dataclass(eq=False, kw_only=True)
class DirectNNController(Controller):
    """A network of N inputs, N_1 hidden nodes and one output that learns while it controls.

    It implements steps A to E of Section 4 of the paper: the forward pass with the weights of
    sample k, then their update from e(k) and the activations of that pass. All it knows of the
    plant is the direction D(G) of its response.

    Parameters
    ----------
    u_min
        U_min, the lowest command, t/h.
    u_max
        U_max, the highest command, t/h.
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
        D(G): -1 for a plant whose output falls when its input rises, 1 for the opposite.
    input_scale
        Factor from the observation (degC) to the inputs X_i. The paper does not state one.
    weight_scale
        Initial weights and thresholds are drawn uniformly from [-weight_scale, weight_scale].
        The paper says "selected randomly".
    error_index
        Index of e(k), degC, in the observation.
    seed
        Seed of the initial weights.
    num_envs
        Number of loops in a batch, each with its own network; None for a single loop. Member i
        equals a single controller with seed `seed + i`, bit for bit.
    learning
        Whether the weights are updated; it can be changed at any time.
    update_interval
        The weights are updated at every `update_interval`-th sample, starting with the first of
        an episode.

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
    # The gain factors and scales are those of the search `benchmarks.tune nn` in version 0.1.
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
            check("num_envs", self.num_envs, Size)
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
        """Draw the weights of every network of the batch from its own seed."""
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
        """The leading axis of weights and observations: () or (num_envs,)."""
        return () if self.num_envs is None else (self.num_envs,)

    @property
    def weights(self) -> Weights:
        """A copy of the current weights; with `num_envs`, each has a leading batch axis.

        Weights to set must have the same shapes; in a batch, one network's weights set all.

        Raises
        ------
        ValueError
            If a shape does not fit or a value is not finite; the weights are then unchanged.
        """
        arrays: dict[str, Array] = {}
        for name, stored in zip(self._shapes, self._arrays, strict=True):
            array = stored.T if self._batch_shape else stored.T[0]
            arrays[name] = np.array(array, order="C")
        return Weights(**arrays)

    @weights.setter
    def weights(self, weights: Weights) -> None:
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
        # In the order of `Weights`. The batch axis is last, so that sums over nodes add long
        # rows: W is stored as (N, N_1, batch).
        self._arrays = arrays

    def check_environment(self, parameters: Any, wrapped: str, n: int) -> None:
        """Refuse plants that the controller was not made for.

        See `Controller`; here, `num_envs` must be the number of plants, too.
        """
        super().check_environment(parameters, wrapped, n)
        if self.num_envs != n:
            raise ValueError(
                f"policy must be made with num_envs={n}, one loop per episode, got "
                f"{self.num_envs or 1}"
            )

    def reset(self) -> None:
        """Forget the episode, but keep the weights."""
        super().reset()
        self._loops_before = self._batch_shape
        self._sample = 0  # k

    def _control(self, rows: Array) -> Array:
        """Take steps A to E of Section 4: return u, then learn from e."""
        X = self.input_scale * np.ascontiguousarray(rows[:, : self.n_inputs].T)  # (N, batch)
        e = rows[:, self.error_index]

        W, theta_1, W_1, theta_2 = self._arrays
        X_1 = _sigmoid(_sum_of_rows(W * X[:, np.newaxis]) + theta_1)  # A
        X_2 = _sigmoid(_sum_of_rows(W_1 * X_1) + theta_2)  # B
        u = X_2 * (self.u_max - self.u_min) + self.u_min  # Section 4, last formula

        if self.learning and self._sample % self.update_interval == 0:
            delta_1 = e * self.direction * X_2 * (1.0 - X_2)  # (27)
            delta = delta_1 * W_1 * X_1 * (1.0 - X_1)  # D, with W_1(k): before C
            W_1 += self.eta_1 * delta_1 * X_1  # C
            W += self.eta * delta * X[:, np.newaxis]  # D
            theta_2 += self.eta_1_theta * delta_1  # E
            theta_1 += self.eta_theta * delta  # E
        self._sample += 1
        return u


def _sum_of_rows(terms: Array) -> Array:
    """Return the sum over the first axis, added one row after the other.

    The order in which np.sum adds can depend on the batch size, and then a batch would not
    equal its single members bit for bit.
    """
    total: Array = np.add.accumulate(terms, axis=0)[-1]
    return total


def _sigmoid(x: Array) -> Array:
    """Return 1 / (1 + exp(-x)), (4), without overflow."""
    activation: Array = 1.0 / (1.0 + np.exp(np.minimum(-x, 700.0)))
    return activation
