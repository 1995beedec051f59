"""Draw a picture of an episode with pygame: a panel of temperatures above a panel of flows."""

import math
from collections.abc import Sequence
from typing import NamedTuple
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

from mptc_gym.environments.record import Record

Colour = tuple[int, int, int]  # red, green and blue, 0 to 255

SIZE = 960, 540  # width and height of the picture, pixels
# The panels: left edge, upper edge, width and height, in pixels from the upper left corner.
TEMPERATURES = pygame.Rect(72, 44, 864, 214)
FLOWS = pygame.Rect(72, 324, 864, 182)
# Colours of lines, areas and texts. The coloured lines have colours of the palette of Okabe and
# Ito, which colour-blind readers can tell apart.
TEMPERATURE = (0, 114, 178)
SETPOINT = (213, 94, 0)
APPLIED = (0, 158, 115)
COMMAND = (40, 40, 40)
DEAD_ZONE = (222, 222, 222)
IN_TRANSIT = (205, 229, 246)
LIMIT = (130, 130, 130)
_GRID = (236, 237, 240)
_TEXT = (60, 64, 70)
_WHITE = (255, 255, 255)
clock = pygame.time.Clock()  # limits the frame rate of the window
viewers: WeakSet[object] = WeakSet()  # environments that show pictures in the window


class Label(NamedTuple):
    """A legend text above a panel of the picture."""

    text: str
    colour: Colour
    background: Colour = _WHITE


class Panel:
    """One diagram of the picture, which plots samples of a record over time in minutes.

    Parameters
    ----------
    surface
        The picture to draw on.
    record
        The samples to draw.
    rectangle
        Position and size of the panel in the picture, pixels.
    axis
        Lower end and upper end of the vertical axis, degC or t/h.
    """

    def __init__(
        self,
        surface: pygame.Surface,
        record: Record,
        rectangle: pygame.Rect,
        axis: tuple[float, float],
    ) -> None:
        self._surface = surface
        self._record = record
        self._rectangle = rectangle
        self._axis = axis
        self._font = pygame.font.Font(None, 22)

    def x(self, k: float) -> float:
        """Return the horizontal position of sample k, pixels from the picture's left edge."""
        samples = k - self._record.first
        return self._rectangle.left + samples * self._rectangle.width / self._record.span

    def y(self, value: float) -> float:
        """Return the vertical position of a value, pixels from the picture's upper edge.

        `value` has the unit of the vertical axis, degC or t/h. For a value beyond the axis, the
        position is at the edge of the panel.
        """
        low, high = self._axis
        below_top = (high - value) / (high - low) * self._rectangle.height
        # At least 3 pixels, a line's width, inside the frame. By the order of min and max, NaN
        # is drawn at the lower edge.
        return self._rectangle.top + max(3.0, min(self._rectangle.height - 3.0, below_top))

    def grid(self) -> None:
        """Draw the panel's grid lines and frame, and write the tick labels of both axes."""
        rectangle = self._rectangle
        for value in ticks(*self._axis):
            self.horizontal_line(_GRID, value)
            self.write(f"{value:.6g}", _TEXT, midright=(rectangle.left - 8, self.y(value)))
        first = self._record.first
        last = first + self._record.span
        samples_per_minute = 60.0 / self._record.sampling_interval
        for minutes in ticks(first / samples_per_minute, last / samples_per_minute):
            x = self.x(minutes * samples_per_minute)
            pygame.draw.line(self._surface, _GRID, (x, rectangle.top), (x, rectangle.bottom))
            self.write(f"{minutes:.6g}", _TEXT, midtop=(x, rectangle.bottom + 6))
        # The unit of the time axis is so far left that no tick label overlaps the unit.
        self.write("min", _TEXT, topright=(rectangle.left - 34, rectangle.bottom + 6))
        size_of_frame = rectangle.width + 1, rectangle.height + 1
        frame_of_panel = pygame.Rect(rectangle.topleft, size_of_frame)
        pygame.draw.rect(self._surface, LIMIT, frame_of_panel, width=1)

    def shade(self, colour: Colour, first: int, last: int, low: float, high: float) -> None:
        """Shade the panel from sample `first` to `last`, and from the value `low` to `high`.

        `low` and `high` have the unit of the vertical axis, degC or t/h. The colours of the
        picture are multiplied by `colour`, so that lines under the shading remain visible.
        """
        left = max(self._rectangle.left, round(self.x(first)))
        right = round(self.x(last))
        top = round(self.y(high))
        bottom = round(self.y(low))
        area = left, top, right - left, bottom - top + 1
        self._surface.fill(colour, area, pygame.BLEND_RGB_MULT)

    def horizontal_line(self, colour: Colour, value: float) -> None:
        """Draw a line across the panel at `value`, in the unit of the vertical axis."""
        left = self._rectangle.left
        right = self._rectangle.right
        y = self.y(value)
        pygame.draw.line(self._surface, colour, (left, y), (right, y))

    def curve(
        self, colour: Colour, values: Sequence[float], width: int, *, is_staircase: bool
    ) -> None:
        """Draw a curve of `values`, one for each of the latest samples, the newest last.

        `values` have the unit of the vertical axis, degC or t/h. `width` is the line width in
        pixels. With `is_staircase`, each value holds until the next sample; otherwise, straight
        lines join the values.
        """
        first = self._record.k + 1 - len(values)
        points: list[tuple[float, float]] = []
        for k, value in enumerate(values, start=first):
            x = self.x(k)
            y = self.y(value)
            if is_staircase and points:
                _, previous_y = points[-1]
                points.append((x, previous_y))
            points.append((x, y))
        if len(points) > 1:
            pygame.draw.lines(self._surface, colour, False, points, width)

    def heading(self, *labels: Label) -> None:
        """Write labels in one line above the panel, from left to right."""
        x, y = self._rectangle.left, self._rectangle.top - 16
        for label in labels:
            box = self.write(f" {label.text} ", label.colour, label.background, midleft=(x, y))
            x = box.right + 12

    def write(
        self,
        text: str,
        colour: Colour,
        background: Colour = _WHITE,
        **anchor: tuple[float, float],
    ) -> pygame.Rect:
        """Write a text into the picture, and return the rectangle that the text fills, pixels.

        A minus sign replaces every hyphen in `text`. `anchor` is the position of one point of
        the rectangle, by pygame's name of that point, as in `midleft=(x, y)`, in pixels from
        the picture's upper left corner.
        """
        minus_sign = "\N{MINUS SIGN}"
        image = self._font.render(text.replace("-", minus_sign), True, colour, background)
        ((name, (x, y)),) = anchor.items()
        rectangle = image.get_rect(**{name: (round(x), round(y))})
        return self._surface.blit(image, rectangle)


