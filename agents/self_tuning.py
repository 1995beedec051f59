"""Implement controllers that identify the plant during control, by a bank of models."""

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

# Time constants of the candidate models, as multiples of the step test's time constant.
TIME_CONSTANTS: Final = np.array([0.63, 1.0, 1.55])
# Shortest delay, longest delay and standard deviation of the prior distribution of the delay,
# as multiples of the step test's delay, for controllers without the argument `delay_range`.
SHORTEST_DELAY: Final = 0.33
LONGEST_DELAY: Final = 2.0
DELAY_SPREAD: Final = 0.33
# Prior standard deviation of the natural logarithm of the time constant.
CONSTANT_SPREAD: Final = 0.3
# Prior standard deviation of the gain, divided by the step test's gain.
GAIN_SPREAD: Final = 0.25
KNOWN_GAIN_SPREAD: Final = 1e-3  # for a gain that is assumed to be known
# Greatest number of candidate delays. More delays would need too much memory.
MOST_DELAYS: Final = 10_000
# Distance of the smallest flow from the dead zone, as a share of half the flow range. This
# distance keeps a flow out of the dead zone after rounding to float32.
CLEARANCE: Final = 1e-4
# Longest time constant, in samples, of most plants in the training of the networks. For an n
# times longer time constant, the controller changes the command at every n-th sample.
TRAINED_TIME_CONSTANT: Final = 45.0


def _time_range(name: str, value: Any) -> tuple[float, float] | None:
    """Return the shortest and the longest time in `value`, s, or None if `value` is None.

    A ValueError for the argument `name` is raised unless `value` is None or two finite numbers
    of at least 0, the shortest time first.
    """
    if value is None:
        return None
    try:
        shortest, longest = map(float, value)
    except (TypeError, ValueError):
        shortest = longest = math.nan  # which is an error below
    if not 0.0 <= shortest <= longest < math.inf:
        raise ValueError(
            f"{name} must be two finite numbers of at least 0, the shortest time first, "
            f"got {value!r}"
        )
    return shortest, longest


TimeRange = Annotated[tuple[float, float] | None, _time_range]


def _transport_delay(delay: float) -> int:
    """Return the transport delay d of equation (28) of the paper, a whole number of samples.

    `delay`, in samples, is the time d + 1 from a change of the command to the first sampled
    output that changes.
    """
    return max(math.floor(delay + 0.5) - 1, 0)


