"""Record the latest samples of an episode for a picture.

A record holds only numbers, so that it can be copied with its environment.
"""

from collections import deque

from mptc_gym.parameters import PlantNumbers

SPAN = 200  # fewest samples that a picture spans
LONGEST = 2000  # most samples that a picture spans, even with a long delay
FARTHEST = 1e12  # degC; values beyond it, or NaN, are drawn at the edge


class Record:
    """The latest samples of an episode that starts at rest with the set point y_d(0), degC."""

    def __init__(
        self, plant: PlantNumbers[float], sampling_interval: float, setpoint: float
    ) -> None:
        self.plant, self.sampling_interval = plant, sampling_interval
        self.span = min(max(SPAN, 4 * int(plant.delay)), LONGEST)
        low, high = min(plant.u_min, 0.0), max(plant.u_max, 0.0)
        # The ends of the flow axis, t/h: the range of the actuator, with a margin.
        self.flows = low - 0.12 * (high - low), high + 0.12 * (high - low)
        self.k = 0
        # The sample at the left edge of the picture; the right edge is `span` later.
        self.first = 0
        # y_d(k), y(k), u(k-1) and u_a(k-1)
        self.samples = deque([(setpoint, 0.0, 0.0, 0.0)], maxlen=self.span + 1)
        # Of the temperatures in the whole episode, so that the axis rarely changes.
        self._lowest, self._highest = min(0.0, setpoint), max(0.0, setpoint)

    def add(self, setpoint: float, output: float, command: float, applied: float) -> None:
        """Add a step: y_d(k+1) and y(k+1), degC, and u(k) and u_a(k), t/h."""
        self.k += 1
        self.first = max(0, self.k - self.span)
        self.samples.append((setpoint, output, command, applied))
        bounded = [max(-FARTHEST, min(FARTHEST, each)) for each in (setpoint, output)]
        self._lowest = min(self._lowest, *bounded)
        self._highest = max(self._highest, *bounded)

    @property
    def temperatures(self) -> tuple[float, float]:
        """The ends of the temperature axis, degC: it covers the episode so far."""
        margin = max(0.05 * (self._highest - self._lowest), 0.5)
        return self._lowest - margin, self._highest + margin
