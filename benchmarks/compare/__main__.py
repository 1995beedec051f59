"""Compare controllers in the same noise: `python -m benchmarks.compare --help`."""

import itertools
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from benchmarks.controllers.options import AgentNames, ControllerOptions, chosen
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command import (
    Folder,
    Names,
    Parameter,
    Runs,
    Seed,
    command,
    known,
    options,
)
from benchmarks.lib.errors import UsageError
from benchmarks.lib.provenance import origin
from benchmarks.lib.results import results_folder
from benchmarks.lib.storage import write_json
from benchmarks.loop.scenarios import (
    PRESET_SCENARIOS,
    SCENARIOS,
    SETPOINTS,
    PlantOptions,
    Scenario,
)
from mptc_gym.evaluation import SEED

_CASES = (
    f"Cases to run (default: all). Of the paper: {', '.join(SCENARIOS)}. With --presets: "
    f"{', '.join(PRESET_SCENARIOS)}. With --plant, --preset or --set: "
    f"{', '.join(setpoint.name for setpoint in SETPOINTS)}."
)

_OUT = "Folder (default: results/compare; compare-presets or compare-plant for other cases)."


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
    seed: Seed = SEED
    """Seed of the first run (default: that of the published episodes)."""
    out: Annotated[Folder | None, Parameter(help=_OUT)] = None


def work(options: Options) -> str:
    """Run the comparison and write its results, also after an error: of what has finished."""
    from benchmarks.compare.comparison import run_case, scale_of, write

    controllers = chosen(options.agents, options.controllers.agent)
    fan_out = options.controllers.fan_out
    name_of_cases, scenarios = cases(options)
    target, made = options.out or Path("results", name_of_cases), origin()
    runs, seed = options.runs, options.seed
    bounds = {
        f"bounds of {scenario.name}": partial(scale_of, scenario, runs, seed)
        for scenario in scenarios
    }
    cells = {
        f"{name}, {scenario.name}": partial(run_case, scenario, controller, runs, seed)
        for (name, controller), scenario in itertools.product(controllers.items(), scenarios)
    }
    # Short tasks last, so that no core waits long at the end.
    tasks = dict(sorted((bounds | cells).items(), key=lambda task: -task[1].args[0].samples))
    found: dict[str, Any] = {}
    with results_folder(target) as folder:
        try:
            found.update(fan_out.stream(tasks, "compare"))
        finally:
            if missing := len(tasks) - len(found):
                made["missing"] = f"{missing} of {len(tasks)} tasks are missing"
            if finished := [found[name] for name in cells if name in found]:
                provenance = made | {
                    "options": {**asdict(options), "agents": [*controllers]},
                    "seeds": [*range(seed, seed + runs)],
                    "scenarios": {scenario.name: vars(scenario) for scenario in scenarios},
                    "policies": {
                        case.agent: case.policies for case in finished if case.policies
                    },
                }
                write_json(folder / "provenance.json", provenance)
                scales = [found[name] for name in bounds if name in found]
                write(finished, scales, controllers, folder, made)
    return f"The report, tables, data and plots are in {target}/"


def cases(options: Options) -> tuple[str, list[Scenario]]:
    """Return the name of the cases that the options ask for, a folder's, and these cases."""
    if options.presets and options.plant.name:
        raise UsageError("--presets cannot be combined with --plant, --preset and --set")
    if options.presets:
        name, available = "compare-presets", PRESET_SCENARIOS
    elif options.plant.name:
        name, available = "compare-plant", dict(options.plant.cases(SCENARIOS))
    else:
        name, available = "compare", SCENARIOS
    wanted = [*available] if options.scenarios is None else options.scenarios
    scenarios = [available[wish] for wish in known("--scenarios", wanted, available)]
    if not scenarios:
        raise UsageError("--scenarios: none to run")
    return name, scenarios


main = command("compare", Options, work)

if __name__ == "__main__":
    raise SystemExit(main())