@dataclass(eq=False, kw_only=True)
class SelfTuningController(ModelBasedController):
    """A predictive controller that identifies the plant during control.

    The controller has four parts:

    - Candidate models with different delays and time constants run in parallel with the plant
      (`agents.bank`). A model with small prediction errors has a large weight (Magill, "Optimal
      adaptive estimation of sampled stochastic processes", IEEE Transactions on Automatic
      Control 10, 1965, 434-439).
    - Kalman filters estimate the plant's gain and load disturbance (`agents.output_filter`).
    - If `setpoint_holds` is given, the target of the output lies between the set point and 0,
      because the set point may change within the plant's delay (`agents.hedge`).
    - As in a Smith predictor, the models predict the effect of past flows that have not yet
      affected the output. The next flow moves the predicted output towards the target
      (`agents.law`).

    Every command is 0 or outside the dead zone. The controller suits plants with a positive or
    negative gain, any flow limits outside the dead zone and any sampling interval, because all
    internal quantities are dimensionless. On a plant with a time constant of 90 samples or
    more, the controller changes the command at every second sample or less often.

    All other parameters are described in `ModelBasedController`.

    Parameters
    ----------
    dead_zone
        Greatest possible half width of the actuator's dead zone, t/h.
    delay_range
        Shortest and longest possible delay of the plant, s, from a change of the command to the
        first sampled output that changes. All delays in `delay_range` are equally likely. If
        `delay_range` is None, the prior of the delay is a normal distribution around `delay`,
        from a third of `delay` to twice `delay`.
    setpoint_holds
        Shortest and longest time between two changes of a random set point, s. All times in
        `setpoint_holds` are equally likely. If `setpoint_holds` is None, the target of the
        output is the present set point.
    setpoint_amplitude
        Amplitude A of a random set point, degC. Random set points are uniformly distributed
        between -A and A. The amplitude has no effect if `setpoint_holds` is None.
    setpoint_index, error_index
        Indices of the set point y_d(k) and the error e(k), both in degC, in an observation.
    """

    delay_range: TimeRange = None
    setpoint_holds: TimeRange = None
    setpoint_amplitude: Positive = 5.0
    setpoint_index: Index = 0
    error_index: Index = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        self.n_obs = max(self.setpoint_index, self.error_index) + 1
        # On a slow plant, the controller changes the command at every `_samples_held`-th
        # sample. The time constant, divided by the interval between these samples, is then at
        # most twice `TRAINED_TIME_CONSTANT`.
        time_constant = self.time_constant / self.sampling_interval  # samples
        self._samples_held = max(1, int(time_constant / TRAINED_TIME_CONSTANT))
        self._interval = self.sampling_interval * self._samples_held  # s
        self._time_constant = time_constant / self._samples_held  # intervals
        # Units of the dimensionless flows, t/h, and temperatures, degC. The unit of flows has
        # the sign of the gain, so that a positive dimensionless flow raises the temperature.
        # The unit of temperatures is the steady temperature change for half the flow range.
        self._unit_flow = math.copysign((self.u_max - self.u_min) / 2.0, self.gain)
        self._unit_temperature = self.gain * self._unit_flow
        self._prior = self._prior_of_plant()
        self._random_setpoint = self._setpoint_distribution()

    def _prior_of_plant(self) -> Prior:
        """Return the candidate models of one plant and their prior probabilities.

        A ValueError is raised if `delay_range`, or by default the range that follows from
        `delay`, contains more than `MOST_DELAYS` candidate delays.
        """
        likely = self.delay / self._interval
        if self.delay_range is None:
            shortest = SHORTEST_DELAY * likely
            longest = LONGEST_DELAY * likely
            spread = max(DELAY_SPREAD * likely, 1.0)
        else:
            shortest, longest = (time / self._interval for time in self.delay_range)
            spread = math.inf  # which makes all delays equally likely
        first = _transport_delay(shortest)
        delays = np.arange(first, _transport_delay(longest) + 1)
        if len(delays) > MOST_DELAYS:
            raise ValueError(
                f"delay_range must cover at most {MOST_DELAYS:,} samples of delay, "
                f"got {len(delays):,}"
            )
        # The prior of the delay, and of the logarithm of the time constant, is a normal
        # distribution.
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

        Times are divided by the interval between changes of the command, and the amplitude is
        in units of the steady temperature change for half the flow range.
        """
        if self.setpoint_holds is None:
            return None
        shortest, longest = (
            time / self.sampling_interval / self._samples_held for time in self.setpoint_holds
        )
        amplitude = self.setpoint_amplitude / self._unit_temperature
        return RandomSetpoint(shortest, longest, amplitude)

    @property
    def estimates(self) -> dict[str, Array]:
        """Present estimates of the plants' parameters, a dict of arrays of shape (batch,).

        The keys of the dict are `gain` (degC per t/h), `time_constant` (s) and `delay` (s, from
        a change of the command to the first sampled output that changes). Before the first
        observation of an episode, the dict is empty.
        """
        if self._k == 0:
            return {}
        return {
            "gain": self.gain * self._observer.filter.gain,
            "time_constant": self._interval * np.exp(self._bank.log_constant),
            "delay": self._interval * (self._bank.delay + 1.0),
        }

    def reset(self) -> None:
        """Forget past samples and estimates, as the next plant may be different."""
        super().reset()
        self._k = 0

    def _start(self, n: int) -> None:
        """Create the estimators and the control law for n plants at the start of an episode."""
        edge = 0.0
        if self.dead_zone > 0.0:
            edge = self.dead_zone / abs(self._unit_flow) + CLEARANCE
        edges = np.full(n, edge, np.float32)
        low, high = sorted([self.u_min / self._unit_flow, self.u_max / self._unit_flow])
        limits = np.full(n, low, np.float32), np.full(n, high, np.float32)
        self._bank = Bank(self._prior.repeated(n))
        self._observer = Observer(self._bank, edges, limits, self._random_setpoint)
        self._law = Law(self._bank, edges, limits)
        # Function that computes the corrections of the control law; None for no corrections.
        self._corrections: Network | None = None

    def _control(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the commands u(k), t/h, shape (loops,), and update the estimates.

        On a plant with a time constant of 90 samples or more, many calls return the commands of
        the previous call.
        """
        if self._k == 0:
            self._start(len(rows))
        if self._k % self._samples_held == 0:
            setpoint = rows[:, self.setpoint_index] / self._unit_temperature
            output = setpoint - rows[:, self.error_index] / self._unit_temperature
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

    The network was trained in advance on many simulated plants, and does not learn online. The
    network is computed in float32, so the command for a loop can differ by rounding between a
    batch and a single loop.

    All other parameters are described in `SelfTuningController`.

    Parameters
    ----------
    network
        Trained network; by default, the network in the file
        `agents/pretrained/neural-10000.npz`.
    """

    network: RecurrentNetwork = field(default_factory=RecurrentNetwork.load, repr=False)

    def _start(self, n: int) -> None:
        """Create the estimators, the control law and the network's state for n plants."""
        super()._start(n)
        self._state = self.network.initial_state(n)
        self._corrections = self._next_outputs

    def _next_outputs(self, inputs: Array) -> Array:
        """Return the network's outputs, shape (n, OUTPUTS), and store the network's next state.

        `inputs` are the inputs of the network at one sample, shape (n, INPUTS).
        """
        outputs, self._state = self.network.step(inputs, self._state)
        return outputs


@dataclass(eq=False, kw_only=True)
class NeuralSmithPredictor(NeuralSelfTuningController):
    """A neural controller that relies on a step test, and does not identify the plant.

    The controller is a `NeuralSelfTuningController` whose only candidate model is the model
    from the step test, with a gain that hardly changes. All parameters except `delay_range` are
    described in `NeuralSelfTuningController`.
    """

    delay_range: None = field(init=False, default=None)

    def _prior_of_plant(self) -> Prior:
        """Return a prior whose only candidate model is the model from the step test."""
        return Prior(
            time_constants=[[self._time_constant]],
            shortest_delays=[_transport_delay(self.delay / self._interval)],
            log_probabilities=[[[0.0]]],
            gain_spread=[KNOWN_GAIN_SPREAD],
        )
