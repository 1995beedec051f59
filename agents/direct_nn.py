"""Implement the paper's neural network controller, which learns from the control error."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from mptc_gym.plant.checks import (
    count_from_0,
    count_from_1,
    not_negative,
    number,
    seed,
)
from mptc_gym.plant.parameters import Parameters

from .controller import Controller
from .networks import read_arrays, write_arrays

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)  # arrays have no single truth value
class Weights:
    """Weights and thresholds of one neural network, or of a batch of neural networks.

    A network has N inputs, N_1 hidden nodes and one output. In a batch of networks, every array
    has an additional first axis, whose length is the number of networks.
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
        """Write the weights to the `.npz` file `path`."""
        write_arrays(path, **vars(self))

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Weights:
        """Return the weights in an `.npz` file that the method `save` has written.

        A ValueError is raised if the file is damaged, and a TypeError if the file has other
        contents than weights.
        """
        return cls(**read_arrays(path))


@dataclass(eq=False, kw_only=True)
class DirectNNController(Controller):
    """The paper's controller: a neural network with one hidden layer that learns online.

    At each sample k, steps A to E of Section 4 of the paper compute the command with the
    present weights, and then update the weights from the error e(k) and the activations of the
    nodes. The only prior knowledge of the plant is D(G), the direction in which the plant's
    output moves when the flow rises.

    Parameters
    ----------
    u_min
        U_min, the actuator's lower limit, t/h: the command for a network output of 0, unless
        `output_share` is below 1.
    u_max
        U_max, the actuator's upper limit, t/h: the command for a network output of 1, unless
        `output_share` is below 1.
    n_inputs
        N, the number of inputs of the network. The inputs are the first N elements of an
        observation, times `input_scale`.
    n_hidden
        N_1, the number of hidden nodes.
    eta
        eta^y, the learning rate of W, the weights from the inputs to the hidden nodes.
    eta_1
        eta_1^y, the learning rate of W_1, the weights from the hidden nodes to the output.
    eta_theta
        eta_theta^y, the learning rate of theta_1, the thresholds of the hidden nodes.
    eta_1_theta
        eta_1theta^y, the learning rate of theta_2, the threshold of the output node.
    direction
        D(G): -1 for a plant whose output falls when the flow rises, and 1 for a plant whose
        output rises with the flow.
    input_scale
        Factor, per degC, that converts elements of an observation to the inputs X_i of the
        network. The paper does not state by what factor temperatures are scaled to inputs of
        the network.
    weight_scale
        Largest size of an initial weight or threshold. Initial weights and thresholds are
        uniformly distributed in [-weight_scale, weight_scale]; the paper only says "selected
        randomly".
    error_index
        Index of the error e(k), degC, in an observation.
    seed
        Seed of the random initial weights.
    num_envs
        Number of control loops in a batch, with one network per loop; None for a single loop.
        Loop i of a batch behaves bit for bit like a single loop with the seed `seed + i`.
    learning
        Whether the weights are updated. The attribute `learning` can be changed at any time.
    update_interval
        Number of samples from one update of the weights to the next. The first update is at the
        first sample of an episode.
    output_share
        Share of the actuator's range that the outputs of the network cover, at most 1. The
        range of the outputs has the centre of the actuator's range. Section 4 of the paper says
        that the outputs should cover this range, or "a little narrower" one.

    Notes
    -----
    The default learning rates are good for about 2,400 samples (5 hours), and in noise for
    1,200. Nothing bounds the weights of a network that never stops learning. On the square
    wave, the error rises after three to five hours, and within a day, in noise within eight
    hours, it is that of the paper's PI controller. Smaller learning rates, or a larger
    `update_interval`, postpone both: the network learns later and is ruined later, in
    proportion. If `learning` is set to False once the network has learnt, the weights stay as
    they are, but no longer follow a plant that changes.

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

    n_inputs: int = 6
    n_hidden: int = 3
    # The random search `benchmarks.tune nn` of version 0.1 found these learning rates and
    # scales.
    eta: float = 5.3
    eta_1: float = 0.0303
    eta_theta: float = 0.0462
    eta_1_theta: float = 0.0372
    direction: float = -1
    input_scale: float = 0.021
    weight_scale: float = 1.68
    error_index: int = 3
    seed: int = 0
    num_envs: int | None = None
    learning: bool = True
    update_interval: int = 1
    output_share: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check(count_from_1, "n_inputs", "n_hidden", "update_interval")
        self._check(not_negative, "eta", "eta_1", "eta_theta", "eta_1_theta", "weight_scale")
        self._check(number, "input_scale")
        self._check(partial(number, low=1e-9, high=1.0), "output_share")
        self._check(count_from_0, "error_index")
        self._check(seed, "seed")
        if self.direction not in (-1, 1):
            raise ValueError(f"direction must be -1 or 1, got {self.direction!r}")
        if self.num_envs is not None:
            self._check(count_from_1, "num_envs")
        self.n_obs = max(self.n_inputs, self.error_index + 1)
        # Shapes of one network's weights, in the order of the fields of `Weights`.
        self._shapes = {
            "W": (self.n_hidden, self.n_inputs),
            "theta_1": (self.n_hidden,),
            "W_1": (self.n_hidden,),
            "theta_2": (),
        }
        self.weights = self._initial_weights()

    def _initial_weights(self) -> Weights:
        """Return random initial weights, with the seed `seed + i` for network i of a batch.

        Each network has a random generator of its own, which draws the arrays in the order of
        `_shapes`, so network i equals the single network with the seed `seed + i`.
        """
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
        """Shape of a batch of networks: (num_envs,), or () for a single network."""
        return () if self.num_envs is None else (self.num_envs,)

    @property
    def weights(self) -> Weights:
        """A copy of the current weights, with the networks of a batch on the first axis.

        Assigned weights must have the shapes of the current weights. The weights of a single
        network can be assigned to all networks of a batch.

        Raises
        ------
        ValueError
            If an assigned array has a wrong shape. A ValueError leaves the weights unchanged.
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
            # NumPy copies the weights of a single network for each network of a batch.
            batch = np.broadcast_to(getattr(weights, name), (self.num_envs or 1, *shape))
            arrays.append(np.array(batch.T, np.float64, order="C"))
        # The arrays are stored transposed, in the order of the fields of `Weights`: W has the
        # shape (N, N_1, batch). With the batch axis last, the sums over nodes are fast, as they
        # add long rows.
        self._arrays = arrays

    def check_environment(self, parameters: Parameters, n: int) -> None:
        """Raise a ValueError if the controller does not fit the plants of an environment.

        The arguments are described in `Controller.check_environment`. In addition to the checks
        of `Controller`, `num_envs` must equal the number of plants, `n`.
        """
        super().check_environment(parameters, n)
        if self.num_envs != n:
            raise ValueError(
                f"policy must have num_envs={n}, one loop per episode, got {self.num_envs}"
            )

    def reset(self) -> None:
        """Begin a new episode, but keep the learnt weights."""
        super().reset()
        self._loop_shape = self._batch_shape
        self._sample = 0  # sample number k

    def _control(self, rows: Array) -> Array:
        """Return the commands u(k), t/h, shape (loops,), and update the weights."""
        X = self.input_scale * np.ascontiguousarray(rows[:, : self.n_inputs].T)  # (N, batch)
        e = rows[:, self.error_index]

        # W has the shape (N, N_1, batch). theta_1, W_1 and X_1 have the shape (N_1, batch), and
        # theta_2 and X_2 the shape (batch,).
        W, theta_1, W_1, theta_2 = self._arrays
        X_1 = _sigmoid(_sum_of_rows(W * X[:, np.newaxis]) + theta_1)  # step A, equation (4)
        X_2 = _sigmoid(_sum_of_rows(W_1 * X_1) + theta_2)  # step B, equation (5)
        actuator_range = self.u_max - self.u_min
        lowest_u = self.u_min + 0.5 * (1.0 - self.output_share) * actuator_range
        u = X_2 * (self.output_share * actuator_range) + lowest_u  # last formula of Section 4

        if self.learning and self._sample % self.update_interval == 0:
            delta_1 = e * self.direction * X_2 * (1.0 - X_2)  # equation (27) of the paper
            # The paper computes delta with W_1(k), so delta must be computed before W_1 is
            # updated.
            delta = delta_1 * W_1 * X_1 * (1.0 - X_1)  # equation (9)
            # Each += changes an array of `self._arrays` in place.
            W_1 += self.eta_1 * delta_1 * X_1  # step C
            W += self.eta * delta * X[:, np.newaxis]  # step D
            theta_2 += self.eta_1_theta * delta_1  # step E
            theta_1 += self.eta_theta * delta  # step E
        self._sample += 1
        return u


def _sum_of_rows(terms: Array) -> Array:
    """Return the sum of `terms` over the first axis, added row by row.

    With np.sum, the order of additions could depend on the batch size, and a network in a batch
    would differ from a single network by rounding.
    """
    total: Array = np.add.accumulate(terms, axis=0)[-1]
    return total


def _sigmoid(x: Array) -> Array:
    """Return 1 / (1 + exp(-x)), equation (4) of the paper, without an overflow of exp."""
    activation: Array = 1.0 / (1.0 + np.exp(np.minimum(-x, 700.0)))
    return activation
