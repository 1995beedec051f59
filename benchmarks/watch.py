"""Make a film of a controller at work: `python -m benchmarks.watch --help`."""

import textwrap
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.controllers.options import agent_names, chosen
from benchmarks.controllers.roster import ROSTER
from benchmarks.controllers.spec import ControllerSpec
from benchmarks.lib.command import Seed, command, known, options
from benchmarks.lib.errors import UsageError
from benchmarks.lib.storage import file_name, out_folder, replacing
from benchmarks.loop.rollout import held
from benchmarks.loop.scenarios import SCENARIOS, PlantOptions, Scenario

REFERENCE = ROSTER["neural-smith"]  # the film compares errors with those of this controller
PICTURES = 60  # in a film, after the first
STYLE: Any = {
    "font.size": 15,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "text.parse_math": False,  # names of controllers may have a dollar
}


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
    names: list[str] = []
    factories: list[str] = []
    if "=" in options.agent:
        factories = [options.agent]
    else:
        names = agent_names("--agent", [options.agent])
    (controller,) = chosen(names, factories).values()
    name = f"{file_name(controller.name)}-{case.name}.gif"
    path = options.video or Path("results/watch", name)
    if path.suffix != ".gif":
        raise UsageError(f"--video: must end in .gif, got {path}")
    out_folder(path.absolute().parent, "--video")
    title = write_film(path, case, controller, options.seed)
    return f"On {case.title}:\n{title}\nThe film is {path}"


def equal_steps(setpoint: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Return start and stop sample of the two equal steps of a set point farthest apart.

    Steps are equal if they begin and end at the same levels and last equally long. If no step
    occurs twice, return start and stop of the whole run.
    """
    steps_by_shape: dict[Any, list[tuple[int, int]]] = {}
    previous_level = 0.0
    for start, stop in held(setpoint):
        shape = previous_level, setpoint[start], stop - start
        steps_by_shape.setdefault(shape, []).append((start, stop))
        previous_level = setpoint[start]

    def samples_apart(steps: list[tuple[int, int]]) -> int:
        first_start, _ = steps[0]
        last_start, _ = steps[-1]
        return last_start - first_start

    steps = max(steps_by_shape.values(), key=samples_apart)
    if len(steps) == 1:
        return [(0, len(setpoint))]
    return [steps[0], steps[-1]]


def write_film(path: Path, case: Scenario, controller: ControllerSpec, seed: int) -> str:
    """Write a film of equal steps of a run, and return its title.

    The first picture shows the complete steps. After it, they grow from picture to picture.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from PIL import Image

    reference_run = REFERENCE.members()[0].run(case.arguments, case.samples, 1, seed)
    run = controller.members()[0].run(case.arguments, case.samples, 1, seed)
    curves = [
        (reference_run, "#E69F00", REFERENCE.label),
        (run, "#0072B2", controller.label),
    ]
    steps = equal_steps(run.setpoint[:, 0])
    interval = case.parameters.sampling_interval / 60.0  # min
    minutes = np.arange(np.ptp(steps[0])) * interval
    lines: list[Any] = []
    ratios: list[str] = []
    pictures: list[Any] = []
    with rc_context(STYLE):
        figure = Figure((7.5, 5.0), dpi=100, layout="constrained")
        panels = figure.subplots(2, len(steps), sharex=True, sharey="row", squeeze=False)
        for (upper, lower), (start, stop) in zip(panels.T, steps, strict=True):
            step = slice(start, stop)
            error = np.abs(run.next_error[step]).mean()
            reference_error = np.abs(reference_run.next_error[step]).mean()
            ratios.append(f"{error / reference_error:.2f}")
            upper.set_title(f"from {interval * start:.0f} min on: {ratios[-1]}")
            upper.plot(minutes, run.setpoint[step], "--", color="0.3", label="set point")
            for trajectory, colour, name in curves:
                output = trajectory.output[step]
                lines += upper.plot(minutes, output, color=colour, lw=2, label=name)
                lines += lower.plot(minutes, trajectory.applied[step], color=colour, lw=2)
            lower.set_xlabel("min")
        panels[0, 0].set_ylabel("°C")
        panels[1, 0].set_ylabel("t/h")
        entries = panels[0, 0].get_legend_handles_labels()
        figure.legend(*entries, loc="outside lower center", ncols=3, frameon=False)
        title = f"{controller.label}: error {' and '.join(ratios)} times that of the "
        title += f"{REFERENCE.label} predictor on the same step"
        figure.suptitle(textwrap.fill(title, 62), x=0.01, ha="left", weight="bold", size=15)
        canvas: Any = FigureCanvasAgg(figure)
        complete_lines = [line.get_data() for line in lines]
        for number in (PICTURES, *range(1, PICTURES + 1)):
            samples = max(1, round(number / PICTURES * len(minutes)))
            for line, (x, y) in zip(lines, complete_lines, strict=True):
                line.set_data(x[:samples], y[:samples])
            canvas.draw()
            figure.set_layout_engine("none")  # as the first picture has been laid out
            pictures.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))
    # Few colours make the file small.
    palette = pictures[0].quantize(24)
    first, *following = (
        picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures
    )
    durations = [2500, *[100] * (PICTURES - 1), 1000]  # ms
    with replacing(path) as partial:
        first.save(partial, save_all=True, append_images=following, duration=durations, loop=0)
    return title


main = command("watch", Options, work)

if __name__ == "__main__":
    raise SystemExit(main(None))
