"""Make a film of a controller at work: `python -m benchmarks.watch --help`."""

from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.controllers.options import agent_names, chosen
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command import Seed, command, known, options
from benchmarks.lib.errors import UsageError
from benchmarks.lib.storage import file_name, out_folder
from benchmarks.loop.scenarios import SCENARIOS, PlantOptions
from benchmarks.plots.film import make_film, write_film

REFERENCE = ROSTER["neural-smith"]  # the controller that others are compared with


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
    film = make_film(case, controller, REFERENCE, options.seed)
    write_film(path, film)
    return f"On {case.title}:\n{film.finding}.\nThe film is {path}"


main = command("watch", Options, work)

if __name__ == "__main__":
    raise SystemExit(main(None))
