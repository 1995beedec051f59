"""Record the latest samples of an episode for a picture.

A record holds only numbers, so that it can be copied with its environment.
"""

from collections import deque
from typing import NamedTuple

from mptc_gym.parameters import PlantNumbers

SPAN = 200  # fewest samples that a picture spans
LONGEST = 2000  # most samples that a picture spans, even with a long delay
FARTHEST = 1e12  # degC; temperatures beyond this value, and NaN, are drawn at the edge


class Sample(NamedTuple):
    """The signals of sample k, after the step from sample k-1."""

    setpoint: float  # y_d(k), degC
    output: float  # y(k), degC
    command: float  # u(k-1), t/h
    applied: float  # u_a(k-1), t/h


class Record:
    """The latest samples of an episode that starts at rest with the set point y_d(0), degC.

    Attributes
    ----------
    plant : PlantNumbers
        The numbers of the plant in this episode.
    sampling_interval : float
        Sampling interval, s.
    span : int
        Samples between the left and the right edge of a picture.
    flow_axis : tuple of float
        The ends of the flow axis, t/h: the range of the actuator with a margin.
    samples : deque of Sample
        The latest samples, at most `span` + 1, the newest last.
    k : int
        The newest sample.
    first : int
        The sample at the left edge of a picture.
    """

    def __init__(
        self, plant: PlantNumbers[float], sampling_interval: float, setpoint: float
    ) -> None:
        self.plant = plant
        self.sampling_interval = sampling_interval
        self.span = min(max(SPAN, 4 * int(plant.delay)), LONGEST)
        lowest_flow = min(plant.u_min, 0.0)
        highest_flow = max(plant.u_max, 0.0)
        margin = 0.12 * (highest_flow - lowest_flow)
        self.flow_axis = lowest_flow - margin, highest_flow + margin
        self.samples = deque([Sample(setpoint, 0.0, 0.0, 0.0)], maxlen=self.span + 1)
        self.k = 0
        self.first = 0
        # The extremes of all temperatures of the episode, so that the axis rarely changes.
        self._lowest = min(0.0, setpoint)
        self._highest = max(0.0, setpoint)

    def add(self, setpoint: float, output: float, command: float, applied: float) -> None:
        """Add a step: y_d(k+1) and y(k+1), degC, and u(k) and u_a(k), t/h."""
        self.k += 1
        self.first = max(0, self.k - self.span)
        self.samples.append(Sample(setpoint, output, command, applied))
        for temperature in (setpoint, output):
            bounded = max(-FARTHEST, min(FARTHEST, temperature))
            self._lowest = min(self._lowest, bounded)
            self._highest = max(self._highest, bounded)

    @property
    def temperature_axis(self) -> tuple[float, float]:
        """The ends of the temperature axis, degC, which covers the episode so far."""
        margin = max(0.05 * (self._highest - self._lowest), 0.5)
        return self._lowest - margin, self._highest + margin
