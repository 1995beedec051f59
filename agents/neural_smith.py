"""Implement a trained network that acts on a nominal model, as a Smith predictor does."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from agents.controller import PAPER_WINDOWS, Index, ModelBasedController, NotNegative, Values
from agents.neural_law import Law, LawNetwork, Prior

Array = NDArray[np.float64]

NOMINAL = 20.62  # samples, the time constant of the paper's plant
SLOWEST = 45.0  # samples, the largest time constant that the network was trained on


@dataclass(eq=False, kw_only=True)
class NeuralSmithPredictor(ModelBasedController):
    """A trained network with a nominal model of the plant.

    As in a Smith predictor, a model runs in parallel with the plant, so the response to past
    flows is known before the delay is over. The network sees the model's output, the part of
    the measured output that the model does not explain, and the model's numbers; see
    `agents.neural_law`. It was trained once, on many plants, and does not learn online. All its
    inputs are scaled by the flow's authority and by the sampling interval, so one set of
    weights serves plants of either sign, with any limits and any sampling interval. With a
    first-order model and a time constant of at least 90 samples, it acts every second sample or
    less often.

    The other parameters are those of `ModelBasedController`.

    Parameters
    ----------
    coefficients
        A and B of the stable plant, if more than a first-order model is known: `a[0]` is 1, and
        `b` begins with z^-1. Their gain replaces `gain`.
    uncertainty
        Standard deviation of the gain, as a share of it; 0 where the numbers are exact. It also
        stands for the time constant, which may be wrong by half as much again, and for the
        delay: 0.1 means two samples.
    setpoint_index
        Index of y_d(k), degC, in the observation.
    error_index
        Index of e(k), degC, in the observation.
    network
        The weights; by default those that come with the project.
    """

    coefficients: tuple[Sequence[float], Sequence[float]] | None = None
    uncertainty: NotNegative = 0.0
    setpoint_index: Index = 0
    error_index: Index = 3
    network: LawNetwork = field(default_factory=LawNetwork.load, repr=False)

    observation = PAPER_WINDOWS  # for the default indices

    def __post_init__(self) -> None:
        super().__post_init__()
        self.n_obs = max(self.setpoint_index, self.error_index) + 1
        self._edge = self.dead_zone
        constant = self.time_constant / self.sampling_interval
        self._is_first_order = self.coefficients is None
        self._every = max(1, int(constant / SLOWEST)) if self._is_first_order else 1
        constant /= self._every
        pole = math.exp(-1.0 / constant)
        if self.coefficients is None:
            self._a, self._b = np.array([1.0, -pole]), np.array([self.gain * (1.0 - pole)])
        else:
            self._a, self._b = _checked(self.coefficients)
        gain = self._b.sum() / self._a.sum()
        half = (self.u_max - self.u_min) / 2.0
        self._flow = math.copysign(half, gain)  # t/h at a flow of 1
        self._authority = abs(gain) * half
        self._b = self._b / gain
        self._delay = max(round(self._delay_samples / self._every) - 1, 0)
        self._about = {
            "unit": self._a.sum(),
            "fading": pole ** (self._delay + (1.5 if self._is_first_order else 1.0)),
            "time_constant": min(max(constant / NOMINAL, 0.3), 3.3),
            "delay": min(self._delay, 44),
            "dead_zone": self.dead_zone / half,
            "centre": (self.u_max + self.u_min) / 2.0 / self._flow,
            "uncertainty": self.uncertainty,
        }
        self._law: Law | None = None

    def reset(self) -> None:
        """Forget the episode, and return the model to rest."""
        super().reset()
        self._law = None

    def _control(self, observation: Array) -> Values:
        rows = np.atleast_2d(observation)
        n = len(rows)
        if self._law is None:
            self._law = Law(Prior(**{name: np.full(n, x) for name, x in self._about.items()}))
            # Undelayed outputs of the model, residuals and flows that passed; newest first.
            self._model = np.zeros((self._delay + len(self._a) + 1, n))
            self._residual = np.zeros((len(self._a), n))
            self._flows = np.zeros((len(self._b), n))
            self._off = np.zeros(n)
            self._k = 0
        if self._k % self._every == 0:
            self._last = self._decide(self._law, rows)
        self._k += 1
        command = self._last
        return command if observation.ndim == 2 else np.float64(command[0])

    def _decide(self, law: Law, rows: Array) -> Array:
        setpoint = rows[:, self.setpoint_index] / self._authority
        output = setpoint - rows[:, self.error_index] / self._authority
        model, residual, flows = self._model, self._residual, self._flows
        residual[1:] = residual[:-1].copy()
        off = output - model[self._delay]
        # First-order models miss fast dynamics, which the average of two samples reduces.
        residual[0] = (off + self._off) / 2.0 if self._is_first_order else off
        self._off = off
        state = model[0], model[1], flows[0]
        wanted = law.flow(self.network, setpoint, residual[0], self._a @ residual, state)
        wanted, passed = law.applied(wanted)
        flows[1:] = flows[:-1].copy()
        flows[0] = passed
        new = self._b @ flows - self._a[1:] @ model[: len(self._a) - 1]
        model[1:] = model[:-1].copy()
        model[0] = new
        command: Array = self._flow * wanted
        return command


def _checked(coefficients: tuple[Sequence[float], Sequence[float]]) -> tuple[Array, Array]:
    """Return A and B if they describe a stable plant with a gain other than 0."""
    a, b = (np.array(each, dtype=np.float64) for each in coefficients)
    stable = a.ndim == b.ndim == 1 and len(a) and a[0] == 1.0 and np.isfinite([*a, *b]).all()
    if not (stable and np.all(np.abs(np.roots(a)) < 1.0) and b.sum() != 0.0):
        raise ValueError(
            "coefficients must be A and B of a stable plant with a gain, A beginning with 1, "
            f"got {coefficients!r}"
        )
    return a, b
