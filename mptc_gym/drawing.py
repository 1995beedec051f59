"""Draw a record of the loop with pygame: temperatures above, flows below, and its window."""

import math
from collections.abc import Sequence
from itertools import chain, pairwise
from weakref import WeakSet

import numpy as np
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray

try:
    import pygame
except ImportError as error:
    raise DependencyNotInstalled(
        'pygame is not installed, run `pip install "mptc_gym[render]"`'
    ) from error

from mptc_gym.record import Record

Colour = tuple[int, int, int]
Place = tuple[int, int, int, int]  # pixels from the left edge, from the top, width and height

SIZE = 960, 540
# The lines have the colours of Okabe and Ito, safe for colour-blind readers.
TEMPERATURE, SETPOINT = (0, 114, 178), (213, 94, 0)
APPLIED, COMMAND = (0, 158, 115), (40, 40, 40)
DEAD_ZONE, IN_TRANSIT = (222, 222, 222), (205, 229, 246)
LIMIT, _GRID, _INK, _PAPER = (130, 130, 130), (236, 237, 240), (60, 64, 70), (255, 255, 255)
TEMPERATURES, FLOWS = (72, 44, 864, 214), (72, 324, 864, 182)  # places of the panels
clock = pygame.time.Clock()  # limits the frame rate
viewers: WeakSet[object] = WeakSet()  # environments that show pictures in the window


class Panel:
    """A part of the picture with its own axes."""

    def __init__(
        self, surface: pygame.Surface, record: Record, place: Place, axis: tuple[float, float]
    ) -> None:
        self._surface, self._record, self._axis = surface, record, axis
        self._left, self._top, self._width, self._height = place
        self._font = pygame.font.Font(None, 22)

    def x(self, k: float) -> float:
        """Return the horizontal position of sample k."""
        return self._left + (k - self._record.first) * self._width / self._record.span

    def y(self, value: float) -> float:
        """Return the vertical position of a value, at the panel's edge if it is beyond."""
        low, high = self._axis
        below_top = (high - value) / (high - low) * self._height
        # Inside the frame; so is NaN, given this order of min and max.
        return self._top + max(3.0, min(self._height - 3.0, below_top))

    def grid(self) -> None:
        """Draw grid and frame, and write the numbers of both axes."""
        for value in ticks(*self._axis):
            self.level(_GRID, value)
            self.write(f"{value:.6g}", _INK, midright=(self._left - 8, self.y(value)))
        minute, first = 60.0 / self._record.sampling_interval, self._record.first  # in samples
        bottom = self._top + self._height
        for value in ticks(first / minute, (first + self._record.span) / minute):
            x = self.x(value * minute)
            pygame.draw.line(self._surface, _GRID, (x, self._top), (x, bottom))
            self.write(f"{value:.6g}", _INK, midtop=(x, bottom + 6))
        # Left of where a number at the edge begins.
        self.write("min", _INK, topright=(self._left - 34, bottom + 6))
        frame = self._left, self._top, self._width + 1, self._height + 1
        pygame.draw.rect(self._surface, LIMIT, frame, 1)

    def shade(self, colour: Colour, first: int, last: int, low: float, high: float) -> None:
        """Shade what lies between two samples and two values."""
        left, top = max(self._left, round(self.x(first))), round(self.y(high))
        area = left, top, round(self.x(last)) - left, round(self.y(low)) - top + 1
        self._surface.fill(colour, area, pygame.BLEND_RGB_MULT)

    def level(self, colour: Colour, value: float) -> None:
        """Draw a line across the panel."""
        y = self.y(value)
        pygame.draw.line(self._surface, colour, (self._left, y), (self._left + self._width, y))

    def curve(self, colour: Colour, values: Sequence[float], width: int, *, held: bool) -> None:
        """Draw the latest values; if held, each from its sample to the next."""
        first = self._record.k + 1 - len(values)
        points = [(self.x(k), self.y(value)) for k, value in enumerate(values, start=first)]
        if held:
            corners = [(after[0], before[1]) for before, after in pairwise(points)]
            points = [*chain.from_iterable(zip(points, corners, strict=False)), points[-1]]
        if len(points) > 1:
            pygame.draw.lines(self._surface, colour, False, points, width)

    def heading(self, *words: tuple[str, Colour, Colour]) -> None:
        """Write words above the panel, each in its colour and on its ground."""
        x = self._left
        for text, colour, ground in words:
            x = self.write(f" {text} ", colour, ground, midleft=(x, self._top - 16)).right + 12

    def write(
        self, text: str, colour: Colour, ground: Colour = _PAPER, **place: tuple[float, float]
    ) -> pygame.Rect:
        """Write a text with one of its anchors, such as `midleft`, at a point."""
        image = self._font.render(text.replace("-", "\N{MINUS SIGN}"), True, colour, ground)
        ((side, (x, y)),) = place.items()
        return self._surface.blit(image, image.get_rect(**{side: (round(x), round(y))}))


