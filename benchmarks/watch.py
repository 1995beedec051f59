"""Make a film of a controller at work: `python -m benchmarks.watch --help`."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.controllers.options import agent_names, chosen
from benchmarks.lib.command import Seed, command, known, options
from benchmarks.lib.errors import UsageError
from benchmarks.lib.storage import file_name, out_folder
from benchmarks.loop.rollout import Trajectory, drawn_numbers, mean_error
from benchmarks.loop.scenarios import SCENARIOS, PlantOptions
from mptc_gym import Parameters
from mptc_gym.plant.parameters import PlantNumbers

if TYPE_CHECKING:
    from PIL.Image import Image

SAMPLES_PER_FRAME = 20  # samples of the run between two frames of the film
FRAME_DURATION = 100  # ms for which a frame is shown
LAST_FRAME_DURATION = 2000  # ms for which the last frame is shown, before the film repeats
COLOURS = 64  # number of colours in the film; few colours make the file small


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Make a film of a controller at work."""

    agent: str = "nn"
    """The controller: a name as in `compare`, or your own controller, NAME=MODULE:FACTORY."""
    scenario: str | None = None
    """The case to run, as in `compare`. The cases on a plant of your own are square and
    constant, or the single case run if the plant has a set point (default: the first case)."""
    plant: PlantOptions = field(default_factory=PlantOptions)
    seed: Seed = 0
    """The seed of all random numbers, such as noise and the controller's initial weights."""
    video: Path | None = None
    """The file of the film, which ends in .gif (default: a file in results/watch)."""


def work(options: Options) -> str:
    """Run a controller in a case, write a film of the run, and return two lines of text.

    The first line of the text has the mean error of the run, and the second line names the
    film's file. A `UsageError` is raised if `options` has an invalid value.
    """
    cases = options.plant.cases(SCENARIOS)
    case_name = options.scenario or next(iter(cases))
    known("--scenario", [case_name], cases)  # raises a UsageError for an unknown name
    case = cases[case_name]
    # `chosen` returns controllers by name, here a single one.
    if "=" in options.agent:  # the user's own controller
        (controller,) = chosen([], [options.agent]).values()
    else:
        (controller,) = chosen(agent_names("--agent", [options.agent])).values()
    default_path = Path("results/watch", f"{file_name(controller.name)}-{case.name}.gif")
    path = options.video or default_path
    if path.suffix != ".gif":
        raise UsageError(f"--video: the file must end in .gif, got {path}")
    out_folder(path.absolute().parent, "--video")
    # Of a controller with several trained networks, the film shows the first network.
    first_member = controller.members()[0]
    trajectory = first_member.run(case.arguments, case.samples, 1, options.seed)
    write_film(path, trajectory, case.parameters, options.seed)
    error = mean_error(trajectory)[0]
    return (
        f"On {case.title}, the mean error of {controller.label} is {error:.3f} °C.\n"
        f"The film is {path}"
    )


def write_film(path: Path, trajectory: Trajectory, parameters: Parameters, seed: int) -> None:
    """Write a film of the first run in `trajectory` to the GIF file `path`.

    An existing file `path` is replaced only when the new film is complete.
    """
    from PIL.Image import Dither, Quantize

    pictures = list(frames(trajectory, parameters, seed))
    # All pictures have the colours of the last picture, which shows nearly the whole run.
    palette = pictures[-1].quantize(COLOURS, Quantize.MAXCOVERAGE, kmeans=3)
    first, *rest = [
        picture.quantize(palette=palette, dither=Dither.NONE) for picture in pictures
    ]
    durations = [FRAME_DURATION] * len(rest) + [LAST_FRAME_DURATION]
    unfinished = path.with_name(f".{path.name}.unfinished")
    first.save(unfinished, "GIF", save_all=True, append_images=rest, duration=durations, loop=0)
    unfinished.replace(path)


def frames(trajectory: Trajectory, parameters: Parameters, seed: int) -> "Iterator[Image]":
    """Yield the frames of a film: pictures in the style of the environment's `render`.

    The film has a frame for every `SAMPLES_PER_FRAME` samples of the run. The time axis of each
    frame spans the whole run, while the environment draws only the latest samples.

    Parameters
    ----------
    trajectory
        Signals of a batch of runs; the film shows the first run.
    parameters
        Arguments of the environment.
    seed
        Seed of the first run, with which the environment drew the parameter values of the
        plant.
    """
    from PIL import Image

    from mptc_gym.environments.drawing import frame  # imported here, as the module needs pygame
    from mptc_gym.environments.record import Record

    drawn = drawn_numbers(parameters, 1, seed)
    numbers = {name: float(values[0]) for name, values in vars(drawn).items()}
    initial_setpoint = float(trajectory.setpoint[0, 0])
    record = Record(PlantNumbers(**numbers), parameters.sampling_interval, initial_setpoint)
    samples = len(trajectory.setpoint)
    record.span = samples
    record.samples = deque(record.samples)  # a deque without a maximum length
    next_outputs = trajectory.next_setpoint - trajectory.next_error
    for k in range(samples):
        record.add(
            setpoint=float(trajectory.next_setpoint[k, 0]),
            output=float(next_outputs[k, 0]),
            command=float(trajectory.command[k, 0]),
            applied=float(trajectory.applied[k, 0]),
        )
        # The set point often changes at the last sample of a run, where a frame would show a
        # large error. Hence each frame ends one sample earlier.
        if (record.k + 1) % SAMPLES_PER_FRAME == 0:
            yield Image.fromarray(frame(record))


main = command("watch", Options, work)

if __name__ == "__main__":
    raise SystemExit(main(None))
