"""Watch a controller at work, in a window or in a film: `python -m benchmarks.watch --help`."""

from __future__ import annotations

import math
import sys
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path

import gymnasium
import pygame
from moviepy.video.io.ffmpeg_writer import FFMPEG_VideoWriter
from PIL import Image

from benchmarks import command_line
from benchmarks.experiments import mean_error
from benchmarks.fan_out import FanOut
from benchmarks.rollout import Trajectory, make_plants, rollout
from benchmarks.roster import BUILT_IN, Factory, build, label, load_factory, observation
from benchmarks.scenarios import SCENARIOS, Scenario
from benchmarks.storage import replacing
from mptc_gym import MiddlePointEnv, Parameters
from mptc_gym.drawing import SIZE
from mptc_gym.rendering import Frame

SPEED = MiddlePointEnv.metadata["render_fps"]  # samples a second
COLOURS = 48  # of a GIF: the lines', the areas' and what lies between them
POLICIES = Path("results/policies")
OUT = Path("results/watch")
Put = Callable[[Frame], object]  # takes the pictures of a film, one after the other


@dataclass(frozen=True)
class Film:
    """A kind of film.

    Attributes
    ----------
    open
        Opens a file, for a number of pictures a second.
    fps
        How many of them a second there are at most.
    """

    open: Callable[[Path, float], AbstractContextManager[Put]]
    fps: int


class Closed(Exception):  # noqa: N818 (no error)
    """The window has been closed."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a controller on a scenario and show it.

    Parameters
    ----------
    arguments
        The command line without the program's name.

    Returns
    -------
    int
        0, or 130 if it was interrupted.
    """
    parser = command_line.parser("watch", "Watch a controller, in a window or in a film.")
    add = parser.add_argument
    names = ", ".join([*BUILT_IN, "ppo"])
    add("--agent", default="nn", help=f"{names}, or MODULE:FACTORY for one of your own")
    add("--scenario", default="square", choices=SCENARIOS, help="case")
    add("--seed", type=command_line.seed, default=0, help="of noise and initial weights")
    add("--speed", type=command_line.number, default=SPEED, help="samples a second")
    add("--video", type=Path, help="file to write, .mp4 or .gif, in place of a window")
    options = parser.parse_args(arguments)
    film: Path | None = options.video
    if film and film.suffix not in FILMS:
        parser.error(f"--video: must end in {' or '.join(FILMS)}, got {film}")
    try:
        factory = _factory(options.agent)
        observation(factory)
    except ValueError as error:
        parser.error(f"--agent: {error}")

    console = command_line.console()
    scenario = SCENARIOS[options.scenario]
    if film is None and not _has_screen():
        film = OUT / f"{options.agent.replace(':', '.')}-{scenario.name}.mp4"
        console.print(f"There is no screen to open a window on: writing a film, {film}")
    try:
        if film is None:
            trajectory = in_window(factory, scenario, options.seed, options.speed)
        else:
            trajectory = in_film(factory, scenario, options.seed, options.speed, film)
    except KeyboardInterrupt:
        console.print("\nInterrupted.")
        return 130
    except Closed:
        return 0
    error = mean_error(trajectory)[0]
    console.print(
        f"{label(options.agent)} on {scenario.title}: mean absolute error {error:.3f} °C"
    )
    if film is not None:
        console.print(f"The film is {film}")
    return 0


def in_window(factory: Factory, scenario: Scenario, seed: int, speed: int) -> Trajectory:
    """Run a controller and show it in a window.

    Parameters
    ----------
    factory
        Makes the controller.
    scenario
        What it runs on.
    seed
        Of the plant and of the controller.
    speed
        Samples a second, if so many can be drawn.

    Returns
    -------
    Trajectory
        Of the one run.

    Raises
    ------
    Closed
        If the window is closed before the end.
    """
    arguments = {**scenario.arguments, **observation(factory)}
    plants = gymnasium.make_vec(
        "MiddlePoint-v0", 1, vectorization_mode="sync", render_mode="human", **arguments
    )
    plant = plants.envs[0].unwrapped
    plant.metadata = {**plant.metadata, "render_fps": speed}

    def stop_if_closed(_: int) -> None:
        if pygame.event.get(pygame.QUIT):
            raise Closed

    controller = build(factory, Parameters(**arguments), 1, seed)
    try:
        return rollout(plants, controller, scenario.samples, seed, stop_if_closed)
    finally:
        plants.close()


def in_film(
    factory: Factory, scenario: Scenario, seed: int, speed: int, path: Path
) -> Trajectory:
    """Run a controller and write what a window would show, as `in_window`, to a file.

    Its pictures are those of every n-th sample, such that there are no more of them a second
    than its kind of film allows.
    """
    arguments = {**scenario.arguments, **observation(factory)}
    plants = make_plants(1, scenario.samples, render_mode="rgb_array", **arguments)
    film = FILMS[path.suffix]
    every = math.ceil(speed / film.fps)
    controller = build(factory, Parameters(**arguments), 1, seed)
    with replacing(path) as partial, film.open(partial, speed / every) as put:

        def draw(k: int) -> None:
            if k % every == 0:
                put(plants.render()[0])

        trajectory = rollout(plants, controller, scenario.samples, seed, draw)
    plants.close()
    return trajectory


@contextmanager
def _mp4(path: Path, fps: float) -> Iterator[Put]:
    writer = FFMPEG_VideoWriter(str(path), SIZE, fps)
    try:
        yield writer.write_frame
    finally:
        writer.close()


@contextmanager
def _gif(path: Path, fps: float) -> Iterator[Put]:
    kept: list[bytes] = []  # compressed: in memory a minute of them takes a gigabyte

    def put(frame: Frame) -> None:
        kept.append(zlib.compress(frame, 1))

    yield put
    pictures = (Image.frombytes("RGB", SIZE, zlib.decompress(data)) for data in kept)
    # One palette for all, of the last picture, which has something of everything in it.
    last = Image.frombytes("RGB", SIZE, zlib.decompress(kept[-1]))
    palette = last.quantize(COLOURS, method=Image.Quantize.MAXCOVERAGE, kmeans=1)
    first, *others = (
        picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures
    )
    first.save(path, save_all=True, append_images=others, duration=1000 / fps, loop=0)


FILMS: dict[str, Film] = {".mp4": Film(_mp4, 30), ".gif": Film(_gif, 10)}


def _factory(agent: str) -> Factory:
    if ":" in agent:
        return load_factory(agent)
    if agent == "ppo":
        from benchmarks import ppo  # here: torch takes seconds to load

        return ppo.Trained(
            ppo.PPOArguments(),
            POLICIES,
            policies=1,
            fan_out=FanOut(1),
            retrain=False,
            progress=True,
        ).members()[0]
    if agent not in BUILT_IN:
        known = ", ".join([*BUILT_IN, "ppo"])
        raise ValueError(f"no {agent!r}; there are {known}, and MODULE:FACTORY of your own")
    return load_factory(BUILT_IN[agent])


def _has_screen() -> bool:
    try:
        pygame.display.init()
    except pygame.error:
        return False
    driver = pygame.display.get_driver()
    pygame.display.quit()
    return driver not in ("dummy", "offscreen")


if __name__ == "__main__":
    sys.exit(main())
