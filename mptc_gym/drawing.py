"""Draw a record of the loop with pygame: a strip chart in pixels, and its window."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from functools import cache, lru_cache

import numpy as np
import pygame
from numpy.typing import NDArray

from mptc_gym.record import Axis, Record, flow_axis

Colour = tuple[int, int, int]
Point = tuple[float, float]

SIZE = 960, 540
# The lines have the colours of Okabe and Ito, safe for colour-blind readers.
TEMPERATURE: Colour = (0, 114, 178)
SETPOINT: Colour = (213, 94, 0)
APPLIED: Colour = (0, 158, 115)
COMMAND: Colour = (40, 40, 40)
DEAD_ZONE: Colour = (228, 228, 228)
IN_TRANSIT: Colour = (214, 234, 248)
LIMIT: Colour = (130, 130, 130)
FAINT: Colour = (95, 100, 108)  # of secondary text
_STILL_TO_COME: Colour = (150, 210, 192)  # a lighter APPLIED
_PAGE: Colour = (243, 244, 246)
_PANEL: Colour = (255, 255, 255)
_GRID: Colour = (232, 233, 236)
_FRAME: Colour = (160, 164, 170)
_INK: Colour = (25, 28, 32)

_LEFT, _RIGHT = 72, 842  # edges of both panels; names of lines go to the right of them
_FLOW_PANEL = 346, 496  # its top and bottom
_SMALL, _NORMAL, _LARGE = 18, 20, 32  # font sizes
_FINER = 4  # factor by which text and dots are drawn larger, then reduced


class Panel:
    """A part of the picture with its own axes, from `top` to `bottom`, in pixels."""

    def __init__(self, top: int, bottom: int, record: Record, axis: Axis) -> None:
        self.top, self.bottom = top, bottom
        self.record, self.axis = record, axis
        self.rect = pygame.Rect(_LEFT, top, _RIGHT - _LEFT + 1, bottom - top + 1)
        self._sample = (_RIGHT - _LEFT) / record.span
        # Positions of all samples shown, and of the next one.
        self.xs = [self.x(k) for k in range(record.first, record.k + 2)]

    def x(self, k: float) -> float:
        """Return the horizontal position of sample k."""
        return _LEFT + (k - self.record.first) * self._sample

    def minutes(self) -> Iterator[tuple[float, float]]:
        """Yield the ticks of the time axis, in minutes, and their positions."""
        per_minute = 60.0 / self.record.sampling_interval
        for minute in self.record.minutes.ticks():
            yield minute, self.x(minute * per_minute)

    def y(self, value: float) -> float:
        """Return the vertical position of a value."""
        return self.ys([value])[0]

    def ys(self, values: Iterable[float]) -> list[float]:
        """Return the vertical positions of values."""
        low, bottom = self.axis.low, float(self.bottom)
        scale = (bottom - self.top) / (self.axis.high - low)
        # Values beyond the axis are drawn at its edge, inside the frame; so is NaN, given this
        # order of min and max.
        least, most = self.top + 2.0, bottom - 2.0
        return [max(least, min(most, bottom - (value - low) * scale)) for value in values]


def frame(record: Record) -> NDArray[np.uint8]:
    """Return a picture, shape (540, 960, 3)."""
    return np.array(pygame.surfarray.pixels3d(draw(record)).swapaxes(0, 1), order="C")


def show(record: Record, fps: float) -> None:
    """Show a picture in the window, opened if necessary, at most `fps` times a second."""
    pygame.display.init()
    screen = pygame.display.get_surface()
    if screen is None or screen.get_size() != SIZE:
        screen = pygame.display.set_mode(SIZE)
        pygame.display.set_caption("MiddlePoint-v0")
    screen.blit(draw(record), (0, 0))
    pygame.event.pump()
    clock().tick(fps)
    pygame.display.flip()


def close_window() -> None:
    """Close the window, if it is open."""
    pygame.display.quit()


@cache
def clock() -> pygame.time.Clock:
    """Return the clock that limits the frame rate."""
    return pygame.time.Clock()


def draw(record: Record) -> pygame.Surface:
    """Return a picture; the next call draws over it."""
    surface = _paper()
    surface.fill(_PAGE)
    _draw_header(surface, record)
    top = Panel(86, 304, record, record.temperatures)
    bottom = Panel(*_FLOW_PANEL, record, record.flows)
    _draw_temperatures(surface, top)
    _draw_flows(surface, bottom)
    _draw_time_axis(surface, bottom)
    _draw_legend(surface, record.plant.dead_zone > 0.0)
    return surface


def flow_at(point: tuple[int, int], u_min: float, u_max: float) -> float | None:
    """Return the flow at a point of a picture, t/h; None outside its panel."""
    (x, y), (top, bottom), axis = point, _FLOW_PANEL, flow_axis(u_min, u_max)
    if not (_LEFT <= x <= _RIGHT and top <= y <= bottom):
        return None
    return axis.low + (bottom - y) / (bottom - top) * (axis.high - axis.low)


@cache
def _paper() -> pygame.Surface:
    # Three bytes per pixel, in the order of an array, so that converting it is just a copy.
    return pygame.Surface(SIZE, depth=24, masks=(0xFF, 0xFF00, 0xFF0000, 0))


def _draw_header(surface: pygame.Surface, record: Record) -> None:
    colours = {"set point": SETPOINT, "temperature": TEMPERATURE}
    colours |= {"command": COMMAND, "applied": APPLIED}
    pygame.draw.rect(surface, _PANEL, (0, 0, SIZE[0], 66))
    pygame.draw.line(surface, _FRAME, (0, 66), (SIZE[0], 66))
    for i, (name, value) in enumerate(record.readings.items()):
        x = 24 + 156 * i
        _write(surface, name, _SMALL, FAINT, topleft=(x, 12))
        for character in value:  # one by one, as images of single characters are cached
            image = _words(character, _LARGE, colours.get(name, _INK))
            surface.blit(image, (x, 32))
            x += image.get_width()


def _draw_temperatures(surface: pygame.Surface, panel: Panel) -> None:
    _draw_ground(surface, panel, "temperature, °C")
    record = panel.record
    setpoints, outputs, _, _ = map(panel.ys, zip(*record.samples, strict=True))
    surface.set_clip(panel.rect)
    _draw_dashes(surface, SETPOINT, panel, setpoints[:-1])
    _draw_curve(surface, TEMPERATURE, list(zip(panel.xs, outputs, strict=False)))
    surface.set_clip(None)
    _draw_edge(surface, panel)
    dot = _dot(TEMPERATURE)
    surface.blit(dot, dot.get_rect(center=_pixel((panel.x(record.k), outputs[-1]))))
    ends = ("set point", SETPOINT, setpoints[-1]), ("temperature", TEMPERATURE, outputs[-1])
    _write_names(surface, panel, *ends)


def _draw_flows(surface: pygame.Surface, panel: Panel) -> None:
    record, plant = panel.record, panel.record.plant
    now, departed = panel.x(record.k), max(_LEFT, panel.x(record.k - record.in_transit))
    zero = panel.y(0.0)
    _draw_ground(surface, panel, "feedwater, t/h")
    surface.set_clip(panel.rect)
    if plant.dead_zone > 0.0:
        upper, lower = panel.y(plant.dead_zone), panel.y(-plant.dead_zone)
        surface.fill(DEAD_ZONE, (_LEFT, upper, _RIGHT - _LEFT, lower - upper + 1))
    if record.in_transit:
        surface.fill(
            IN_TRANSIT,
            (departed, panel.top, now - departed, panel.bottom - panel.top),
            pygame.BLEND_RGB_MULT,
        )
    for limit in (plant.u_max, plant.u_min):
        _draw_limit(surface, _LEFT, _RIGHT, panel.y(limit))
    pygame.draw.line(surface, _FRAME, (_LEFT, zero), (_RIGHT, zero))

    # An input is held from its sample to the next. The first entry is from before the episode.
    _, _, commands, applied = (panel.ys(each[1:]) for each in zip(*record.samples, strict=True))
    if applied:
        if record.in_transit:
            still = _steps(panel, applied[-record.in_transit :])
            pygame.draw.polygon(
                surface, _STILL_TO_COME, [(departed, zero), *still, (now, zero)]
            )
        pygame.draw.lines(surface, APPLIED, False, _steps(panel, applied), 3)
        pygame.draw.lines(surface, COMMAND, False, _steps(panel, commands))
    surface.set_clip(None)
    _draw_edge(surface, panel)
    if record.in_transit:
        _draw_bracket(surface, panel, departed, now)
    if applied:
        ends = ("command", COMMAND, commands[-1]), ("applied", APPLIED, applied[-1])
        _write_names(surface, panel, *ends)


def _draw_ground(surface: pygame.Surface, panel: Panel, title: str) -> None:
    """Draw the background of the lines: the panel, its grid and its tick labels."""
    surface.fill(_PANEL, panel.rect)
    for _, x in panel.minutes():
        pygame.draw.line(surface, _GRID, (x, panel.top), (x, panel.bottom))
    for value in panel.axis.ticks():
        y = panel.y(value)
        pygame.draw.line(surface, _GRID, (_LEFT, y), (_RIGHT, y))
        _write(surface, f"{value:.6g}", _SMALL, FAINT, midright=(_LEFT - 8, y))
    upright = pygame.transform.rotate(_words(title, _SMALL, _INK), 90)
    surface.blit(upright, upright.get_rect(center=(13, (panel.top + panel.bottom) // 2)))


def _draw_edge(surface: pygame.Surface, panel: Panel) -> None:
    """Draw the panel's frame, and a line at the present sample."""
    now = panel.x(panel.record.k)
    pygame.draw.line(surface, _FRAME, (now, panel.top), (now, panel.bottom))
    pygame.draw.rect(surface, _FRAME, panel.rect, 1)


