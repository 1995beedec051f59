"""Run a controller as the options say, and show it."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pygame
from moviepy.video.io.ffmpeg_writer import FFMPEG_VideoWriter
from PIL import Image
from rich.console import Console

from benchmarks.controllers.engineered import limits
from benchmarks.controllers.own import own_entry
from benchmarks.controllers.records import Factory, RosterEntry
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command_line import UsageError
from benchmarks.lib.storage import replacing
from benchmarks.lib.tables import on_screen
from benchmarks.loop.metrics import mean_error
from benchmarks.loop.rollout import Trajectory
from benchmarks.loop.scenarios import SCENARIOS, Scenario, scenarios_of
from benchmarks.watch import rivals
from benchmarks.watch.hands import HELP, Closed, Hands
from benchmarks.watch.options import YOU, Options
from mptc_gym import Parameters, drawing
from mptc_gym.drawing import SIZE
from mptc_gym.record import Record
from mptc_gym.rendering import Frame

COLOURS = 48  # of a GIF: lines, areas and the shades between them
OUT = Path("results/watch")
Put = Callable[[Frame], object]  # takes the frames of a film, one after the other


def execute(options: Options, console: Console) -> str:
    """Run a controller on a scenario and show it."""
    film = options.video
    if film and film.suffix not in FILMS:
        raise UsageError(f"--video: must end in {' or '.join(FILMS)}, got {film}")
    controller = None if options.agent == YOU else _controller(options.agent)
    label = controller.label if controller else YOU
    plant = options.plant.chosen()
    scenarios = scenarios_of(plant.name, plant.arguments) if plant.arguments else SCENARIOS
    scenario = scenarios.get(options.scenario)
    if scenario is None:
        raise UsageError(
            f"--scenario: no {options.scenario!r} on this plant; there are "
            f"{', '.join(scenarios)}"
        )
    needs_film = film is not None or not _has_screen()
    if controller is None and needs_film:
        raise UsageError(f"--agent {YOU}: needs a screen to open a window on, and no --video")
    factory = controller.first() if controller else None
    if film is None and needs_film:
        film = OUT / f"{options.agent.replace(':', '.')}-{scenario.name}.mp4"
        console.print(f"There is no screen to open a window on: writing a film, {film}")
    if factory and film:
        trajectory = in_film(factory, scenario, options.seed, options.speed, film)
    else:
        console.print(HELP)
        try:
            trajectory, moves = in_window(factory, scenario, options.seed, options.speed)
        except Closed:
            return "The window was closed."
        if controller is None or moves:
            console.print("The same for the controllers ...")
            table = rivals.table(label, trajectory, moves, scenario, options.seed)
            console.print(on_screen(table))
    found = f"{mean_error(trajectory)[0]:.3f} °C" + (f"\nThe film is {film}" if film else "")
    return f"{label} on {scenario.title}: mean absolute error {found}"


def in_window(
    factory: Factory | None, scenario: Scenario, seed: int, speed: int
) -> tuple[Trajectory, rivals.Moves]:
    """Run a controller, or let the viewer control if there is none, and show it in a window.

    Return the run and the moves of set point and load. Closing the window before the end
    raises `Closed`.
    """
    arguments = factory.arguments(scenario.arguments) if factory else scenario.arguments
    hands = Hands(**limits(Parameters(**arguments)), speed=speed)
    plant = rivals.Touched(hands.show, **arguments)
    moves: rivals.Moves = {}

    def attend(k: int) -> None:
        hands.take(pygame.event.get())
        while hands.paused:
            pygame.time.wait(20)
            hands.take(pygame.event.get())
        if (hands.setpoint, hands.load) != (plant.setpoint, plant.load):
            moves[k] = plant.setpoint, plant.load = hands.setpoint, hands.load

    controller = factory(arguments, 1, seed) if factory else hands
    pygame.display.init()
    pygame.key.set_repeat(300, 60)  # ms
    try:
        return rivals.run(plant, controller, scenario.samples, seed, attend), moves
    finally:
        drawing.close_window()


def in_film(
    factory: Factory, scenario: Scenario, seed: int, speed: int, path: Path
) -> Trajectory:
    """Run a controller and write a film of what a window would show.

    The film shows every n-th sample, as its format limits the number of frames per second.
    """
    film, fps = FILMS[path.suffix]
    every = math.ceil(speed / fps)
    with replacing(path) as partial, film(partial, speed / every) as put:

        def show(record: Record) -> None:
            if record.k % every == 0 and record.k < scenario.samples:
                put(drawing.frame(record))

        return rivals.replay(factory, scenario, seed, show=show)


@contextmanager
def _mp4(path: Path, fps: float) -> Iterator[Put]:
    with FFMPEG_VideoWriter(str(path), SIZE, fps) as writer:
        yield writer.write_frame


@contextmanager
def _gif(path: Path, fps: float) -> Iterator[Put]:
    kept: list[bytes] = []  # compressed: a minute of raw frames takes a gigabyte of memory
    yield lambda frame: kept.append(zlib.compress(frame.tobytes(), 1))

    def picture(data: bytes) -> Image.Image:
        return Image.frombytes("RGB", SIZE, zlib.decompress(data))

    # One palette for all frames, taken from the last, which shows a bit of everything.
    palette = picture(kept[-1]).quantize(COLOURS, Image.Quantize.MAXCOVERAGE, kmeans=1)
    first, *others = (
        picture(data).quantize(palette=palette, dither=Image.Dither.NONE) for data in kept
    )
    first.save(path, save_all=True, append_images=others, duration=1000 / fps, loop=0)


# By suffix: the writer, given a file and the frames per second, and the most frames per second.
FILMS: dict[str, tuple[Callable[[Path, float], AbstractContextManager[Put]], int]] = {
    ".mp4": (_mp4, 30),
    ".gif": (_gif, 10),
}


def _controller(agent: str) -> RosterEntry:
    name, equals, location = agent.partition("=")
    if ":" in agent:
        return own_entry(name, [location if equals else agent])
    if agent not in ROSTER:
        raise UsageError(
            f"--agent: no {agent!r}; there are {', '.join(ROSTER)}, {YOU}, and "
            "NAME=MODULE:FACTORY or NAME=PPO:FILE.zip of your own"
        )
    return ROSTER[agent]


def _has_screen() -> bool:
    try:
        pygame.display.init()
    except pygame.error:
        return False
    driver = pygame.display.get_driver()
    pygame.display.quit()
    return driver not in ("dummy", "offscreen")
