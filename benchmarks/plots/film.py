"""Make a film of a controller and a reference controller on equal steps of the set point."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.controllers.roster import looks
from benchmarks.controllers.spec import ControllerSpec
from benchmarks.lib.pictures import DEAD_ZONE, LIMIT, SETPOINT, STYLE, percent
from benchmarks.lib.storage import replacing
from benchmarks.loop.rollout import Trajectory, drawn_numbers, held
from benchmarks.loop.scenarios import Scenario

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from PIL.Image import Image

PICTURES = 60  # of a film, after the first
FIRST_DURATION = 2500  # ms for which the first picture is shown
DURATION = 100  # ms for each picture after it
LAST_DURATION = 1000  # ms
COLOURS = 32  # in the file; few make it small
LEARNT = 0.02  # decrease of the error ratio from which a controller is said to improve
TITLE_CHARACTERS = 70  # that fit on a line of a title
FILM_STYLE: Any = STYLE | {"figure.dpi": 100, "font.size": 12, "axes.titlesize": 12}


class Step(NamedTuple):
    """The samples from a change of the set point to the next one: `start` to `stop - 1`."""

    start: int
    stop: int


@dataclass(frozen=True)
class FilmedRun:
    """A run of a controller."""

    controller: ControllerSpec
    signals: Trajectory  # of one run

    @property
    def colour(self) -> str:
        """Colour of the controller in all pictures."""
        name = self.controller.name
        return looks([name])[name][0]

    def mean_error(self, step: Step) -> float:
        """Return the mean of |e| on a step, degC."""
        errors = self.signals.next_error[step.start : step.stop]
        return float(np.abs(errors).mean())


@dataclass(frozen=True)
class Film:
    """What a film shows: a run and the reference's in the same noise, on equal steps."""

    scenario: Scenario
    run: FilmedRun
    reference: FilmedRun
    steps: Sequence[Step]
    dead_zone: float  # t/h
    limits: tuple[float, float]  # of the flow, t/h

    @property
    def interval(self) -> float:
        """Sampling interval, minutes."""
        return self.scenario.parameters.sampling_interval / 60.0

    def ratio(self, step: Step) -> float:
        """Return the mean error on a step, divided by that of the reference."""
        return self.run.mean_error(step) / self.reference.mean_error(step)

    def compared(self, step: Step) -> str:
        """Return how the error differs from the reference's on a step.

        Where the film has several steps, the text says when this one begins.
        """
        difference = self.ratio(step) - 1.0
        size = percent(abs(difference))
        kind = "larger" if difference > 0.0 else "smaller"
        text = "equal" if size == percent(0.0) else f"{size} {kind}"
        if len(self.steps) == 1:
            return text
        return f"{text} at {self.interval * step.start:.0f} min"

    @property
    def finding(self) -> str:
        """A sentence that compares the errors of the two controllers."""
        name = self.run.controller.label
        reference = self.reference.controller.label
        if name == reference:
            return f"{name} on the case: {self.scenario.title}"
        differences = " and ".join(self.compared(step) for step in self.steps)
        gain = self.ratio(self.steps[0]) - self.ratio(self.steps[-1])
        if self.run.controller.learns and gain >= LEARNT:
            return (
                f"{name} improves with practice: compared with {reference}, its error is "
                f"{differences}"
            )
        return f"Compared with {reference}, the error of {name} is {differences}"


def make_film(
    scenario: Scenario, controller: ControllerSpec, reference: ControllerSpec, seed: int
) -> Film:
    """Run two controllers on a case, with one seed, and choose the steps to show."""
    runs = []
    for filmed in (controller, reference):
        first_member = filmed.members()[0]
        signals = first_member.run(scenario.arguments, scenario.samples, 1, seed)
        runs.append(FilmedRun(filmed, signals))
    plant = drawn_numbers(scenario.parameters, 1, seed)
    return Film(
        scenario,
        run=runs[0],
        reference=runs[1],
        steps=equal_steps(runs[0].signals.setpoint[:, 0]),
        dead_zone=float(plant.dead_zone[0]),
        limits=(float(plant.u_min[0]), float(plant.u_max[0])),
    )


