"""Film the network of 1992, which learns within an hour and is ruined within a day: film.gif.

Two PI controllers run beside the network, without a restart. The script needs
`pip install -e ".[compare,render]"`.
"""

import numpy as np
import pygame
from PIL import Image

from agents import DirectNNController, PIController
from benchmarks.controllers.known_plant import PAPER
from benchmarks.controllers.roster import pi_simc
from benchmarks.loop.runs import Trajectory, simulate_together
from mptc_gym.record import Record
from mptc_gym.rendering import TEMPERATURE, TEXT, WHITE, Panel

ACTS = {0: "from the start", 12_000: "after 27 hours"}  # by the first sample of an act
SAMPLES, STRIDE = 1200, 20  # of an act, and from one picture to the next
SETPOINT = (150, 150, 150)  # wide and light, so that the film needs no colours
PI_SIMC, _ = pi_simc(PAPER, 1, 0)  # and arguments of its environment, the defaults
CONTROLLERS = {
    "Network of 1992: its 25 random weights learn as it controls": DirectNNController(
        num_envs=1
    ),
    "PI controller of 1992: two gains, from the paper": PIController(),
    "PI controller (SIMC): two gains, by a rule from a step test": PI_SIMC,
}


def draw(canvas: pygame.Surface, row: int, title: str, first: int, signals: Trajectory) -> None:
    """Draw the panel of one controller in the act that begins at sample `first`."""
    record = Record(PAPER.parameters.lowest, 8.0, first=first, span=SAMPLES)
    for setpoint, output in zip(signals.setpoint[:, 0], signals.output[:, 0], strict=True):
        record.add({"setpoint": setpoint, "output": output})
    left = 76 if first == 0 else 548  # the acts stand side by side
    area = pygame.Rect(left, 70 + 206 * row, 384, 104)
    # Erase what an earlier picture has here, with the labels of the axes.
    canvas.fill(WHITE, (area.left - 70, area.top - 34, 466, 172))
    panel = Panel(canvas, record, area, -8.0, 8.0, text_size=29)
    panel.curve(SETPOINT, record.latest("setpoint"), 6, is_staircase=True)
    panel.curve(TEMPERATURE, record.latest("output"), 3, is_staircase=False)
    error = np.abs(signals.next_error[:-1]).mean()  # as scores have it, without e(0)
    panel.write(title, TEXT, bottomleft=(12, area.top - 38))
    panel.write(ACTS[first], TEXT, bottomleft=(area.left, area.top - 6))
    panel.write(f"mean error {error:.2f} °C", TEXT, bottomright=(area.right, area.top - 6))
    panel.write("temperature (°C)", TEMPERATURE, bottomright=(822, 32))
    panel.write("set point", SETPOINT, bottomright=(932, 32))


def main() -> None:
    """Run the controllers, and write the film, with a picture for every 20th sample."""
    samples = max(ACTS) + SAMPLES + 1
    runs = simulate_together([*CONTROLLERS.values()], runs=1, samples=samples, seed=0)
    pygame.font.init()
    canvas = pygame.Surface((960, 620))
    canvas.fill(WHITE)
    pictures = []
    for first in ACTS:
        for last in range(first + STRIDE, first + SAMPLES + 1, STRIDE):
            for row, (title, signals) in enumerate(zip(CONTROLLERS, runs, strict=True)):
                draw(canvas, row, title, first, signals[first : last + 1])
            pictures.append(Image.fromarray(pygame.surfarray.array3d(canvas).swapaxes(0, 1)))
    palette = pictures[-1].quantize(16)
    # The last picture comes first, for readers whose browser shows no moving pictures.
    film = [
        picture.quantize(palette=palette, dither=Image.Dither.NONE)
        for picture in pictures[-1:] + pictures
    ]
    times = [1600] + [80] * len(pictures)  # milliseconds
    times[len(pictures) // 2] = times[-1] = 1000  # the ends of the acts
    film[0].save("film.gif", save_all=True, append_images=film[1:], duration=times, loop=0)


if __name__ == "__main__":
    main()