def draw(record: Record) -> pygame.Surface:
    """Draw a record, and return the picture, 960 pixels wide and 540 pixels high."""
    pygame.font.init()
    # The bytes of a pixel are in the order red, green, blue, as in the arrays of `frame`.
    surface = pygame.Surface(SIZE, depth=24, masks=(0xFF, 0xFF00, 0xFF0000, 0))
    surface.fill(_WHITE)
    _draw_temperatures(surface, record)
    _draw_flows(surface, record)
    return surface


def _draw_temperatures(surface: pygame.Surface, record: Record) -> None:
    """Draw the upper panel of the picture: temperature and set point, degC."""
    panel = Panel(surface, record, TEMPERATURES, record.temperature_axis)
    panel.grid()
    panel.curve(
        TEMPERATURE, [sample.output for sample in record.samples], 3, is_staircase=False
    )
    # The set point is drawn later and thinner than the temperature, so that both curves can be
    # seen where they agree.
    panel.curve(SETPOINT, [sample.setpoint for sample in record.samples], 2, is_staircase=True)
    newest = record.samples[-1]
    minutes = record.k * record.sampling_interval / 60.0
    panel.heading(
        Label(f"temperature {_two_decimals(newest.output)} °C", TEMPERATURE),
        Label(f"set point {_two_decimals(newest.setpoint)} °C", SETPOINT),
        Label(f"error {_two_decimals(newest.setpoint - newest.output)} °C", _TEXT),
        Label(f"time {minutes:.2f} min", _TEXT),
    )


def _draw_flows(surface: pygame.Surface, record: Record) -> None:
    """Draw the lower panel of the picture: flows, limits and dead zone, t/h.

    The newest flows, which do not affect the temperature yet because of the delay, are shaded.
    """
    plant = record.plant
    panel = Panel(surface, record, FLOWS, record.flow_axis)
    panel.grid()
    if plant.dead_zone > 0.0:
        last = record.first + record.span
        panel.shade(DEAD_ZONE, record.first, last, -plant.dead_zone, plant.dead_zone)
    lowest, highest = record.flow_axis
    panel.shade(IN_TRANSIT, record.k - int(plant.delay), record.k, lowest, highest)
    for limit in (plant.u_min, plant.u_max):
        panel.horizontal_line(LIMIT, limit)
    # A sample k holds the flows from sample k-1 to k, so each flow is drawn from sample k-1 on,
    # and the newest flow holds up to sample k. The oldest flow would begin before the picture.
    applied = [sample.applied for sample in record.samples]
    commands = [sample.command for sample in record.samples]
    panel.curve(APPLIED, [*applied[1:], applied[-1]], 3, is_staircase=True)
    panel.curve(COMMAND, [*commands[1:], commands[-1]], 1, is_staircase=True)
    panel.heading(
        Label(f"applied flow {_two_decimals(applied[-1])} t/h", APPLIED),
        Label(f"command {_two_decimals(commands[-1])} t/h", COMMAND),
        Label("dead zone", _TEXT, DEAD_ZONE),
        Label("in transit", _TEXT, IN_TRANSIT),
    )


def frame(record: Record) -> NDArray[np.uint8]:
    """Return a picture of a record: uint8, shape (540, 960, 3), for rows, columns, RGB."""
    return np.array(pygame.surfarray.pixels3d(draw(record)).swapaxes(0, 1), order="C")


def show(record: Record, fps: float, viewer: object) -> None:
    """Show a picture of a record in the window, which `show` opens if necessary.

    All environments share one window, which closes when every environment has called `hide`.

    Parameters
    ----------
    record
        The samples to draw.
    fps
        Maximum number of pictures per second: `show` waits if the previous picture is too
        recent.
    viewer
        Environment whose record is shown.
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
    """Close the window unless an environment other than `viewer` still uses the window."""
    viewers.discard(viewer)
    if not viewers:
        pygame.display.quit()


def ticks(low: float, high: float) -> list[float]:
    """Return 2 to 7 tick values for an axis from `low` to `high`.

    The tick values are multiples of a step, which is 1, 2 or 5 times a power of ten.
    """
    smallest_step = (high - low) / 6.0
    power = 10.0 ** math.floor(math.log10(smallest_step))
    steps = (power, power * 2.0, power * 5.0, power * 10.0)
    step = next(step for step in steps if step >= smallest_step)
    return [i * step for i in range(math.ceil(low / step), math.floor(high / step) + 1)]


def _two_decimals(value: float) -> str:
    """Format a number with two decimals, never "-0.00", or as in 1.23e+05 from 1e5 on."""
    if abs(value) < 1e5:
        return f"{round(value, 2) + 0.0:.2f}"  # adding 0.0 turns -0.0 into 0.0
    return f"{value:.3g}"
