"""Draw pictures of an episode with pygame: a panel of temperatures above a panel of flows."""

import math
from collections.abc import Sequence

import numpy as np
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray

from mptc_gym.record import Record

try:
    import pygame
except ImportError as error:
    raise DependencyNotInstalled(
        'pygame is not installed, run `pip install "mptc_gym[render]"`'
    ) from error

Colour = tuple[int, int, int]  # red, green and blue, 0 to 255
Label = tuple[str, Colour, Colour]  # a text, the text's colour and the background's

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
GRID = (236, 237, 240)
TEXT = (60, 64, 70)
WHITE = (255, 255, 255)
clock = pygame.time.Clock()  # limits the frame rate of the window


class Panel:
    """One diagram of the picture, which plots samples of a record over time in minutes.

    A new panel shows the grid, the frame and the tick labels of both axes.

    Parameters
    ----------
    surface
        The picture to draw on.
    record
        The samples to draw.
    rectangle
        Position and size of the panel in the picture, pixels.
    low, high
        Lower end and upper end of the vertical axis, degC or t/h.
    text_size
        Size of pygame's font for labels, pixels.
    """

    def __init__(
        self,
        surface: pygame.Surface,
        record: Record,
        rectangle: pygame.Rect,
        low: float,
        high: float,
        text_size: int = 22,
    ) -> None:
        self._surface = surface
        self._record = record
        self._rectangle = rectangle
        self._low = low
        self._high = high
        self._first = record.left
        self._font = pygame.font.Font(None, text_size)
        self._draw_axes()

    def _point(self, k: float, value: float) -> tuple[int, int]:
        """Return the position of a value at sample k, pixels from the upper left corner.

        `value` has the unit of the vertical axis, degC or t/h. For a value beyond the axis, the
        position is at the edge of the panel.
        """
        left, top, width, height = self._rectangle
        x = left + (k - self._first) / self._record.span * width
        below_top = (self._high - value) / (self._high - self._low) * height
        # At least 3 pixels, a line's width, inside the frame.
        return round(x), round(top + max(3.0, min(height - 3.0, below_top)))

    def _draw_axes(self) -> None:
        """Draw the panel's grid lines and frame, and write the tick labels of both axes."""
        left, top, width, height = self._rectangle
        last = self._first + self._record.span
        for value in ticks(self._low, self._high):
            self.fill(GRID, self._first, last, value, value)
            _, y = self._point(last, value)
            self.write(f"{value:.6g}", TEXT, midright=(left - 8, y))
        samples_per_minute = 60.0 / self._record.sampling_interval
        below = top + height + 6
        for minutes in ticks(self._first / samples_per_minute, last / samples_per_minute):
            k = minutes * samples_per_minute
            self.fill(GRID, k, k, self._low, self._high)
            x, _ = self._point(k, self._low)
            self.write(f"{minutes:.6g}", TEXT, midtop=(x, below))
        # The unit of the time axis is so far left that no tick label overlaps the unit.
        self.write("min", TEXT, topright=(left - 34, below))
        frame_of_panel = left, top, width + 1, height + 1
        pygame.draw.rect(self._surface, LIMIT, frame_of_panel, width=1)

    def fill(self, colour: Colour, first: float, last: float, low: float, high: float) -> None:
        """Fill the panel from sample `first` to `last`, and from the value `low` to `high`.

        The area is at least one pixel wide and high, so that `fill` draws lines, too; parts of
        the area to the left of the panel are left out. `low` and `high` have the unit of the
        vertical axis, degC or t/h. The colours of the picture are multiplied by
        `colour`, so that lines under the area remain visible.
        """
        left, top = self._point(first, high)
        right, bottom = self._point(last, low)
        area = pygame.Rect(left, top, right - left + 1, bottom - top + 1)
        self._surface.fill(colour, area.clip(self._rectangle), pygame.BLEND_RGB_MULT)

    def curve(
        self, colour: Colour, values: Sequence[float], width: int, *, is_staircase: bool
    ) -> None:
        """Draw a curve of `values`, one for each sample in the record, the newest last.

        `values` have the unit of the vertical axis, degC or t/h. `width` is the line width in
        pixels. With `is_staircase`, each value holds until the next sample; otherwise, straight
        lines join the values.
        """
        points = list(map(self._point, range(self._first, self._record.k + 1), values))
        if is_staircase:  # Each value is drawn at its own sample and at the next one.
            # The x of the next sample belongs to the y of this one.
            doubled = np.repeat(points, 2, axis=0)
            points = np.column_stack((doubled[1:, 0], doubled[:-1, 1])).tolist()
        if len(points) > 1:  # as pygame draws no line through one point
            pygame.draw.lines(self._surface, colour, False, points, width)

    def heading(self, *labels: Label) -> None:
        """Write labels in one line above the panel, from left to right."""
        x, y = self._rectangle.left, self._rectangle.top - 16
        for text, colour, background in labels:
            x = 12 + self.write(f" {text} ", colour, background, midleft=(x, y)).right

    def write(
        self,
        text: str,
        colour: Colour,
        background: Colour = WHITE,
        **anchor: tuple[int, int],
    ) -> pygame.Rect:
        """Write a text into the picture, and return the rectangle that the text fills, pixels.

        A minus sign replaces every hyphen in `text`. `anchor` is the position of one point of
        the rectangle, by pygame's name of that point, as in `midleft=(x, y)`, in pixels from
        the picture's upper left corner.
        """
        minus_sign = "\N{MINUS SIGN}"
        image = self._font.render(text.replace("-", minus_sign), True, colour, background)
        return self._surface.blit(image, image.get_rect(**anchor))


