"""Record the latest samples of an episode for a picture, and choose its axes.

Environments add plain numbers, one call per sample. A record holds only numbers, so that it can
be copied.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

from mptc_gym.parameters import PlantNumbers

Sample = tuple[float, float, float, float]  # y_d(k), y(k), u(k-1), u_a(k-1)

SPAN = 200  # fewest samples that a picture spans
LONGEST = 2000  # most samples that a picture spans, even with a long delay
FARTHEST = 1e12  # degC; values beyond it, or NaN, are drawn at the edge


@dataclass(frozen=True)
class Axis:
    """A range with ticks at round numbers."""

    low: float
    high: float
    step: float  # between ticks

    def ticks(self) -> Iterator[float]:
        """Return the round numbers within the range."""
        first = math.ceil(self.low / self.step - 1e-9)
        last = math.floor(self.high / self.step + 1e-9)
        return (i * self.step for i in range(first, last + 1))


class Record:
    """The latest samples of an episode that starts at rest with the set point y_d(0), degC."""

    def __init__(
        self, plant: PlantNumbers[float], sampling_interval: float, setpoint: float
    ) -> None:
        self.plant, self.sampling_interval = plant, sampling_interval
        self.delay = int(plant.delay)
        self.span = min(max(SPAN, 4 * self.delay), LONGEST)
        self.k = 0
        self.samples: deque[Sample] = deque([(setpoint, 0.0, 0.0, 0.0)], maxlen=self.span + 1)
        # Extremes of the whole episode, so that the axis rarely changes.
        self._lowest, self._highest = min(0.0, setpoint), max(0.0, setpoint)

    def add(self, setpoint: float, output: float, command: float, applied: float) -> None:
        """Add a step: y_d(k+1) and y(k+1), degC, and u(k) and u_a(k), t/h."""
        self.k += 1
        self.samples.append((setpoint, output, command, applied))
        for temperature in (setpoint, output):
            bounded = max(-FARTHEST, min(FARTHEST, temperature))
            self._lowest = min(self._lowest, bounded)
            self._highest = max(self._highest, bounded)

    @property
    def first(self) -> int:
        """The sample at the left edge of the picture; the right edge is `span` later."""
        return max(0, self.k - self.span)

    @property
    def in_transit(self) -> int:
        """Number of latest inputs that do not yet show in the temperature."""
        return min(self.delay, self.k)

    @property
    def minutes(self) -> Axis:
        """The time axis."""
        minute = 60.0 / self.sampling_interval  # samples
        low, high = self.first / minute, (self.first + self.span) / minute
        return Axis(low, high, _round_step((high - low) / 6))

    @property
    def temperatures(self) -> Axis:
        """The temperature axis, degC: it covers the episode so far."""
        margin = max(0.05 * (self._highest - self._lowest), 0.5)
        low, high = self._lowest - margin, self._highest + margin
        room = _round_step((high - low) / 20)
        low, high = math.floor(low / room) * room, math.ceil(high / room) * room
        return Axis(low, high, _round_step((high - low) / 6))

    @property
    def flows(self) -> Axis:
        """The flow axis, t/h: the range of the actuator, with a margin."""
        return flow_axis(self.plant.u_min, self.plant.u_max)

    @property
    def readings(self) -> dict[str, str]:
        """The current values as text, by name."""
        setpoint, output, command, applied = self.samples[-1]
        seconds = self.sampling_interval
        digits = 1 if seconds >= 6.0 else 2 if seconds >= 0.6 else 3  # so that a sample shows
        return {
            "time": f"{self.k * seconds / 60.0:.{digits}f} min",
            "set point": f"{_short(setpoint)} °C",
            "temperature": f"{_short(output)} °C",
            "error": f"{_short(setpoint - output)} °C",
            "command": f"{_short(command)} t/h",
            "applied": f"{_short(applied)} t/h",
        }


def flow_axis(u_min: float, u_max: float) -> Axis:
    """Return the flow axis for the limits of an actuator, t/h."""
    low, high = min(u_min, 0.0), max(u_max, 0.0)
    margin = 0.12 * (high - low)
    return Axis(low - margin, high + margin, _round_step((high - low) / 4))


def _round_step(least: float) -> float:
    """Return the smallest 1, 2 or 5 times a power of ten that is at least `least`."""
    power = 10.0 ** math.floor(math.log10(least))
    return next(power * factor for factor in (1.0, 2.0, 5.0, 10.0) if power * factor >= least)


def _short(value: float) -> str:
    if not abs(value) < 1e5:
        return f"{value:.3g}"
    return f"{round(value, 2) + 0.0:.2f}"  # never -0.00
