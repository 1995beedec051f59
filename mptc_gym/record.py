"""Record the latest samples of an episode, for a picture."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

from mptc_gym.plant.parameters import PlantNumbers

FEWEST_SAMPLES = 200  # in a picture, about 27 minutes of 8 s samples


class Record:
    """The latest samples of an episode, from which a picture is drawn.

    A record holds only numbers and no pygame objects, so that an environment can be copied
    together with its record.

    Parameters
    ----------
    plant
        Parameter values of the plant in this episode, such as delay, dead zone and limits.
    sampling_interval
        Sampling interval, s.
    first
        Sample number of the first sample to be added.
    span
        Number of samples between the left edge and the right edge of a picture; by default,
        `FEWEST_SAMPLES`, or four delays if they are longer.

    Attributes
    ----------
    infos : deque of dict
        Infos of the latest samples, as many as a picture shows, the newest last.
    k : int
        Sample number of the newest sample; `first` - 1 before the first sample.
    extremes : tuple of float
        Lowest and highest of 0 and of all recorded set points and temperatures, degC. With the
        extremes of the visible samples alone, the axis would change often.
    """

    def __init__(
        self,
        plant: PlantNumbers[float],
        sampling_interval: float,
        *,
        first: int = 0,
        span: int | None = None,
    ) -> None:
        self.plant = plant
        self.sampling_interval = sampling_interval
        self.first = first
        self.span = span or max(FEWEST_SAMPLES, 4 * int(plant.delay))
        self.infos: deque[dict[str, float]] = deque(maxlen=self.span + 1)
        self.k = first - 1  # no sample yet
        self.extremes = 0.0, 0.0

    @classmethod
    def at_rest(
        cls, plant: PlantNumbers[float], sampling_interval: float, setpoint: float
    ) -> Record:
        """Return a record with the sample k = 0, at rest, with the set point `setpoint`, degC.

        The other arguments are those of the class.
        """
        record = cls(plant, sampling_interval)
        at_rest = {"output": 0.0, "command": 0.0, "applied": 0.0}
        record.add({"setpoint": setpoint, "error": setpoint, **at_rest})
        return record

    @property
    def left(self) -> int:
        """Sample number at the left edge of a picture, which moves with the newest sample."""
        return max(self.first, self.k - self.span)

    def add(self, info: Mapping[str, float]) -> None:
        """Add the next sample of the episode, by the info that `step` returns."""
        self.k += 1
        self.infos.append(dict(info))  # a copy, as the caller may change the info
        temperatures = *self.extremes, info["setpoint"], info["output"]
        self.extremes = min(temperatures), max(temperatures)

    def latest(self, name: str) -> list[float]:
        """Return the entries `name` of the infos of the latest samples, the newest last."""
        return [info[name] for info in self.infos]