def equal_steps(setpoint: NDArray[np.float64]) -> list[Step]:
    """Return the two equal steps that are farthest apart, or else the run as one step.

    Steps are equal if they lead from the same set point to the same other one, and are held
    for the same time. `setpoint` has the shape (samples,), degC.
    """
    steps_of: dict[tuple[float, float, int], list[Step]] = {}
    previous = 0.0
    for start, stop in held(setpoint):
        level = float(setpoint[start])
        steps_of.setdefault((previous, level, stop - start), []).append(Step(start, stop))
        previous = level
    steps = max(steps_of.values(), key=lambda equal: equal[-1].start - equal[0].start)
    if len(steps) == 1:
        return [Step(0, len(setpoint))]
    return [steps[0], steps[-1]]


def write_film(path: Path, film: Film) -> None:
    """Write a film as a GIF file.

    The first picture shows the steps as a whole. After it, the runs go on from sample to
    sample.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    from PIL import Image

    with rc_context(FILM_STYLE):
        figure = Figure((7.5, 5.2))
        curves = _draw(figure, film)
        first, *others = _pictures(figure, curves)
    palette = first.quantize(COLOURS, Image.Quantize.MAXCOVERAGE, kmeans=3)
    frames = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in others]
    durations = [FIRST_DURATION] + [DURATION] * (len(frames) - 1) + [LAST_DURATION]
    with replacing(path) as partial_file:
        palette.save(
            partial_file, save_all=True, append_images=frames, duration=durations, loop=0
        )


@dataclass(frozen=True)
class Curve:
    """A line that grows in the course of a film."""

    line: Line2D
    minutes: NDArray[np.float64]
    values: NDArray[np.float64]

    def show(self, share: float) -> None:
        """Draw the first part of the curve, a share of 1 for all."""
        count = max(1, round(share * len(self.minutes)))
        self.line.set_data(self.minutes[:count], self.values[:count])


def _draw(figure: Figure, film: Film) -> list[Curve]:
    """Draw all but the curves of the runs, which are returned; a column for each step."""
    sentence = textwrap.fill(film.finding, TITLE_CHARACTERS)
    figure.suptitle(sentence, x=0.015, ha="left", weight="bold", size=13)
    grid = figure.subplots(2, len(film.steps), sharex=True, sharey="row", squeeze=False)
    curves = []
    for (upper, lower), step in zip(grid.T, film.steps, strict=True):
        curves += _draw_step(upper, lower, film, step)
    grid[0, 0].set_ylabel("temperature (°C)")
    grid[1, 0].set_ylabel("applied flow (t/h)")
    for axes in grid[1]:
        axes.set_xlabel("time since the step (min)")
    entries: dict[str, Any] = {}
    for axes in grid[:, 0]:
        handles, texts = axes.get_legend_handles_labels()
        entries |= dict(zip(texts, handles, strict=True))
    handles = list(entries.values())
    figure.legend(handles, list(entries), loc="outside lower center", ncols=len(entries))
    return curves


def _draw_step(upper: Axes, lower: Axes, film: Film, step: Step) -> list[Curve]:
    """Draw a step, temperatures above and flows below, and return the curves of the runs."""
    samples = slice(step.start, step.stop)
    minutes = film.interval * np.arange(step.stop - step.start, dtype=np.float64)
    upper.set_title(f"error {film.compared(step)}")
    upper.plot(minutes, film.run.signals.setpoint[samples, 0], label="set point", **SETPOINT)
    lower.axhspan(-film.dead_zone, film.dead_zone, label="dead zone", **DEAD_ZONE)
    for limit in film.limits:
        lower.axhline(limit, **LIMIT)
    curves = []
    for run in (film.reference, film.run):
        look: Any = {"color": run.colour, "linewidth": 2.0}
        temperatures = run.signals.output[samples, 0]
        flows = run.signals.applied[samples, 0]
        (temperature,) = upper.plot(minutes, temperatures, label=run.controller.label, **look)
        (flow,) = lower.step(minutes, flows, where="post", **look)
        curves.append(Curve(temperature, minutes, temperatures))
        curves.append(Curve(flow, minutes, flows))
    return curves


def _pictures(figure: Figure, curves: Sequence[Curve]) -> Iterator[Image]:
    """Yield the whole picture first, and then `PICTURES` in which the curves grow."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    canvas: Any = FigureCanvasAgg(figure)
    for count in (PICTURES, *range(1, PICTURES + 1)):
        for curve in curves:
            curve.show(count / PICTURES)
        canvas.draw()
        figure.set_layout_engine("none")  # The layout of the first picture stays.
        yield Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