def frame(record: Record) -> NDArray[np.uint8]:
    """Return a picture of a record: uint8, shape (540, 960, 3), for rows, columns, RGB."""
    surface = pygame.Surface(SIZE, depth=32)
    draw(surface, record)
    return np.array(pygame.surfarray.pixels3d(surface).swapaxes(0, 1), order="C")


def show(record: Record, fps: float) -> None:
    """Show a picture of a record in pygame's window, at most `fps` pictures per second.

    `show` opens the window if none is open, and waits if the previous picture is too recent.
    """
    screen = pygame.display.get_surface()
    if screen is None:
        screen = pygame.display.set_mode(SIZE)
        pygame.display.set_caption("MiddlePoint-v0")
    draw(screen, record)
    pygame.event.pump()
    clock.tick(fps)
    pygame.display.flip()


def draw(surface: pygame.Surface, record: Record) -> None:
    """Draw a record on a surface of the size `SIZE`."""
    pygame.font.init()
    surface.fill(WHITE)
    _draw_temperatures(surface, record)
    _draw_flows(surface, record)


def _draw_temperatures(surface: pygame.Surface, record: Record) -> None:
    """Draw the upper panel of the picture: temperature and set point, degC."""
    low, high = record.extremes
    margin = max(0.05 * (high - low), 0.5)
    panel = Panel(surface, record, TEMPERATURES, low - margin, high + margin)
    panel.curve(TEMPERATURE, record.latest("output"), 3, is_staircase=False)
    # The set point is drawn later and thinner than the temperature, so that both curves can be
    # seen where they agree.
    panel.curve(SETPOINT, record.latest("setpoint"), 2, is_staircase=True)
    newest = record.infos[-1]
    minutes = record.k * record.sampling_interval / 60.0
    panel.heading(
        (f"temperature {_two_decimals(newest['output'])} °C", TEMPERATURE, WHITE),
        (f"set point {_two_decimals(newest['setpoint'])} °C", SETPOINT, WHITE),
        (f"error {_two_decimals(newest['error'])} °C", TEXT, WHITE),
        (f"time {minutes:.2f} min", TEXT, WHITE),
    )


def _draw_flows(surface: pygame.Surface, record: Record) -> None:
    """Draw the lower panel of the picture: flows, limits and dead zone, t/h.

    The newest flows, which do not affect the temperature yet because of the delay, are shaded.
    """
    plant = record.plant
    low = min(plant.u_min, 0.0)
    high = max(plant.u_max, 0.0)
    margin = 0.12 * (high - low)
    panel = Panel(surface, record, FLOWS, low - margin, high + margin)
    right_edge = max(record.k, record.span)
    panel.fill(DEAD_ZONE, 0, right_edge, -plant.dead_zone, plant.dead_zone)
    first_in_transit = record.k - int(plant.delay)
    panel.fill(IN_TRANSIT, first_in_transit, record.k, low - margin, high + margin)
    for limit in (plant.u_min, plant.u_max):
        panel.fill(LIMIT, 0, right_edge, limit, limit)
    # A sample k holds the flows from sample k-1 to k, so each flow is drawn from sample k-1 on,
    # and the newest flow holds up to sample k. The oldest flow would begin before the picture.
    applied = record.latest("applied")
    commands = record.latest("command")
    panel.curve(APPLIED, [*applied[1:], applied[-1]], 3, is_staircase=True)
    panel.curve(COMMAND, [*commands[1:], commands[-1]], 1, is_staircase=True)
    panel.heading(
        (f"applied flow {_two_decimals(applied[-1])} t/h", APPLIED, WHITE),
        (f"command {_two_decimals(commands[-1])} t/h", COMMAND, WHITE),
        ("dead zone", TEXT, DEAD_ZONE),
        ("in transit", TEXT, IN_TRANSIT),
    )


def _two_decimals(value: float) -> str:
    """Format a number with two decimals, never as "-0.00"."""
    return f"{round(value, 2) + 0.0:.2f}"  # adding 0.0 turns -0.0 into 0.0


def ticks(low: float, high: float) -> list[float]:
    """Return at most 7 values for an axis: multiples of 1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(high - low))
    step = next(m * power for m in (0.2, 0.5, 1.0, 2.0) if (high - low) / (m * power) <= 6.0)
    return [i * step for i in range(math.ceil(low / step), math.floor(high / step) + 1)]
