"""Implement a controller that identifies the plant during control."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mptc_gym.plant.actuator import applied_flow, avoid_dead_zone
from mptc_gym.plant.checks import count_from_0, not_negative, positive

from .controller import ModelBasedController
from .estimator import Candidates, Estimator
from .hedge import RandomSetpoint

Array = NDArray[np.float64]

# Candidate time constants, as multiples of the step test's time constant.
TIME_CONSTANTS: Final = np.array([0.63, 1.0, 1.55])
# Shortest delay, longest delay and standard deviation of the prior distribution of the delay,
# as multiples of the step test's delay, if `delay_range` is None.
SHORTEST_DELAY: Final = 0.33
LONGEST_DELAY: Final = 2.0
DELAY_SPREAD: Final = 0.33
# Prior standard deviation of the natural logarithm of the time constant.
CONSTANT_SPREAD: Final = 0.3
# Share of the gap between the response and its target that a flow closes in one sample.
CLOSED_SHARE: Final = 0.5
REACTION: Final = 2.0  # samples, after the delay, that the output takes to respond to a flow
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

    - Candidates for the plant have different delays, time constants and load disturbances. One
      linear filter gives the gain, the probability and the forecast of each candidate
      (`agents.estimator`, with the derivation).
    - If `setpoint_holds` is given, the target of the output lies between the set point and 0,
      because the set point may change within the plant's delay (`agents.hedge`).
    - As in a Smith predictor, the next flow moves the predicted output towards the target. The
      prediction includes the effect of past flows that have not yet affected the output.

    The candidates have the fast pole, the ratio of the coefficients of B and the coefficient of
    z^-1 in C of equation (28) of the paper.

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
        self._candidates = self._new_candidates()
        self._random_setpoint = self._setpoint_distribution()

    def _new_candidates(self) -> Candidates:
        """Return the candidates for a plant, with their prior probabilities."""
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
        # The delay from a command to the first output that changes is d + 1 samples.
        delay_logarithms = -0.5 * np.square((delays + 1.0 - likely) / spread)
        constant_logarithms = -0.5 * np.square(np.log(TIME_CONSTANTS) / CONSTANT_SPREAD)
        return Candidates(
            time_constants=self._time_constant * TIME_CONSTANTS,
            delays=delays,
            log_priors=delay_logarithms[:, np.newaxis] + constant_logarithms,
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
            "gain": self.gain * self._estimate.gain,
            "time_constant": self._interval * self._estimate.time_constant,
            "delay": self._interval * (self._estimate.delay + 1.0),
        }

    def reset(self) -> None:
        """Forget past samples and estimates, as the next plant may be different."""
        super().reset()
        self._k = 0  # number of samples since the start of the episode

    def _control(self, rows: Array) -> Array:
        """Return the commands u(k), t/h, shape (loops,), and update the estimates.

        On a plant with a time constant of 90 samples or more, many calls return the commands of
        the previous call.
        """
        if self._k == 0:
            self._start(rows)
        if self._k % self._samples_held == 0:  # else the commands are held
            setpoint = rows[:, self.setpoint_index] / self._unit_temperature
            output = setpoint - rows[:, self.error_index] / self._unit_temperature
            self._estimate = self._estimator.observe(output)
            wanted = self._unit_flow * self._wanted_flow(self._target(setpoint))
            outside = avoid_dead_zone(wanted, self.dead_zone)
            # The commands, t/h, of this sample and of those until the next computation.
            self._held: Array = np.clip(outside, self.u_min, self.u_max)
            applied = applied_flow(self._held, self.dead_zone, self.u_min, self.u_max)
            self._estimator.apply(applied / self._unit_flow)  # which the next outputs need
        self._k += 1
        return self._held

    def _start(self, rows: Array) -> None:
        """Create the estimator at the start of an episode, from its first observations."""
        n = len(rows)
        self._estimator = Estimator(self._candidates, n)
        self._last_setpoint = rows[:, self.setpoint_index] / self._unit_temperature
        # Number of samples since the last change of the set point. Before the first change, the
        # number of observations since the start of the episode.
        self._age = np.zeros(n)

    def _target(self, setpoint: Array) -> NDArray[np.floating[Any]]:
        """Return the outputs at which the flows of this sample aim, shape (n,).

        `setpoint` are the set points y_d(k), shape (n,). The unit of set points and outputs is
        the steady temperature change for half the flow range.
        """
        self._age = np.where(setpoint == self._last_setpoint, self._age + 1.0, 0.0)
        self._last_setpoint = setpoint
        if self._random_setpoint is None:
            return setpoint
        # Samples until the output has responded to the present flow, and probability that the
        # set point does not change before.
        ahead = self._estimate.delay + 1.0 + REACTION
        held = self._random_setpoint.probability_held(self._age, ahead)
        return self._random_setpoint.targets(setpoint, held, self._estimate.deviation)

    def _wanted_flow(self, target: NDArray[np.floating[Any]]) -> Array:
        """Return the flows u(k) that move the outputs towards `target`, shape (n,).

        Flows and temperatures are dimensionless, as in `agents.estimator`. Dead zone and limits
        have no effect on the result.
        """
        estimate = self._estimate
        # By (a) in `agents.estimator`, the output y(k+d+1) is g s(k+1) + r(k+d+1), so this is
        # the target of the response g s.
        wanted = target - estimate.forecast
        # The flow `wanted / g` keeps the response at `wanted`. In one sample, a further flow
        # changes the response of a model of first order by (1 - pole) g times the flow.
        pole = np.exp(-1.0 / estimate.time_constant)
        approach = CLOSED_SHARE * (wanted - estimate.response) / (1.0 - pole)
        flow: Array = (wanted + approach) / estimate.gain
        return flow