def draw(record: Record) -> pygame.Surface:
    """Return a picture."""
    pygame.font.init()
    # Three bytes per pixel, in the order of an array, so that converting it is just a copy.
    surface = pygame.Surface(SIZE, depth=24, masks=(0xFF, 0xFF00, 0xFF0000, 0))
    surface.fill(_PAPER)
    setpoints, outputs, commands, applied = map(list, zip(*record.samples, strict=True))

    panel = Panel(surface, record, TEMPERATURES, record.temperatures)
    panel.grid()
    panel.curve(TEMPERATURE, outputs, 3, held=False)
    # Above the temperature, and thinner, so that both can be seen where they agree.
    panel.curve(SETPOINT, setpoints, 2, held=True)
    panel.heading(
        (f"temperature {_short(outputs[-1])} °C", TEMPERATURE, _PAPER),
        (f"set point {_short(setpoints[-1])} °C", SETPOINT, _PAPER),
        (f"error {_short(setpoints[-1] - outputs[-1])} °C", _INK, _PAPER),
        (f"time {record.k * record.sampling_interval / 60.0:.2f} min", _INK, _PAPER),
    )

    plant, (low, high) = record.plant, record.flows
    panel = Panel(surface, record, FLOWS, record.flows)
    panel.grid()
    if plant.dead_zone > 0.0:
        last = record.first + record.span
        panel.shade(DEAD_ZONE, record.first, last, -plant.dead_zone, plant.dead_zone)
    panel.shade(IN_TRANSIT, record.k - int(plant.delay), record.k, low, high)
    for limit in (plant.u_min, plant.u_max):
        panel.level(LIMIT, limit)
    # An input is held from its sample to the next. The first entry is from before the episode.
    panel.curve(APPLIED, [*applied[1:], applied[-1]], 3, held=True)
    panel.curve(COMMAND, [*commands[1:], commands[-1]], 1, held=True)
    panel.heading(
        (f"applied flow {_short(applied[-1])} t/h", APPLIED, _PAPER),
        (f"command {_short(commands[-1])} t/h", COMMAND, _PAPER),
        ("dead zone", _INK, DEAD_ZONE),
        ("in transit", _INK, IN_TRANSIT),
    )
    return surface


def frame(record: Record) -> NDArray[np.uint8]:
    """Return a picture, shape (540, 960, 3)."""
    return np.array(pygame.surfarray.pixels3d(draw(record)).swapaxes(0, 1), order="C")


def show(record: Record, fps: float, viewer: object) -> None:
    """Show a picture in the window, opened if necessary, at most `fps` times a second.

    All environments show their pictures in one window, until each `viewer` has called `hide`.
    """
    viewers.add(viewer)
    pygame.display.init()
    screen = pygame.display.get_surface()
    if screen is None or screen.get_size() != SIZE:
        screen = pygame.display.set_mode(SIZE)
        pygame.display.set_caption("MiddlePoint-v0")
    screen.blit(draw(record), (0, 0))
    pygame.event.pump()
    clock.tick(fps)
    pygame.display.flip()


def hide(viewer: object) -> None:
    """Close the window, unless another environment shows its pictures in it."""
    viewers.discard(viewer)
    if not viewers:
        pygame.display.quit()


def ticks(low: float, high: float) -> list[float]:
    """Return the multiples of 1, 2 or 5 times a power of ten in a range, 3 to 7 of them."""
    least = (high - low) / 6.0
    power = 10.0 ** math.floor(math.log10(least))
    step = next(power * by for by in (1.0, 2.0, 5.0, 10.0) if power * by >= least)
    return [i * step for i in range(math.ceil(low / step), math.floor(high / step) + 1)]


def _short(value: float) -> str:
    return f"{round(value, 2) + 0.0:.2f}" if abs(value) < 1e5 else f"{value:.3g}"  # never -0.00
