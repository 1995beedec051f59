"""What is drawn of an episode: a record of its last samples, its axes, and a picture in text.

Environments hand in plain numbers, one call a sample. Pictures in pixels are made by
`mptc_gym.drawing`, which is loaded with the first of them. A record holds numbers alone, so
that it can be copied.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from types import ModuleType
from typing import cast

import numpy as np
from gymnasium import logger
from gymnasium.error import DependencyNotInstalled, ResetNeeded
from numpy.typing import NDArray

from mptc_gym.parameters import PlantNumbers

Frame = NDArray[np.uint8]
Sample = tuple[float, float, float, float]  # y_d(k), y(k), u(k-1), u_a(k-1)

SPAN = 200  # samples that a picture shows at least
LONGEST = 2000  # and at most, however long the delay
FARTHEST = 1e12  # degC; what is beyond, or not a number, is drawn at the edge
_TEXT_COLUMNS = 72


@dataclass(frozen=True)
class Nameplate:
    """What a picture has to know of the plant of an episode.

    Attributes
    ----------
    delay
        d, samples.
    dead_zone, u_min, u_max
        Of the actuator, t/h.
    sampling_interval
        s.
    """

    delay: int
    dead_zone: float
    u_min: float
    u_max: float
    sampling_interval: float


@dataclass(frozen=True)
class Axis:
    """A range with ticks at round numbers.

    Attributes
    ----------
    low, high
        Its ends.
    step
        From tick to tick.
    """

    low: float
    high: float
    step: float

    def ticks(self) -> Iterator[float]:
        """Yield the round numbers within the range."""
        first, last = math.ceil(self.low / self.step - 1e-9), self.high / self.step + 1e-9
        for i in range(first, math.floor(last) + 1):
            yield i * self.step

    def share(self, value: float) -> float:
        """Return how far up the range a value lies, from 0 to 1; its ends stand for more."""
        return min(1.0, max(0.0, (value - self.low) / (self.high - self.low)))


class Record:
    """The last samples of an episode.

    Parameters
    ----------
    plate
        Of the plant, for this episode.
    setpoint, output
        y_d(0) and y(0), degC.
    """

    def __init__(self, plate: Nameplate, setpoint: float, output: float = 0.0) -> None:
        self.plate = plate
        self.span = min(max(SPAN, 4 * plate.delay), LONGEST)
        self.k = 0
        self.samples: deque[Sample] = deque(
            [(setpoint, output, 0.0, 0.0)], maxlen=self.span + 1
        )
        # Of the whole episode, so that the axis need not move again and again.
        self._lowest = self._highest = 0.0
        self._stretch(setpoint, output)

    def add(self, setpoint: float, output: float, command: float, applied: float) -> None:
        """Take a step down: y_d(k+1) and y(k+1), degC, and u(k) and u_a(k), t/h."""
        self.k += 1
        self.samples.append((setpoint, output, command, applied))
        if not (
            self._lowest <= output <= self._highest
            and self._lowest <= setpoint <= self._highest
        ):
            self._stretch(setpoint, output)

    def _stretch(self, *temperatures: float) -> None:
        for temperature in temperatures:
            bounded = max(-FARTHEST, min(FARTHEST, temperature))
            self._lowest = min(self._lowest, bounded)
            self._highest = max(self._highest, bounded)

    @property
    def first(self) -> int:
        """The sample at the left end of the picture; the right end is `span` later."""
        return max(0, self.k - self.span)

    @property
    def in_transit(self) -> int:
        """How many of the latest inputs do not show in the temperature yet."""
        return min(self.plate.delay, self.k)

    @property
    def minutes(self) -> Axis:
        """The time axis."""
        minute = 60.0 / self.plate.sampling_interval  # samples
        low, high = self.first / minute, (self.first + self.span) / minute
        return Axis(low, high, _round_step((high - low) / 6))

    @property
    def temperatures(self) -> Axis:
        """The axis of the temperatures, degC: all of the episode so far."""
        margin = max(0.05 * (self._highest - self._lowest), 0.5)
        low, high = self._lowest - margin, self._highest + margin
        room = _round_step((high - low) / 20)
        low, high = math.floor(low / room) * room, math.ceil(high / room) * room
        return Axis(low, high, _round_step((high - low) / 6))

    @property
    def flows(self) -> Axis:
        """The axis of the flows, t/h: what the actuator lets through, and some room."""
        low, high = min(self.plate.u_min, 0.0), max(self.plate.u_max, 0.0)
        margin = 0.12 * (high - low)
        return Axis(low - margin, high + margin, _round_step((high - low) / 4))

    @property
    def numbers(self) -> dict[str, str]:
        """What holds now, as text, by name."""
        setpoint, output, command, applied = self.samples[-1]
        seconds = self.plate.sampling_interval
        digits = 1 if seconds >= 6.0 else 2 if seconds >= 0.6 else 3  # that a sample shows
        return {
            "time": f"{self.k * seconds / 60.0:.{digits}f} min",
            "set point": f"{_short(setpoint)} °C",
            "temperature": f"{_short(output)} °C",
            "error": f"{_short(setpoint - output)} °C",
            "command": f"{_short(command)} t/h",
            "applied": f"{_short(applied)} t/h",
        }


def begin(numbers: PlantNumbers[float], sampling_interval: float, setpoint: float) -> Record:
    """Begin the record of an episode, of a plant at rest.

    Parameters
    ----------
    numbers
        The plant numbers, among them those of a `Nameplate`.
    sampling_interval
        s.
    setpoint
        y_d(0), degC.
    """
    plate = Nameplate(
        delay=int(numbers.delay),
        dead_zone=numbers.dead_zone,
        u_min=numbers.u_min,
        u_max=numbers.u_max,
        sampling_interval=sampling_interval,
    )
    return Record(plate, setpoint)


def check_mode(mode: str | None, modes: Iterable[str]) -> None:
    """Raise a ValueError that names a render mode which is not None or one of `modes`."""
    if mode is not None and mode not in modes:
        allowed = ", ".join(map(repr, modes))
        raise ValueError(f"render_mode must be None or one of {allowed}, got {mode!r}")


def warn_no_mode() -> None:
    """Warn that there is nothing to draw."""
    logger.warn(
        "render does nothing without a render mode: give one to gymnasium.make, as in "
        'make("MiddlePoint-v0", render_mode="rgb_array")'
    )


def render(mode: str, record: Record | None, fps: float) -> Frame | str | None:
    """Make a picture: return it, or show it in a window.

    Parameters
    ----------
    mode
        "rgb_array", "human" or "ansi".
    record
        What to draw; None before the first reset.
    fps
        Pictures a second that a window shows at most.

    Raises
    ------
    ResetNeeded
        If there is no record.
    DependencyNotInstalled
        If there is no pygame, for any mode but "ansi".
    """
    if record is None:
        raise ResetNeeded("call reset before render")
    if mode == "ansi":
        return text(record)
    if mode == "human":
        _drawing().show(record, fps)
        return None
    return frame(record)


def frame(record: Record) -> Frame:
    """Return a picture, shape (540, 960, 3), uint8."""
    return cast("Frame", _drawing().frame(record))


def close_window() -> None:
    """Close the window of the mode "human"."""
    _drawing().close_window()


def _drawing() -> ModuleType:
    try:
        import pygame  # noqa: F401 (alone, so that no other fault is taken for its absence)
    except ImportError as error:
        raise DependencyNotInstalled(
            'pygame is not installed, run `pip install "mptc_gym[render]"`'
        ) from error
    from mptc_gym import drawing

    return drawing


def text(record: Record) -> str:
    """Return a picture in text: set point -, temperature *; command +, applied #."""
    columns = range(_TEXT_COLUMNS)
    picks = [record.first + round(c * record.span / (len(columns) - 1)) for c in columns]
    samples = list(record.samples)
    shown = [samples[j - record.first] for j in picks if j <= record.k]
    in_transit = [j > record.k - record.in_transit for j in picks if j <= record.k]

    temperatures = _Grid(record.temperatures, rows=11)
    flows = _Grid(record.flows, rows=9)
    dead_zone = record.plate.dead_zone
    for column in columns:
        flows.fill(column, -dead_zone, dead_zone, ":")
    for column, (setpoint, output, command, applied) in enumerate(shown):
        temperatures.put(column, setpoint, "-")
        temperatures.put(column, output, "*")
        flows.put(column, command, "+")
        flows.put(column, applied, "#")

    numbers = [f"{name} {value}" for name, value in record.numbers.items()]
    marks = "".join("^" if still else " " for still in in_transit).rstrip()
    minutes = record.minutes
    left, right = f"{minutes.low:.4g} min", f"{minutes.high:.4g} min"
    return "\n".join(
        [
            "   ".join(numbers[:4]),
            "   ".join(numbers[4:]),
            "",
            "°C: set point -, temperature *",
            *temperatures.lines(),
            "t/h: command +, applied #, dead zone :, in transit ^",
            *flows.lines(),
            f"{'':9}{marks}",
            f"{'':9}{left}{right:>{_TEXT_COLUMNS - len(left)}}",
        ]
    )