def _draw_bracket(surface: pygame.Surface, panel: Panel, left: float, right: float) -> None:
    """Mark the flow in transit above the panel."""
    y = panel.top - 5
    pygame.draw.line(surface, FAINT, (left, y), (right, y))
    for x in (left, right):
        pygame.draw.line(surface, FAINT, (x, y - 3), (x, y + 3))
    words = _words("in transit", _SMALL, FAINT)
    place = words.get_rect(midbottom=_pixel(((left + right) / 2, y - 4)))
    surface.blit(words, place.clamp(pygame.Rect(_LEFT, 0, SIZE[0] - _LEFT, SIZE[1])))


def _draw_time_axis(surface: pygame.Surface, panel: Panel) -> None:
    y = panel.bottom
    for minute, x in panel.minutes():
        pygame.draw.line(surface, _FRAME, (x, y), (x, y + 5))
        _write(surface, f"{minute:.6g}", _SMALL, FAINT, midtop=(x, y + 9))
    _write(surface, "time, min", _SMALL, _INK, topleft=(_RIGHT + 24, y + 9))


def _draw_legend(surface: pygame.Surface, has_dead_zone: bool) -> None:
    """Explain shade and dots below the panels, where no line crosses the text."""
    x, y = _LEFT, SIZE[1] - 10
    _draw_limit(surface, x, x + 28, y)
    _write(surface, "limits", _SMALL, FAINT, midleft=(x + 36, y))
    if has_dead_zone:
        x += 104
        surface.fill(DEAD_ZONE, (x, y - 5, 28, 10))
        pygame.draw.rect(surface, _FRAME, (x, y - 5, 28, 10), 1)
        _write(surface, "dead zone", _SMALL, FAINT, midleft=(x + 36, y))


