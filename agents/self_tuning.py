"""Implement controllers that identify the plant while they control it, by a bank of models."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from agents.bank import Bank, Prior
from agents.controller import Index, ModelBasedController, Positive
from agents.hedge import RandomSetpoint
from agents.law import Law, Network, Observer
from agents.recurrent import RecurrentNetwork

Array = NDArray[np.floating[Any]]

TIME_CONSTANTS: Final = np.array([0.63, 1.0, 1.55])  # in the bank, multiples of the step test's
# Delays in the bank where no range is given, as multiples of the step test's, and the standard
# deviation of their prior.
DELAYS: Final = (0.33, 2.0)
DELAY_SPREAD: Final = 0.33
CONSTANT_SPREAD: Final = 0.3  # standard deviation of the logarithm of the time constant
GAIN_SPREAD: Final = 0.25  # standard deviation of the gain, as a share of the step test's
EXACT: Final = 1e-3  # the same where the gain is not estimated
MOST_DELAYS: Final = 10_000  # in the bank; with more, it would be too large for any computer
CLEARANCE: Final = 1e-4  # of half the range, by which float32 flows clear the dead zone
SLOWEST: Final = 45.0  # samples, the greatest time constant that needs no slower sampling


@dataclass(eq=False, kw_only=True)
class SelfTuningController(ModelBasedController):
    """A predictive controller that identifies the plant while it controls it.

    The controller has four parts:

    - A bank of models with different delays and time constants runs in parallel with the plant.
      Each model is weighted by how well it predicts (D. T. Magill, "Optimal adaptive estimation
      of sampled stochastic processes", IEEE Transactions on Automatic Control 10, 1965,
      434-439). See `agents.bank`.
    - Kalman filters estimate the gain of the plant and the load. See `agents.output_filter`.
    - If the set point is known to change at random, the target falls short of a set point that
      may change before a flow shows. See `agents.hedge`.
    - As in a Smith predictor, the mean model predicts the response to flows in transit, and the
      flow moves the predicted output to the target. See `agents.law`.

    A command is 0 or outside the dead zone, so the models know the flow that passes. All
    quantities are scaled, so the controller serves plants of either sign, with any limits and
    any sampling interval. If the time constant is 90 samples or more, the controller acts at
    every second sample or less often.

    The other parameters are those of `ModelBasedController`.

    Parameters
    ----------
    dead_zone
        The greatest half width that the dead zone may have, t/h.
    delay_range
        Shortest and longest delay that the plant may have, s, including the one sample that any
        input takes to show. All delays in this range are equally likely. By default, the delay
        is between a third and twice the delay of the step test, and a delay near that of the
        step test is more likely.
    setpoint_holds
        Shortest and longest time, s, for which the set point keeps a random level. All times in
        this range are equally likely. By default, nothing is known about changes of the set
        point.
    setpoint_amplitude
        Greatest level of a random set point, degC. The levels are uniformly distributed between
        `-setpoint_amplitude` and `setpoint_amplitude`. It needs `setpoint_holds`.
    setpoint_index, error_index
        Indices of y_d(k) and e(k), degC, in the observation.
    """

    delay_range: tuple[float, float] | None = None
    setpoint_holds: tuple[float, float] | None = None
    setpoint_amplitude: Positive = 5.0
    setpoint_index: Index = 0
    error_index: Index = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        self.n_obs = max(self.setpoint_index, self.error_index) + 1
        self._edge = self.dead_zone
        # A slow plant is sampled less often, so that it looks like those of the training.
        constant = self.time_constant / self.sampling_interval
        self._every = max(1, int(constant / SLOWEST))
        self._constant = constant / self._every
        self._unit_flow = math.copysign((self.u_max - self.u_min) / 2.0, self.gain)  # t/h
        self._authority = self.gain * self._unit_flow  # degC
        self._delays, self._log_probabilities = self._delay_prior()

    def _delay_prior(self) -> tuple[NDArray[np.intp], Array]:
        """Return the delays d of the bank, samples, and the logs of their probabilities."""
        interval = self.sampling_interval * self._every
        likely = self.delay / interval
        shortest, longest = DELAYS[0] * likely, DELAYS[1] * likely
        if self.delay_range is not None:
            limits = _check_range("delay_range", self.delay_range)
            shortest, longest = (limit / interval for limit in limits)
        first = max(math.floor(shortest + 0.5) - 1, 0)
        last = max(math.floor(longest + 0.5) - 1, first)
        count = last - first + 1
        if count > MOST_DELAYS:
            raise ValueError(
                f"delay_range must hold at most {MOST_DELAYS:,} samples, got {count:,}"
            )
        delays = np.arange(first, last + 1)
        if self.delay_range is not None:
            return delays, np.zeros(count)
        off = (delays + 1.0 - likely) / max(DELAY_SPREAD * likely, 1.0)
        return delays, -0.5 * np.square(off)

    @property
    def estimates(self) -> dict[str, Array]:
        """Estimates of the plants, means over the models, each of shape (batch,).

        `gain` (degC per t/h), `time_constant` (s) and `delay` (s, as in the constructor). Empty
        before the first observation.
        """
        if self._k == 0:
            return {}
        estimate, interval = self._bank.estimate, self.sampling_interval * self._every
        return {
            "gain": self.gain * self._observer.filter.gain,
            "time_constant": interval * np.exp(estimate.log_constant),
            "delay": interval * (estimate.delay + 1.0),
        }

    def reset(self) -> None:
        """Forget the episode and the identified plant, as the next plant may be different."""
        super().reset()
        self._k = 0

    def _prior(self, n: int) -> Prior:
        """Return what is known of n plants from the step test."""
        constants = (self._constant * TIME_CONSTANTS)[:, np.newaxis]
        of_constants = -0.5 * np.square(np.log(TIME_CONSTANTS) / CONSTANT_SPREAD)
        logarithms = self._log_probabilities[:, np.newaxis] + of_constants
        return Prior(
            time_constants=np.repeat(constants, n, axis=1),
            shortest_delays=np.full(n, self._delays[0]),
            log_probabilities=np.repeat(logarithms[:, :, np.newaxis], n, axis=2),
            gain_spread=np.full(n, GAIN_SPREAD),
        )

    def _start(self, n: int) -> None:
        """Begin to control n plants at rest."""
        edge = 0.0
        if self.dead_zone > 0.0:
            edge = self.dead_zone / abs(self._unit_flow) + CLEARANCE
        edges = np.full(n, edge, np.float32)
        low, high = sorted([self.u_min / self._unit_flow, self.u_max / self._unit_flow])
        limits = np.full(n, low, np.float32), np.full(n, high, np.float32)
        self._bank = Bank(self._prior(n))
        self._observer = Observer(self._bank, edges, limits, self._random_setpoint())
        self._law = Law(self._bank, edges, limits)

    def _control(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        if self._k == 0:
            self._start(len(rows))
        if self._k % self._every == 0:
            setpoint = rows[:, self.setpoint_index] / self._authority
            output = setpoint - rows[:, self.error_index] / self._authority
            situation = self._observer.observe(
                setpoint.astype(np.float32), output.astype(np.float32)
            )
            flow = self._law.flow(situation, self._network())
            self._bank.apply(flow)
            self._held = self._unit_flow * flow.astype(np.float64)
        self._k += 1
        command: NDArray[np.float64] = self._held
        return command

    def _random_setpoint(self) -> RandomSetpoint | None:
        """Return how the set point changes at random, in samples and of the authority."""
        if self.setpoint_holds is None:
            return None
        limits = _check_range("setpoint_holds", self.setpoint_holds)
        shortest, longest = (limit / self.sampling_interval / self._every for limit in limits)
        return RandomSetpoint(shortest, longest, self.setpoint_amplitude / abs(self._authority))

    def _network(self) -> Network | None:
        """Return the network that corrects the control law; None, as there is none."""
        return None


def _check_range(name: str, limits: Any) -> tuple[float, float]:
    """Return the limits of a range of times, s, if they are valid; otherwise a ValueError."""
    try:
        shortest, longest = map(float, limits)
    except (TypeError, ValueError):
        shortest = longest = math.nan
    if not 0.0 <= shortest <= longest < math.inf:
        raise ValueError(
            f"{name} must be two finite numbers of at least 0, the shortest time first, "
            f"got {limits!r}"
        )
    return shortest, longest


@dataclass(eq=False, kw_only=True)
class NeuralSelfTuningController(SelfTuningController):
    """A self-tuning controller whose control law is corrected by a trained recurrent network.

    The network was trained once, on many simulated plants, and does not learn online. The
    network is computed in float32, so a loop in a batch can differ from a single loop by
    rounding. The parameters are those of `SelfTuningController` and the following.

    Parameters
    ----------
    network
        The weights; by default those that come with the project.
    """

    network: RecurrentNetwork = field(default_factory=RecurrentNetwork.load, repr=False)

    def _start(self, n: int) -> None:
        super()._start(n)
        self._state = self.network.initial_state(n)

    def _network(self) -> Network:
        """Return the network as a function of its inputs, which keeps its state."""
        return self._outputs

    def _outputs(self, inputs: Array) -> Array:
        """Return the network's outputs, shape (n, OUTPUTS), and keep its next state."""
        outputs, self._state = self.network.step(inputs, self._state)
        return outputs


@dataclass(eq=False, kw_only=True)
class NeuralSmithPredictor(NeuralSelfTuningController):
    """A neural controller that trusts a step test, in place of identifying the plant.

    It is a `NeuralSelfTuningController` with a single model, that of the step test, and a known
    gain. It has the same parameters, except `delay_range`.
    """

    delay_range: None = field(init=False, default=None)

    def _prior(self, n: int) -> Prior:
        samples = self.delay / (self.sampling_interval * self._every)
        return Prior(
            time_constants=np.full((1, n), self._constant),
            shortest_delays=np.full(n, max(math.floor(samples + 0.5) - 1, 0)),
            log_probabilities=np.zeros((1, 1, n)),
            gain_spread=np.full(n, EXACT),
        )
