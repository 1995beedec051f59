"""Make a film of a controller at work: `python -m benchmarks.watch --help`."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cyclopts import Parameter
from numpy.typing import NDArray

from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command import Seed, command, known, options
from benchmarks.lib.storage import UsageError, out_folder, replacing
from benchmarks.loop.rollout import Trajectory, held
from benchmarks.loop.scenarios import SCENARIOS, SETPOINTS, PlantOptions

REFERENCE = ROSTER["nn-smith"]  # whose errors those of the film are multiples of
PICTURES = 60  # of a film
SIZE = 7.5, 5.0  # inches, of 100 pixels
SHADES = 24  # colours
_AGENTS = (
    f"Who controls: {', '.join(ROSTER)}, or a controller of your own, NAME=MODULE:FACTORY or "
    "NAME=PPO:FILE.zip."
)
_CASES = (
    f"Case to run: {', '.join(SCENARIOS)}; on a plant of your own "
    f"{', '.join(name for name, *_ in SETPOINTS)}, or run if it has a set point of its own."
)


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Make a film of a controller at work."""

    agent: Annotated[str, Parameter(help=_AGENTS)] = "nn"
    scenario: Annotated[str, Parameter(help=_CASES)] = "square"
    plant: PlantOptions = field(default_factory=PlantOptions)
    seed: Seed = 0
    """Seed of noise and initial weights."""
    video: Path | None = None
    """The film, a .gif file (default: in results/watch)."""


def work(options: Options) -> str:
    """Run a controller on a case and write a film of it."""
    from benchmarks.controllers.options import own_entry

    cases = options.plant.cases(SCENARIOS)
    case = cases[known("--scenario", [options.scenario], cases)[0]]
    name, equals, location = options.agent.partition("=")
    if ":" in options.agent:
        controller = own_entry(name, [location if equals else name])
    else:
        controller = ROSTER[known("--agent", [options.agent], ROSTER)[0]]
    path = options.video or Path("results/watch", f"{name.replace(':', '.')}-{case.name}.gif")
    if path.suffix != ".gif":
        raise UsageError(f"--video: must end in .gif, got {path}")
    out_folder(path.absolute().parent, "--video")
    run, reference = (
        each.members()[0].run(case.arguments, case.samples, 1, options.seed)
        for each in (controller, REFERENCE)
    )
    write_film(path, controller.label, case.parameters.sampling_interval, run, reference)
    error = f"mean absolute error {np.abs(run.next_error).mean():.3f} °C"
    return f"{controller.label} on {case.title}: {error}\nThe film is {path}"


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
) -> None:
    """Write a film of the first and the last of equal steps of a run, side by side.

    Errors are multiples of the reference's on the same step; samples are `interval` seconds
    apart. The first picture shows all. Then the run goes on from sample to sample.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from PIL import Image

    steps = equal_steps(run.setpoint[:, 0])
    minutes = np.arange(steps[0][1] - steps[0][0]) * interval / 60.0
    multiples, lines = [], []
    with rc_context({"font.size": 15, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(SIZE, dpi=100, layout="constrained")
        panels = figure.subplots(2, len(steps), sharex=True, sharey="row", squeeze=False)
        for column, (start, stop) in zip(panels.T, steps, strict=True):
            ours, theirs, setpoint = (
                values[start:stop, 0]
                for values in (run.next_error, reference.next_error, run.setpoint)
            )
            multiples.append(np.abs(ours).mean() / np.abs(theirs).mean())
            column[0].set_title(f"from {start * interval / 60:.0f} min on: {multiples[-1]:.2f}")
            column[0].plot(minutes, setpoint, "--", color="0.3", label="set point")
            for panel, name in zip(column, ("output", "applied"), strict=True):
                for each, colour, who in (
                    (reference, "#E69F00", REFERENCE.label),
                    (run, "#0072B2", label),
                ):
                    values = getattr(each, name)[start:stop, 0]
                    lines += panel.plot(minutes, values, color=colour, lw=2, label=who)
            column[1].set_xlabel("min")
        panels[0, 0].set_ylabel("°C")
        panels[1, 0].set_ylabel("t/h")
        handles, names = panels[0, 0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside lower center", ncols=3, frameon=False)
        change = " and ".join(f"{multiple:.2f}" for multiple in multiples)
        title = f"{label}: error {change} times that of the {REFERENCE.label} predictor"
        title += " on the same step"
        figure.suptitle(textwrap.fill(title, 62), x=0.01, ha="left", weight="bold", size=15)
        canvas: Any = FigureCanvasAgg(figure)
        drawn = [line.get_data() for line in lines]
        pictures = []
        for share in (1.0, *np.arange(1, PICTURES + 1) / PICTURES):
            for line, (x, y) in zip(lines, drawn, strict=True):
                shown = max(1, round(share * len(x)))
                line.set_data(x[:shown], y[:shown])
            canvas.draw()
            figure.set_layout_engine("none")  # done once, by the first picture
            pictures.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))
    palette = pictures[0].quantize(SHADES)
    first, *others = (
        each.quantize(palette=palette, dither=Image.Dither.NONE) for each in pictures
    )
    durations = [2500, *[100] * (PICTURES - 1), 1000]  # ms
    with replacing(path) as partial:
        first.save(partial, save_all=True, append_images=others, duration=durations, loop=0)


main = command("watch", Options, work, interrupted="nothing is kept.")

if __name__ == "__main__":
    raise SystemExit(main(None))
