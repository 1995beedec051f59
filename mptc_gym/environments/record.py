"""Record the latest samples of an episode, from which pictures are drawn.

A record holds only numbers and no pygame objects, so that an environment can be copied together
with its record.
"""

from collections import deque
from typing import NamedTuple

from mptc_gym.plant.parameters import PlantNumbers

FEWEST_SAMPLES = 200  # in a picture, about 27 minutes of 8 s samples
MOST_SAMPLES = 2000  # in a picture, even if four delays are longer
FARTHEST = 1e12  # degC; temperatures beyond +-FARTHEST, and NaN, are drawn at the edge


class Sample(NamedTuple):
    """Set point and temperature at sample k, and the flows of the step from sample k-1 to k."""

    setpoint: float  # set point y_d(k), degC
    output: float  # true temperature y(k), degC
    command: float  # commanded flow u(k-1), t/h
    applied: float  # applied flow u_a(k-1), t/h


class Record:
    """Latest samples of an episode, with the axis limits for a picture of these samples.

    Attributes
    ----------
    plant : PlantNumbers
        Parameter values of the plant in this episode, such as delay, dead zone and limits.
    sampling_interval : float
        Sampling interval, s.
    span : int
        Number of samples between the left edge and the right edge of a picture.
    flow_axis : tuple of float
        Lower end and upper end of the flow axis, t/h. The flow axis includes the actuator's
        limits and 0, with a margin of 12 % at each end.
    samples : deque of Sample
        Latest samples of the episode, as many as a picture shows, the newest last.
    k : int
        Sample number of the newest sample.
    first : int
        Sample number at the left edge of a picture.
    """

    def __init__(
        self, plant: PlantNumbers[float], sampling_interval: float, setpoint: float
    ) -> None:
        """Begin the record at sample k = 0, with the set point `setpoint`, degC.

        At sample k = 0, temperature and flows are 0.
        """
        self.plant = plant
        self.sampling_interval = sampling_interval
        self.span = min(max(FEWEST_SAMPLES, 4 * int(plant.delay)), MOST_SAMPLES)
        lowest_flow = min(plant.u_min, 0.0)
        highest_flow = max(plant.u_max, 0.0)
        margin = 0.12 * (highest_flow - lowest_flow)
        self.flow_axis = lowest_flow - margin, highest_flow + margin
        self.samples = deque([Sample(setpoint, 0.0, 0.0, 0.0)], maxlen=self.span + 1)
        self.k = 0
        self.first = 0
        # The extremes of all set points and temperatures of the episode, degC. With the
        # extremes of the visible samples alone, the axis would change often.
        self._lowest = min(0.0, setpoint)
        self._highest = max(0.0, setpoint)

    def add(self, setpoint: float, output: float, command: float, applied: float) -> None:
        """Append the signals of the step from sample k to sample k+1 to the record.

        Parameters
        ----------
        setpoint, output
            Set point y_d(k+1) and true temperature y(k+1), degC.
        command, applied
            Commanded flow u(k) and applied flow u_a(k), t/h.
        """
        self.k += 1
        self.first = max(0, self.k - self.span)
        self.samples.append(Sample(setpoint, output, command, applied))
        for temperature in (setpoint, output):
            bounded = max(-FARTHEST, min(FARTHEST, temperature))
            self._lowest = min(self._lowest, bounded)
            self._highest = max(self._highest, bounded)

    @property
    def temperature_axis(self) -> tuple[float, float]:
        """Lower and upper end of the temperature axis, degC, for all samples of the episode."""
        margin = max(0.05 * (self._highest - self._lowest), 0.5)
        return self._lowest - margin, self._highest + margin
