"""Make a film of a controller at work: `python -m benchmarks.watch --help`."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.controllers.options import chosen
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command import Parameter, Seed, command, known, options
from benchmarks.lib.storage import UsageError, out_folder, replacing
from benchmarks.loop.rollout import Trajectory, held
from benchmarks.loop.scenarios import SCENARIOS, PlantOptions

REFERENCE = ROSTER["nn-smith"]  # whose errors those of the film are multiples of
PICTURES = 60  # of a film, after the first
STYLE: Any = {"font.size": 15, "axes.spines.top": False, "axes.spines.right": False}
_AGENT = f"Who controls: {', '.join(ROSTER)}, or your own as in `compare`, NAME=MODULE:FACTORY."
_CASE = (
    f"Case to run: {', '.join(SCENARIOS)}, or a plant of your own: square, constant, run "
    "(default: the first)."
)


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Make a film of a controller at work."""

    agent: Annotated[str, Parameter(help=_AGENT)] = "nn"
    scenario: Annotated[str | None, Parameter(help=_CASE)] = None
    plant: PlantOptions = field(default_factory=PlantOptions)
    seed: Seed = 0
    """Seed of noise and initial weights."""
    video: Path | None = None
    """The film, a .gif file (default: in results/watch)."""


def work(options: Options) -> str:
    """Run a controller on a case and write a film of it."""
    cases = options.plant.cases(SCENARIOS)
    case = cases[known("--scenario", [options.scenario or next(iter(cases))], cases)[0]]
    own = [options.agent] if "=" in options.agent else []
    (controller,) = chosen(
        [] if own else known("--agent", [options.agent], ROSTER), own
    ).values()
    path = options.video or Path("results/watch", f"{controller.name}-{case.name}.gif")
    if path.suffix != ".gif":
        raise UsageError(f"--video: must end in .gif, got {path}")
    out_folder(path.absolute().parent, "--video")
    run, reference = (
        each.members()[0].run(case.arguments, case.samples, 1, options.seed)
        for each in (controller, REFERENCE)
    )
    interval = case.parameters.sampling_interval
    found = write_film(path, controller.label, interval, run, reference)
    return f"On {case.title}:\n{found}\nThe film is {path}"


def equal_steps(setpoint: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Return the first and the last of equal steps of the set point, as start and stop sample.

    These are the steps that lie farthest apart; without any there is the whole run.
    """
    alike: dict[Any, list[tuple[int, int]]] = {}
    before = 0.0
    for start, stop in held(setpoint):
        alike.setdefault((before, setpoint[start], stop - start), []).append((start, stop))
        before = setpoint[start]
    found = max(alike.values(), key=lambda steps: steps[-1][0] - steps[0][0])
    return [found[0], found[-1]] if len(found) > 1 else [(0, len(setpoint))]


def write_film(
    path: Path, label: str, interval: float, run: Trajectory, reference: Trajectory
) -> str:
    """Write a film of the first and the last of equal steps of a run, and return its title.

    Errors are multiples of the reference's on the same step; samples are `interval` seconds
    apart. The first picture shows all. Then the run goes on from sample to sample.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from PIL import Image

    steps = equal_steps(run.setpoint[:, 0])
    minutes = np.arange(steps[0][1] - steps[0][0]) * interval / 60.0
    runs = (reference, "#E69F00", REFERENCE.label), (run, "#0072B2", label)
    lines, multiples, pictures = [], [], []
    with rc_context(STYLE):
        figure = Figure((7.5, 5.0), dpi=100, layout="constrained")
        panels = figure.subplots(2, len(steps), sharex=True, sharey="row", squeeze=False)
        for (upper, lower), (start, stop) in zip(panels.T, steps, strict=True):
            step = slice(start, stop)
            ours, theirs = (np.abs(each.next_error[step]).mean() for each in (run, reference))
            multiples.append(f"{ours / theirs:.2f}")
            upper.set_title(f"from {start * interval / 60:.0f} min on: {multiples[-1]}")
            upper.plot(minutes, run.setpoint[step], "--", color="0.3", label="set point")
            lower.set_xlabel("min")
            for each, colour, name in runs:
                lines += upper.plot(minutes, each.output[step], color=colour, lw=2, label=name)
                lines += lower.plot(minutes, each.applied[step], color=colour, lw=2)
        panels[0, 0].set_ylabel("°C")
        panels[1, 0].set_ylabel("t/h")
        named = panels[0, 0].get_legend_handles_labels()
        figure.legend(*named, loc="outside lower center", ncols=3, frameon=False)
        title = f"{label}: error {' and '.join(multiples)} times that of the {REFERENCE.label} "
        title += "predictor on the same step"
        figure.suptitle(textwrap.fill(title, 62), x=0.01, ha="left", weight="bold", size=15)
        canvas: Any = FigureCanvasAgg(figure)
        drawn = [line.get_data() for line in lines]
        for share in (1.0, *np.arange(1, PICTURES + 1) / PICTURES):
            shown = max(1, round(share * len(minutes)))
            for line, (x, y) in zip(lines, drawn, strict=True):
                line.set_data(x[:shown], y[:shown])
            canvas.draw()
            figure.set_layout_engine("none")  # done once, by the first picture
            pictures.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))
    palette = pictures[0].quantize(24)  # few colours make it small
    first, *others = (
        each.quantize(palette=palette, dither=Image.Dither.NONE) for each in pictures
    )
    durations = [2500, *[100] * (PICTURES - 1), 1000]  # ms
    with replacing(path) as partial:
        first.save(partial, save_all=True, append_images=others, duration=durations, loop=0)
    return title


main = command("watch", Options, work, interrupted="nothing is kept.")

if __name__ == "__main__":
    raise SystemExit(main(None))
