"""Compare controllers in the same noise: `python -m benchmarks.compare --help`."""

import itertools
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from benchmarks.controllers.options import AgentNames, ControllerOptions, chosen
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command import Folder, Names, Parameter, Runs, command, known, options
from benchmarks.lib.storage import UsageError, origin, out_folder, write_json
from benchmarks.loop.scenarios import PRESET_SCENARIOS, SCENARIOS, SETPOINTS, PlantOptions
from mptc_gym.evaluation import SEED

_CASES = (
    f"Cases to run (default: all). Of the paper: {', '.join(SCENARIOS)}. With --presets: "
    f"{', '.join(PRESET_SCENARIOS)}. With --plant, --preset or --set: "
    f"{', '.join(setpoint.name for setpoint in SETPOINTS)}."
)

_OUT = "Folder (default: results/compare, -presets with these, -other with other options)."


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Run controllers on the same cases in the same noise, and write a report."""

    agents: AgentNames = tuple(name for name, each in ROSTER.items() if each.compared)
    controllers: ControllerOptions = field(default_factory=ControllerOptions)
    scenarios: Annotated[Names | None, Parameter(help=_CASES)] = None
    plant: PlantOptions = field(default_factory=PlantOptions)
    presets: bool = False
    """Run the environment's presets instead of the paper's cases."""
    runs: Runs = 100
    """Runs of each controller in each case."""
    out: Annotated[Folder | None, Parameter(help=_OUT)] = None


def work(options: Options) -> str:
    """Run the comparison and write its results, also after an error: of what has finished."""
    from benchmarks.compare.comparison import run_case, scale_of, write

    controllers = chosen(options.agents, options.controllers.agent)
    fan_out = options.controllers.fan_out
    there = options.plant.cases(PRESET_SCENARIOS if options.presets else SCENARIOS)
    if options.presets and options.plant.name:
        raise UsageError("--presets cannot be combined with --plant, --preset and --set")
    names = [*there] if options.scenarios is None else options.scenarios
    scenarios = [there[name] for name in known("--scenarios", names, there)]
    if not scenarios:
        raise UsageError("--scenarios: none to run")
    place = "compare-presets" if options.presets else "compare"
    if options != Options(
        presets=options.presets, controllers=ControllerOptions(fan_out=fan_out)
    ):
        place = "compare-other"
    folder, made = out_folder(options.out or Path("results", place)), origin()
    runs = options.runs
    bounds = {f"bounds of {each.name}": partial(scale_of, each, runs) for each in scenarios}
    cells = {
        f"{name}, {each.name}": partial(run_case, each, controller, runs)
        for (name, controller), each in itertools.product(controllers.items(), scenarios)
    }
    # Short tasks last, so that no core waits long at the end.
    tasks = dict(sorted((bounds | cells).items(), key=lambda each: -each[1].args[0].samples))
    found: dict[str, Any] = {}
    try:
        found.update(fan_out.stream(tasks, "compare"))
    finally:
        if missing := len(tasks) - len(found):
            made["missing"] = f"{missing} of {len(tasks)} tasks are missing"
        if finished := [found[name] for name in cells if name in found]:
            about = made | {
                "options": {**asdict(options), "agents": [*controllers]},
                "seeds": [*range(SEED, SEED + runs)],
                "scenarios": {each.name: vars(each) for each in scenarios},
                "policies": {each.agent: each.policies for each in finished if each.policies},
            }
            write_json(folder / "provenance.json", about)
            scales = [found[name] for name in bounds if name in found]
            write(finished, scales, controllers, folder, made)
    return f"The report, tables, data and plots are in {folder}/"


main = command("compare", Options, work)

if __name__ == "__main__":
    raise SystemExit(main())
