"""Implement a controller that identifies the plant during control, by a bank of models."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mptc_gym.plant.checks import count_from_0, not_negative, positive

from .bank import Bank
from .controller import ModelBasedController
from .hedge import RandomSetpoint
from .law import Law

Array = NDArray[np.floating[Any]]

# Time constants of the candidate models, as multiples of the step test's time constant.
TIME_CONSTANTS: Final = np.array([0.63, 1.0, 1.55])
# Shortest delay, longest delay and standard deviation of the prior distribution of the delay,
# as multiples of the step test's delay, if `delay_range` is None.
SHORTEST_DELAY: Final = 0.33
LONGEST_DELAY: Final = 2.0
DELAY_SPREAD: Final = 0.33
# Prior standard deviation of the natural logarithm of the time constant.
CONSTANT_SPREAD: Final = 0.3
# Distance of the smallest flow from the dead zone, as a share of half the flow range. This
# distance keeps a flow out of the dead zone after rounding to float32.
CLEARANCE: Final = 1e-4
# Longest time constant, in samples, for which the controller's settings were chosen. For a time
# constant that is n times as long, the controller changes the command at every n-th sample.
LONGEST_TIME_CONSTANT: Final = 45.0


def _time_range(name: str, value: Any) -> tuple[float, float] | None:
    """Return the shortest and the longest time in `value`, s, or None if `value` is None."""
    if value is None:
        return None
    shortest, longest = (not_negative(f"each time of {name}", time) for time in value)
    if shortest > longest:
        raise ValueError(f"{name} must begin with the shortest time, got {value!r}")
    return shortest, longest


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

    delay_range: tuple[float, float] | None = None
    setpoint_holds: tuple[float, float] | None = None
    setpoint_amplitude: float = 5.0
    setpoint_index: int = 0
    error_index: int = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check(_time_range, "delay_range", "setpoint_holds")
        self._check(positive, "setpoint_amplitude")
        self._check(count_from_0, "setpoint_index", "error_index")
        self.n_obs = max(self.setpoint_index, self.error_index) + 1
        # The settings suit time constants of up to about `LONGEST_TIME_CONSTANT` samples. So
        # the controller changes the command of a slower plant only at every `_samples_held`-th
        # sample. The time constant is then below twice `LONGEST_TIME_CONSTANT` of these
        # intervals.
        time_constant = self.time_constant / self.sampling_interval  # samples
        self._samples_held = max(1, int(time_constant / LONGEST_TIME_CONSTANT))
        self._interval = self.sampling_interval * self._samples_held  # s
        self._time_constant = time_constant / self._samples_held  # intervals
        # Units of the dimensionless flows, t/h, and temperatures, degC. The unit of flows has
        # the sign of the gain, so that a positive dimensionless flow raises the temperature.
        # The unit of temperatures is the steady temperature change for half the flow range.
        self._unit_flow = math.copysign((self.u_max - self.u_min) / 2.0, self.gain)
        self._unit_temperature = self.gain * self._unit_flow

    def _new_bank(self, n: int) -> Bank:
        """Return the candidate models of n plants, with their prior probabilities."""
        likely = self.delay / self._interval
        if self.delay_range is None:
            shortest = SHORTEST_DELAY * likely
            longest = LONGEST_DELAY * likely
            spread = max(DELAY_SPREAD * likely, 1.0)
        else:
            shortest, longest = (time / self._interval for time in self.delay_range)
            spread = math.inf  # which makes all delays equally likely
        delays = np.arange(_transport_delay(shortest), _transport_delay(longest) + 1)
        # The prior of the delay, and of the logarithm of the time constant, is a normal
        # distribution.
        delay_logarithms = -0.5 * np.square((delays + 1.0 - likely) / spread)
        constant_logarithms = -0.5 * np.square(np.log(TIME_CONSTANTS) / CONSTANT_SPREAD)
        return Bank(
            time_constants=self._time_constant * TIME_CONSTANTS,
            delays=delays,
            log_probabilities=delay_logarithms[:, np.newaxis] + constant_logarithms,
            n=n,
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
            "gain": self.gain * self._law.output_filter.gain,
            "time_constant": self._interval * np.exp(self._bank.log_constant),
            "delay": self._interval * (self._bank.delay + 1.0),
        }

    def reset(self) -> None:
        """Forget past samples and estimates, as the next plant may be different."""
        super().reset()
        self._k = 0  # number of samples since the start of the episode

    def _start(self, n: int) -> None:
        """Create the estimators and the control law for n plants at the start of an episode."""
        edge = 0.0
        if self.dead_zone > 0.0:
            edge = self.dead_zone / abs(self._unit_flow) + CLEARANCE
        # On a plant with a negative gain, the unit of flow is negative, so the limits swap.
        low, high = sorted([self.u_min / self._unit_flow, self.u_max / self._unit_flow])
        self._bank = self._new_bank(n)
        self._law = Law(self._bank, n, edge, (low, high), self._setpoint_distribution())

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
            flow = self._law.flow(setpoint.astype(np.float32), output.astype(np.float32))
            # The commands, t/h, of this sample and of those until the next computation.
            self._held = self._unit_flow * flow.astype(np.float64)
        self._k += 1
        command: NDArray[np.float64] = self._held
        return command