def _draw_limit(surface: pygame.Surface, left: int, right: int, y: float) -> None:
    """Draw the dotted line of a limit."""
    for x in range(left, right, 8):
        pygame.draw.line(surface, LIMIT, (x, y), (x + 3, y))


def _draw_curve(surface: pygame.Surface, colour: Colour, points: Sequence[Point]) -> None:
    """Draw an antialiased line about three pixels wide, from lines of pygame's only width."""
    if len(points) < 2:
        return
    for dx, dy in ((0.0, -0.8), (0.0, 0.0), (0.0, 0.8), (0.6, 0.0)):
        pygame.draw.aalines(surface, colour, False, [(x + dx, y + dy) for x, y in points])


def _draw_dashes(
    surface: pygame.Surface, colour: Colour, panel: Panel, heights: Sequence[float]
) -> None:
    """Draw a value held from sample to sample, in dashes that move with the samples."""
    record = panel.record
    period = max(2, round(14 * record.span / (_RIGHT - _LEFT)))  # samples
    for i, y in enumerate(heights):
        if (record.first + i) % period < 0.6 * period:
            ends = (panel.xs[i], y), (panel.xs[i + 1], y)
            pygame.draw.line(surface, colour, *ends, 2)


def _steps(panel: Panel, heights: Sequence[float]) -> list[Point]:
    """Return the line of the latest values, each held from its sample to the next."""
    points: list[Point] = []
    before = len(panel.xs) - 2 - len(heights)  # the last two: the present and next samples
    for i, y in enumerate(heights, start=before):
        points += [(panel.xs[i], y), (panel.xs[i + 1], y)]
    return points


