"""Implement controllers that identify the plant by a bank of models, while they control it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import NDArray

from agents.bank import Bank, Prior
from agents.controller import Index, ModelBasedController, Positive
from agents.hedge import RandomSetpoint
from agents.law import Law, Network, Observer
from agents.recurrent import RecurrentNetwork

Array = NDArray[np.floating[Any]]

# Time constants of the bank's models, as multiples of the step test's time constant.
TIME_CONSTANTS: Final = np.array([0.63, 1.0, 1.55])
# Prior distribution of the delay without the argument `delay_range`: shortest delay, longest
# delay and standard deviation, as multiples of the step test's delay.
SHORTEST_DELAY: Final = 0.33
LONGEST_DELAY: Final = 2.0
DELAY_SPREAD: Final = 0.33
# Standard deviation of the natural logarithm of the time constant in the prior.
CONSTANT_SPREAD: Final = 0.3
# Standard deviation of the gain in the prior, as a share of the step test's gain.
GAIN_SPREAD: Final = 0.25
KNOWN_GAIN_SPREAD: Final = 1e-3  # of a gain that counts as known
# Greatest number of delays in a bank; a bank with more would not fit into the memory.
MOST_DELAYS: Final = 10_000
# Distance of the smallest flow from the dead zone, as a share of half the actuator's range:
# enough for flows that are rounded to float32.
CLEARANCE: Final = 1e-4
# Longest time constant, samples, of most plants on which the networks were trained. On a plant
# with an n times longer time constant, the controller acts at every n-th sample.
TRAINED_TIME_CONSTANT: Final = 45.0


def _time_range(name: str, value: Any) -> tuple[float, float] | None:
    """Return the shortest and the longest time of the range `value`, s; None for None.

    A ValueError, which names the argument `name`, is raised unless both times are finite
    numbers of at least 0, the shortest time first.
    """
    if value is None:
        return None
    try:
        shortest, longest = map(float, value)
    except (TypeError, ValueError):
        shortest = longest = math.nan  # which is refused below
    if not 0.0 <= shortest <= longest < math.inf:
        raise ValueError(
            f"{name} must be two finite numbers of at least 0, the shortest time first, "
            f"got {value!r}"
        )
    return shortest, longest


TimeRange = Annotated[tuple[float, float] | None, _time_range]


def _transport_delay(delay: float) -> int:
    """Return the transport delay d of equation (28) of the paper, samples.

    `delay` is the time d + 1 from a change of the flow to the first change of a sampled output,
    in samples. A fraction is rounded.
    """
    return max(math.floor(delay + 0.5) - 1, 0)


@dataclass(eq=False, kw_only=True)
class SelfTuningController(ModelBasedController):
    """A predictive controller that identifies the plant while it controls it.

    The controller has four parts:

    - A bank of models with different delays and time constants runs in parallel with the plant.
      Each model is weighted by how well it predicts (Magill, "Optimal adaptive estimation of
      sampled stochastic processes", IEEE Transactions on Automatic Control 10, 1965, 434-439).
      See `agents.bank`.
    - Kalman filters estimate the gain of the plant and the load. See `agents.output_filter`.
    - If the set point is known to change at random, the target for the output lies between the
      set point and 0, as the set point may change before a flow shows. See `agents.hedge`.
    - As in a Smith predictor, the mean of the models predicts the effect of flows that have not
      yet shown in the output, and the next flow moves the predicted output to the target. See
      `agents.law`.

    A command is 0 or outside the dead zone, so the flow that passes the actuator is known. All
    quantities are scaled, so the controller suits plants with a gain of either sign, with any
    limits and any sampling interval. If the time constant is 90 samples or more, the controller
    changes the command at every second sample or less often.

    The other parameters are those of `ModelBasedController`.

    Parameters
    ----------
    dead_zone
        The greatest half width that the dead zone may have, t/h.
    delay_range
        Shortest and longest delay that the plant may have, s, defined as the argument `delay`.
        All delays in this range are equally likely. By default, the delay is between a third of
        `delay` and twice `delay`, and most likely near `delay`.
    setpoint_holds
        Shortest and longest time, s, for which the set point keeps a random level. All times in
        this range are equally likely. By default, nothing is known about changes of the set
        point.
    setpoint_amplitude
        Greatest level of a random set point, degC. The levels are uniformly distributed between
        `-setpoint_amplitude` and `setpoint_amplitude`. Without `setpoint_holds`, the argument
        `setpoint_amplitude` has no effect.
    setpoint_index, error_index
        Indices of the set point y_d(k) and of the error e(k), both in degC, in the observation.
    """

    delay_range: TimeRange = None
    setpoint_holds: TimeRange = None
    setpoint_amplitude: Positive = 5.0
    setpoint_index: Index = 0
    error_index: Index = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        self.n_obs = max(self.setpoint_index, self.error_index) + 1
        # The controller changes the command less often on a slow plant. Measured in intervals
        # between changes, the plant then is as fast as those of the networks' training.
        time_constant = self.time_constant / self.sampling_interval  # samples
        self._samples_held = max(1, int(time_constant / TRAINED_TIME_CONSTANT))
        self._interval = self.sampling_interval * self._samples_held  # s
        self._time_constant = time_constant / self._samples_held  # intervals
        # The unit of flows, t/h, is negative for a negative gain: a positive scaled flow raises
        # the temperature. The unit of temperatures, degC, is the authority.
        self._unit_flow = math.copysign((self.u_max - self.u_min) / 2.0, self.gain)
        self._authority = self.gain * self._unit_flow
        self._prior = self._prior_of_plant()
        self._random_setpoint = self._setpoint_distribution()

    def _prior_of_plant(self) -> Prior:
        """Return the prior knowledge of one plant: the bank's models and their probabilities.

        A ValueError is raised if the bank would have too many delays.
        """
        likely = self.delay / self._interval
        if self.delay_range is None:
            shortest = SHORTEST_DELAY * likely
            longest = LONGEST_DELAY * likely
            spread = max(DELAY_SPREAD * likely, 1.0)
        else:
            shortest, longest = (time / self._interval for time in self.delay_range)
            spread = math.inf  # all delays are equally likely
        first = _transport_delay(shortest)
        delays = np.arange(first, _transport_delay(longest) + 1)
        if len(delays) > MOST_DELAYS:
            raise ValueError(
                f"delay_range must hold at most {MOST_DELAYS:,} samples, got {len(delays):,}"
            )
        # The delay and the logarithm of the time constant are normally distributed.
        delay_logarithms = -0.5 * np.square((delays + 1.0 - likely) / spread)
        constant_logarithms = -0.5 * np.square(np.log(TIME_CONSTANTS) / CONSTANT_SPREAD)
        logarithms = delay_logarithms[:, np.newaxis] + constant_logarithms
        return Prior(
            time_constants=(self._time_constant * TIME_CONSTANTS)[:, np.newaxis],
            shortest_delays=[first],
            log_probabilities=logarithms[:, :, np.newaxis],
            gain_spread=[GAIN_SPREAD],
        )

    def _setpoint_distribution(self) -> RandomSetpoint | None:
        """Return the distribution of random set points; None if `setpoint_holds` is None.

        Times are in intervals between changes of the command, and the amplitude is in units of
        the authority (see `agents.bank`).
        """
        if self.setpoint_holds is None:
            return None
        shortest, longest = (
            time / self.sampling_interval / self._samples_held for time in self.setpoint_holds
        )
        return RandomSetpoint(shortest, longest, self.setpoint_amplitude / self._authority)

    @property
    def estimates(self) -> dict[str, Array]:
        """The present estimates of the plants' parameters by name, each of shape (batch,).

        The names are `gain` (degC per t/h), `time_constant` (s) and `delay` (s, defined as the
        argument `delay`). Before the first observation of an episode, the dict is empty.
        """
        if self._k == 0:
            return {}
        return {
            "gain": self.gain * self._observer.filter.gain,
            "time_constant": self._interval * np.exp(self._bank.log_constant),
            "delay": self._interval * (self._bank.delay + 1.0),
        }

    def reset(self) -> None:
        """Forget past samples and the identified plant, as the next plant may be different."""
        super().reset()
        self._k = 0

    def _start(self, n: int) -> None:
        """Make the bank, the observer and the control law for n plants at rest.

        `_control` calls this method at the first sample of an episode.
        """
        edge = 0.0
        if self.dead_zone > 0.0:
            edge = self.dead_zone / abs(self._unit_flow) + CLEARANCE
        edges = np.full(n, edge, np.float32)
        low, high = sorted([self.u_min / self._unit_flow, self.u_max / self._unit_flow])
        limits = np.full(n, low, np.float32), np.full(n, high, np.float32)
        self._bank = Bank(self._prior.repeated(n))
        self._observer = Observer(self._bank, edges, limits, self._random_setpoint)
        self._law = Law(self._bank, edges, limits)
        # Function that computes corrections of the control law; None for no corrections.
        self._corrections: Network | None = None

    def _control(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the commands u(k), t/h, shape (loops,), and update the identified models.

        `rows` are the observations, shape (loops, size). If the plant is slow, most calls
        repeat the last command.
        """
        if self._k == 0:
            self._start(len(rows))
        if self._k % self._samples_held == 0:
            setpoint = rows[:, self.setpoint_index] / self._authority
            output = setpoint - rows[:, self.error_index] / self._authority
            situation = self._observer.observe(
                setpoint.astype(np.float32), output.astype(np.float32)
            )
            flow = self._law.flow(situation, self._corrections)
            self._bank.apply(flow)
            self._held = self._unit_flow * flow.astype(np.float64)
        self._k += 1
        command: NDArray[np.float64] = self._held
        return command


@dataclass(eq=False, kw_only=True)
class NeuralSelfTuningController(SelfTuningController):
    """A self-tuning controller whose control law is corrected by a trained recurrent network.

    The network was trained in advance, on many simulated plants, and does not learn online. The
    network is computed in float32, so the command for a loop can differ by rounding between a
    batch and a single loop. The other parameters are those of `SelfTuningController`.

    Parameters
    ----------
    network
        The trained network; by default the network in the folder `agents/pretrained`.
    """

    network: RecurrentNetwork = field(default_factory=RecurrentNetwork.load, repr=False)

    def _start(self, n: int) -> None:
        """Make bank, observer, control law and the network's state for n plants at rest."""
        super()._start(n)
        self._state = self.network.initial_state(n)
        self._corrections = self._next_outputs

    def _next_outputs(self, inputs: Array) -> Array:
        """Return the network's outputs, shape (n, OUTPUTS), and store the network's next state.

        `inputs` are the inputs of a sample, shape (n, INPUTS). Call this method once per
        sample.
        """
        outputs, self._state = self.network.step(inputs, self._state)
        return outputs


@dataclass(eq=False, kw_only=True)
class NeuralSmithPredictor(NeuralSelfTuningController):
    """A neural controller that trusts a step test, and does not identify the plant.

    The controller is a `NeuralSelfTuningController` whose bank has a single model, that of the
    step test, and whose gain counts as known. The parameters are those of
    `NeuralSelfTuningController`, without `delay_range`.
    """

    delay_range: None = field(init=False, default=None)

    def _prior_of_plant(self) -> Prior:
        """Return the prior knowledge of a plant: its only model is that of the step test."""
        return Prior(
            time_constants=[[self._time_constant]],
            shortest_delays=[_transport_delay(self.delay / self._interval)],
            log_probabilities=[[[0.0]]],
            gain_spread=[KNOWN_GAIN_SPREAD],
        )