class _Grid:
    """Characters in rows, the top one first."""

    def __init__(self, axis: Axis, rows: int) -> None:
        self._axis = axis
        self._rows = [[" "] * _TEXT_COLUMNS for _ in range(rows)]

    def put(self, column: int, value: float, character: str) -> None:
        self._rows[self._row(value)][column] = character

    def fill(self, column: int, low: float, high: float, character: str) -> None:
        """Fill the rows whose middle lies between two values."""
        for row in range(len(self._rows)):
            if low < self._value(row) < high:
                self._rows[row][column] = character

    def lines(self) -> list[str]:
        labels = {self._row(tick): f"{tick:.6g}" for tick in self._axis.ticks()}
        return [
            f"{labels.get(row, ''):>7} |{''.join(characters)}".rstrip()
            for row, characters in enumerate(self._rows)
        ]

    def _row(self, value: float) -> int:
        return round((1.0 - self._axis.share(value)) * (len(self._rows) - 1))

    def _value(self, row: int) -> float:
        share = 1.0 - row / (len(self._rows) - 1)
        return self._axis.low + share * (self._axis.high - self._axis.low)


def _round_step(least: float) -> float:
    """Return the smallest of 1, 2 or 5 times a power of ten that is not below `least`."""
    power = 10.0 ** math.floor(math.log10(least))
    return next(power * factor for factor in (1.0, 2.0, 5.0, 10.0) if power * factor >= least)


def _short(value: float) -> str:
    if not abs(value) < 1e5:
        return f"{value:.3g}"
    return f"{round(value, 2) + 0.0:.2f}"  # never -0.00