def _write_names(
    surface: pygame.Surface, panel: Panel, *lines: tuple[str, Colour, float]
) -> None:
    """Write the names of two lines beside their ends, one above the other."""
    x = panel.x(panel.record.k) + 10
    (_, _, upper), (_, _, lower) = lines = tuple(sorted(lines, key=lambda line: line[2]))
    middle = (upper + lower) / 2
    apart = max((lower - upper) / 2, 8.0)
    middle = min(max(middle, panel.top + apart), panel.bottom - apart)
    for (name, colour, _), y in zip(lines, (middle - apart, middle + apart), strict=True):
        for dx, dy in ((-2, 0), (2, 0), (0, -2), (0, 2)):  # so that no grid line crosses it
            _write(surface, name, _NORMAL, _PANEL, midleft=(x + dx, y + dy))
        _write(surface, name, _NORMAL, colour, midleft=(x, y))


def _write(
    surface: pygame.Surface, words: str, size: int, colour: Colour, **place: Point
) -> None:
    """Write words with one of their anchors, such as `topleft`, at a point."""
    image = _words(words, size, colour)
    surface.blit(image, image.get_rect(**{side: _pixel(at) for side, at in place.items()}))


def _pixel(point: Point) -> tuple[int, int]:
    return round(point[0]), round(point[1])


@lru_cache(1024)
def _words(words: str, size: int, colour: Colour) -> pygame.Surface:
    # pygame's own font makes pictures the same everywhere. It is opened for each image, as it
    # would not survive a pygame.quit() elsewhere. Drawn at its final size, its letters would be
    # aligned to whole pixels, unevenly spaced.
    pygame.font.init()
    font = pygame.font.Font(None, size * _FINER)
    return _reduce(font.render(words.replace("-", "\N{MINUS SIGN}"), True, colour))


@cache
def _dot(colour: Colour) -> pygame.Surface:
    size = 9 * _FINER
    image = pygame.Surface((size, size), pygame.SRCALPHA)
    image.fill((*colour, 0))
    pygame.draw.circle(image, colour, (size / 2, size / 2), size / 2)
    return _reduce(image)


def _reduce(image: pygame.Surface) -> pygame.Surface:
    width, height = image.get_size()
    return pygame.transform.smoothscale(
        image, (math.ceil(width / _FINER), math.ceil(height / _FINER))
    )
