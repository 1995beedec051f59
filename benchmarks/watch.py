"""Make a film of a controller at work: `python -m benchmarks.watch --help`."""

import textwrap
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.controllers.options import chosen
from benchmarks.controllers.roster import ROSTER, Controller
from benchmarks.lib.command import Seed, command, known, options
from benchmarks.lib.storage import UsageError, out_folder, replacing
from benchmarks.loop.rollout import held
from benchmarks.loop.scenarios import SCENARIOS, PlantOptions, Scenario

REFERENCE = ROSTER["neural-smith"]  # whose errors those of the film are multiples of
PICTURES = 60  # of a film, after the first
STYLE: Any = {"font.size": 15, "axes.spines.top": False, "axes.spines.right": False}


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Make a film of a controller at work."""

    agent: str = "nn"
    """Who controls: a name as in `compare`, or your own, NAME=MODULE:FACTORY."""
    scenario: str | None = None
    """Case to run, as in `compare`; on a plant of your own: square, constant, run (default:
    the first)."""
    plant: PlantOptions = field(default_factory=PlantOptions)
    seed: Seed = 0
    """Seed of noise and initial weights."""
    video: Path | None = None
    """The film, a .gif file (default: in results/watch)."""


def work(options: Options) -> str:
    """Run a controller on a case and write a film of it."""
    cases = options.plant.cases(SCENARIOS)
    case = cases[known("--scenario", [options.scenario or next(iter(cases))], cases)[0]]
    own = "=" in options.agent
    names = [] if own else known("--agent", [options.agent], ROSTER)
    (controller,) = chosen(names, [options.agent] if own else []).values()
    path = options.video or Path("results/watch", f"{controller.name}-{case.name}.gif")
    if path.suffix != ".gif":
        raise UsageError(f"--video: must end in .gif, got {path}")
    out_folder(path.absolute().parent, "--video")
    found = write_film(path, case, controller, options.seed)
    return f"On {case.title}:\n{found}\nThe film is {path}"


def equal_steps(setpoint: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Return start and stop of the two equal steps farthest apart; without, of the run."""
    alike: dict[Any, list[tuple[int, int]]] = {}
    before = 0.0
    for start, stop in held(setpoint):
        alike.setdefault((before, setpoint[start], stop - start), []).append((start, stop))
        before = setpoint[start]
    found = max(alike.values(), key=lambda steps: steps[-1][0] - steps[0][0])
    return [found[0], found[-1]] if len(found) > 1 else [(0, len(setpoint))]


def write_film(path: Path, case: Scenario, controller: Controller, seed: int) -> str:
    """Write a film of equal steps of a run, and return its title.

    The first picture shows all. Then the run goes on from sample to sample.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from PIL import Image

    theirs, ours = (
        each.members()[0].run(case.arguments, case.samples, 1, seed)
        for each in (REFERENCE, controller)
    )
    runs = (theirs, "#E69F00", REFERENCE.label), (ours, "#0072B2", controller.label)
    steps = equal_steps(ours.setpoint[:, 0])
    interval = case.parameters.sampling_interval / 60.0  # min
    minutes = np.arange(np.ptp(steps[0])) * interval
    lines, multiples, pictures = [], [], []
    with rc_context(STYLE):
        figure = Figure((7.5, 5.0), dpi=100, layout="constrained")
        panels = figure.subplots(2, len(steps), sharex=True, sharey="row", squeeze=False)
        for (upper, lower), (start, stop) in zip(panels.T, steps, strict=True):
            step = slice(start, stop)
            other, own = (np.abs(each.next_error[step]).mean() for each in (theirs, ours))
            multiples.append(f"{own / other:.2f}")
            upper.set_title(f"from {interval * start:.0f} min on: {multiples[-1]}")
            upper.plot(minutes, ours.setpoint[step], "--", color="0.3", label="set point")
            for each, colour, name in runs:
                lines += upper.plot(minutes, each.output[step], color=colour, lw=2, label=name)
                lines += lower.plot(minutes, each.applied[step], color=colour, lw=2)
            lower.set_xlabel("min")
        panels[0, 0].set_ylabel("°C")
        panels[1, 0].set_ylabel("t/h")
        named = panels[0, 0].get_legend_handles_labels()
        figure.legend(*named, loc="outside lower center", ncols=3, frameon=False)
        title = f"{controller.label}: error {' and '.join(multiples)} times that of the "
        title += f"{REFERENCE.label} predictor on the same step"
        figure.suptitle(textwrap.fill(title, 62), x=0.01, ha="left", weight="bold", size=15)
        canvas: Any = FigureCanvasAgg(figure)
        drawn = [line.get_data() for line in lines]
        for shown in (PICTURES, *range(1, PICTURES + 1)):
            last = max(1, round(shown / PICTURES * len(minutes)))
            for line, signals in zip(lines, drawn, strict=True):
                line.set_data(*(each[:last] for each in signals))
            canvas.draw()
            figure.set_layout_engine("none")  # done once, by the first picture
            pictures.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))
    palette, none = pictures[0].quantize(24), Image.Dither.NONE  # few colours make it small
    first, *others = (each.quantize(palette=palette, dither=none) for each in pictures)
    durations = [2500, *[100] * (PICTURES - 1), 1000]  # ms
    with replacing(path) as partial:
        first.save(partial, save_all=True, append_images=others, duration=durations, loop=0)
    return title


main = command("watch", Options, work)

if __name__ == "__main__":
    raise SystemExit(main(None))
