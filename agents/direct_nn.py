"""The paper's neural-network controller, trained online from the output error of the plant."""

from __future__ import annotations

from dataclasses import dataclass, fields
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agents.controller import (
    MOST,
    PAPER_WINDOWS,
    Controller,
    Values,
    check_count,
    check_flag,
    check_number,
    check_numbers,
)

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)  # arrays have no single truth value
class Weights:
    """Weights and thresholds of one network, or with a leading batch axis of many."""

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
        with Path(path).open("wb") as file:
            np.savez(file, **vars(self))

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Weights:
        """Read weights that `save` has written.

        Raises
        ------
        ValueError
            If the file is damaged or does not hold the four arrays.
        """
        names = [field.name for field in fields(cls)]
        with Path(path).open("rb") as raw:
            try:
                with np.load(raw, allow_pickle=False) as file:
                    arrays = {name: file[name] for name in names if name in file}
            except Exception as error:  # damage shows in zip, zlib or NumPy
                raise ValueError(f"{path} holds no weights, or is damaged: {error}") from error
        missing = [name for name in names if name not in arrays]
        if missing:
            raise ValueError(f"{path} must hold weights, {', '.join(missing)} not found")
        return cls(**arrays)


class DirectNNController(Controller):
    """A network of N inputs, N_1 hidden nodes and one output that learns while it controls.

    It implements steps A to E of Section 4 of the paper: the forward pass with the weights of
    sample k, then their update with e(k) and the activations of the same pass. Of the plant it
    knows the direction D(G) of its response and nothing else.

    Parameters
    ----------
    n_inputs
        N, number of inputs: the first N elements of the observation.
    n_hidden
        N_1, number of hidden nodes.
    eta, eta_1
        eta^y and eta_1^y, gain factors of the weights: of W, from the inputs to the hidden
        nodes, and of W_1, from the hidden nodes to the output.
    eta_theta, eta_1_theta
        eta_theta^y and eta_1theta^y, gain factors of the thresholds: of theta_1, those of the
        hidden nodes, and of theta_2, that of the output.
    direction
        D(G), -1 for a plant whose output falls when its input rises, 1 for the opposite.
    input_scale
        Factor from the observation (degC) to the inputs X_i. The paper does not state one.
    weight_scale
        Initial weights and thresholds are uniform in [-weight_scale, weight_scale]. The paper
        says "selected randomly".
    error_index
        Where the observation holds e(k), degC.
    seed
        Of the initial weights.
    num_envs
        Number of loops in a batch, each with a network of its own; None for a single loop.
        Member i is to the bit the single controller with seed `seed + i`.
    learning
        Whether the weights are updated. May be changed at any time.
    update_interval
        The weights are updated at every `update_interval`-th sample, the first of an episode
        included.
    u_min, u_max
        U_min and U_max, t/h: the range of the command.

    Raises
    ------
    ValueError
        If an argument is out of range; the message names it.
    """

    observation = PAPER_WINDOWS  # that the default indices are for

    def __init__(
        self,
        *,
        n_inputs: int = 6,
        n_hidden: int = 3,
        # The gains and both scales: from `python -m benchmarks.tune nn`.
        eta: float = 5.3,
        eta_1: float = 0.0303,
        eta_theta: float = 0.0462,
        eta_1_theta: float = 0.0372,
        direction: int = -1,
        input_scale: float = 0.021,
        weight_scale: float = 1.68,
        error_index: int = 3,
        seed: int = 0,
        num_envs: int | None = None,
        learning: bool = True,
        update_interval: int = 1,
        u_min: float = -10.0,
        u_max: float = 10.0,
    ) -> None:
        self.n_inputs = check_count("n_inputs", n_inputs, 1, MOST)
        self.n_hidden = check_count("n_hidden", n_hidden, 1, MOST)
        self.error_index = check_count("error_index", error_index, 0)
        n_obs = max(self.n_inputs, self.error_index + 1)
        super().__init__(n_obs=n_obs, u_min=u_min, u_max=u_max)
        self.eta = check_number("eta", eta, 0)
        self.eta_1 = check_number("eta_1", eta_1, 0)
        self.eta_theta = check_number("eta_theta", eta_theta, 0)
        self.eta_1_theta = check_number("eta_1_theta", eta_1_theta, 0)
        if abs(check_number("direction", direction)) != 1.0:
            raise ValueError(f"direction must be -1 or 1, got {direction!r}")
        self.direction = direction
        self.input_scale = check_number("input_scale", input_scale)
        self.weight_scale = check_number("weight_scale", weight_scale, 0)
        if not np.isfinite(2.0 * self.weight_scale):  # how wide the initial weights lie
            raise ValueError(f"weight_scale must be at most 8.9e307, got {weight_scale!r}")
        self.num_envs = None if num_envs is None else check_count("num_envs", num_envs, 1, MOST)
        self._batch = () if self.num_envs is None else (self.num_envs,)  # the leading axis
        self.learning = check_flag("learning", learning)
        self.update_interval = check_count("update_interval", update_interval, 1)
        seed = check_count("seed", seed, 0)
        self._shapes = {
            "W": (self.n_hidden, self.n_inputs),
            "theta_1": (self.n_hidden,),
            "W_1": (self.n_hidden,),
            "theta_2": (),
        }
        self._sample = 0  # k
        generators = [np.random.default_rng(seed + i) for i in range(num_envs or 1)]
        scale, batch = self.weight_scale, self._batch
        self.weights = Weights(
            *(
                np.reshape([g.uniform(-scale, scale, shape) for g in generators], batch + shape)
                for shape in self._shapes.values()
            )
        )

    @property
    def weights(self) -> Weights:
        """The present weights, as a copy; with `num_envs`, each with a leading batch axis.

        What is set must have the same shapes; in a batch, those of one network set them all.

        Raises
        ------
        ValueError
            If a shape does not fit or a value is not finite; nothing is changed then.
        """
        batch_last = (self._W.swapaxes(0, 1), self._theta_1, self._W_1, self._theta_2)
        batch_first = (np.moveaxis(array, -1, 0) for array in batch_last)
        which = 0 if self.num_envs is None else slice(None)
        return Weights(*(np.array(array[which], order="C") for array in batch_first))

    @weights.setter
    def weights(self, weights: Weights) -> None:
        if not isinstance(weights, Weights):
            raise ValueError(f"weights must be a Weights, got {weights!r}")
        arrays = []
        for name, shape in self._shapes.items():
            array = check_numbers(f"weights.{name}", getattr(weights, name))
            full_shape = self._batch + shape
            if array.shape not in (shape, full_shape):
                raise ValueError(
                    f"weights.{name} must have shape {full_shape}, got {array.shape}"
                )
            if not np.isfinite(array).all():
                raise ValueError(f"weights.{name} must be finite")
            every = np.broadcast_to(array, (self.num_envs or 1, *shape))
            arrays.append(np.array(np.moveaxis(every, 0, -1), order="C"))
        # The batch axis is last, so that sums over nodes add long rows; W as (N, N_1, batch).
        W, self._theta_1, self._W_1, self._theta_2 = arrays
        self._W = np.array(W.swapaxes(0, 1), order="C")

    def reset(self) -> None:
        """Forget the episode. The weights stay."""
        super().reset()
        self._sample = 0

    def _control(self, observation: Array) -> Values:
        if observation.shape[:-1] != self._batch:
            expected = "(n_obs,)" if self.num_envs is None else f"({self.num_envs}, n_obs)"
            raise ValueError(f"observation must have shape {expected}, got {observation.shape}")
        batch = np.atleast_2d(observation)
        X = self.input_scale * np.ascontiguousarray(batch[:, : self.n_inputs].T)  # (N, batch)
        e = batch[:, self.error_index]

        X_1 = _sigmoid(_sum_of_rows(self._W * X[:, np.newaxis]) + self._theta_1)  # A
        X_2 = _sigmoid(_sum_of_rows(self._W_1 * X_1) + self._theta_2)  # B
        u = X_2 * (self.u_max - self.u_min) + self.u_min  # Section 4, last formula

        if self.learning and self._sample % self.update_interval == 0:
            delta_1 = e * self.direction * X_2 * (1.0 - X_2)  # (27)
            delta = delta_1 * self._W_1 * X_1 * (1.0 - X_1)  # D, with W_1(k): before C
            self._W_1 += self.eta_1 * delta_1 * X_1  # C
            self._W += self.eta * delta * X[:, np.newaxis]  # D
            self._theta_2 += self.eta_1_theta * delta_1  # E
            self._theta_1 += self.eta_theta * delta  # E
        self._sample += 1
        return u[0] if observation.ndim == 1 else u


def _sum_of_rows(terms: Array) -> Array:
    # One after the other, whatever the shape: np.sum may add in another order for another
    # batch size, and then a batch would not be to the bit what its members are alone.
    total: Array = np.add.accumulate(terms, axis=0)[-1]
    return total


def _sigmoid(x: Array) -> Array:
    activation: Array = 1.0 / (1.0 + np.exp(np.minimum(-x, 700.0)))  # (4); no overflow
    return activation
