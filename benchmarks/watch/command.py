"""Run a controller as the options say, and show it in a window or a film."""

from __future__ import annotations

import itertools
import math
import zlib
from pathlib import Path

import numpy as np
import pygame
from gymnasium.vector import SyncVectorEnv
from PIL import Image, ImageDraw
from rich.console import Console

from benchmarks.controllers.options import own_entry
from benchmarks.controllers.records import Factory, RosterEntry
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command import UsageError
from benchmarks.lib.drawing import with_few_colours
from benchmarks.lib.storage import replacing
from benchmarks.loop.metrics import mean_error
from benchmarks.loop.plants import PlantOptions
from benchmarks.loop.rollout import Trajectory, rollout
from benchmarks.loop.scenarios import SCENARIOS, Scenario, scenarios_of
from benchmarks.watch.__main__ import Options
from mptc_gym import MiddlePointEnv, drawing
from mptc_gym.drawing import SIZE

LINES = (drawing.SETPOINT, drawing.TEMPERATURE, drawing.APPLIED, drawing.COMMAND)
COLOURS = 20  # of a GIF: lines, areas and the shades between them
FASTEST = 10  # pictures a second of a GIF
SHOWN = 560, 7 * SIZE[1] // 12  # size of one half of the run
CAPTION = 28  # height of its caption
OUT = Path("results/watch")


class Closed(Exception):  # noqa: N818 (no error)
    """The window has been closed."""


def execute(options: Options, console: Console) -> str:
    """Run a controller on a scenario and show it."""
    path = options.video
    if path and path.suffix != ".gif":
        raise UsageError(f"--video: must end in .gif, got {path}")
    controller = _controller(options.agent)
    plant, another = options.plant.chosen(), options.plant != PlantOptions()
    scenarios = scenarios_of(plant.name, plant.arguments) if another else SCENARIOS
    scenario = scenarios.get(options.scenario)
    if scenario is None:
        raise UsageError(
            f"--scenario: no {options.scenario!r} on this plant; there are "
            f"{', '.join(scenarios)}"
        )
    factory = controller.members()[0]
    if path is None and not _has_screen():
        path = OUT / f"{options.agent.replace(':', '.')}-{scenario.name}.gif"
        console.print(f"There is no screen to open a window on: writing a film, {path}")
    if path:
        trajectory = write_film(factory, scenario, options.seed, options.speed, path)
    else:
        try:
            trajectory = show(factory, scenario, options.seed, options.speed)
        except Closed:
            return "The window was closed."
    found = f"{mean_error(trajectory)[0]:.3f} °C" + (f"\nThe film is {path}" if path else "")
    return f"{controller.label} on {scenario.title}: mean absolute error {found}"


def show(factory: Factory, scenario: Scenario, seed: int, speed: int) -> Trajectory:
    """Run a controller in a window; closing it before the end raises `Closed`."""
    arguments = factory.arguments(scenario.arguments)
    plant = MiddlePointEnv(render_mode="human", **arguments)
    plant.metadata = {**plant.metadata, "render_fps": speed}
    envs = SyncVectorEnv([lambda: plant])

    def attend(k: int) -> None:
        if pygame.event.get(pygame.QUIT):
            raise Closed

    try:
        return rollout(envs, factory(arguments, 1, seed), scenario.samples, seed, attend)
    finally:
        plant.close()


def write_film(
    factory: Factory, scenario: Scenario, seed: int, speed: int, path: Path
) -> Trajectory:
    """Run a controller, and write what a window would show as an animated GIF.

    Both halves of the run are shown at once, the first above the second, with the mean error of
    each. Of the samples every n-th is shown, as viewers play at most some 10 pictures a second.
    """
    every = math.ceil(speed / FASTEST)
    arguments = factory.arguments(scenario.arguments)
    plant = MiddlePointEnv(render_mode="rgb_array", **arguments)
    half = math.ceil(scenario.samples / 2)
    frames: list[list[bytes]] = [[], []]  # compressed: raw frames take a gigabyte of memory

    def keep(k: int) -> None:
        if k % half % every == 0:
            picture = Image.fromarray(np.asarray(plant.render()))
            small = picture.resize(SHOWN, Image.Resampling.LANCZOS)
            frames[k // half].append(zlib.compress(small.tobytes(), 1))

    envs = SyncVectorEnv([lambda: plant])
    trajectory = rollout(envs, factory(arguments, 1, seed), scenario.samples, seed, keep)
    errors = [np.abs(part).mean() for part in np.split(trajectory.error, [half])]
    sheet = Image.new("RGB", (SHOWN[0], 2 * (SHOWN[1] + CAPTION)), "white")
    places = [(0, CAPTION), (0, SHOWN[1] + 2 * CAPTION)]
    for name, error, (x, y) in zip(("first", "second"), errors, places, strict=True):
        text = f"{name} half of the run: mean error {error:.2f} °C"
        ImageDraw.Draw(sheet).text((x + 12, y - 22), text, "black", font_size=16)
    pictures = []
    for pair in itertools.zip_longest(*frames):
        for frame, place in zip(pair, places, strict=True):
            if frame:
                sheet.paste(Image.frombytes("RGB", SHOWN, zlib.decompress(frame)), place)
        pictures.append(sheet.copy())
    first, *others = with_few_colours(pictures, COLOURS, LINES)
    duration = 1000 * every / speed  # of a frame, ms
    with replacing(path) as partial:
        first.save(partial, save_all=True, append_images=others, duration=duration, loop=0)
    return trajectory


def _controller(agent: str) -> RosterEntry:
    name, equals, location = agent.partition("=")
    if ":" in agent:
        return own_entry(name, [location if equals else agent])
    if agent not in ROSTER:
        raise UsageError(
            f"--agent: no {agent!r}; there are {', '.join(ROSTER)}, and "
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
