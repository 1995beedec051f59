"""Compare controllers in the same noise: `python -m benchmarks.compare --help`."""

from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Annotated, Any

from benchmarks.controllers.options import AgentNames, ControllerOptions, chosen
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command import (
    CommandError,
    Count,
    Folder,
    Names,
    Parameter,
    Seed,
    command,
    known,
    options,
)
from benchmarks.lib.outputs import new_folder, provenance_of
from benchmarks.loop.scenarios import (
    PRESET_SCENARIOS,
    SCENARIOS,
    SETPOINTS,
    PlantOptions,
    Scenario,
)
from mptc_gym.evaluation import SEED

_SCENARIOS_HELP = (
    f"The cases to run (default: all). The cases are {', '.join(SCENARIOS)}. With "
    f"--presets, the cases are {', '.join(PRESET_SCENARIOS)}. With --plant, --preset or --set, "
    f"the cases are {', '.join(setpoint.name for setpoint in SETPOINTS)}."
)


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Run controllers on the same cases in the same noise, and write a report."""

    agents: AgentNames = tuple(name for name, spec in ROSTER.items() if spec.compared)
    controllers: ControllerOptions = field(default_factory=ControllerOptions)
    scenarios: Annotated[Names | None, Parameter(help=_SCENARIOS_HELP)] = None
    plant: PlantOptions = field(default_factory=PlantOptions)
    presets: bool = False
    """Run a case for each preset of the environment instead of the default cases."""
    runs: Count = 100
    """The number of runs of each controller in each case."""
    seed: Seed = SEED
    """The seed of the first run (default: the seed of the first published episode)."""
    out: Folder = None


def work(options: Options) -> None:
    """Compare controllers, write the results, and print the main tables.

    If a task fails or the user interrupts the comparison, the results of all finished tasks are
    written before an error is raised.
    """
    from benchmarks.compare.comparison import run_case, scale_of
    from benchmarks.compare.report import write

    controllers = chosen(options.agents, options.controllers.agent)
    folder_name, scenarios = cases(options)
    provenance = provenance_of(
        options={**asdict(options), "agents": list(controllers)},
        seeds=list(range(options.seed, options.seed + options.runs)),
        scenarios={scenario.name: vars(scenario) for scenario in scenarios},
    )
    folder = new_folder(options.out, folder_name, provenance)
    # Names of tasks are, for example, "bounds of square" and "mpc, square".
    bound_tasks: dict[str, Any] = {}
    run_tasks: dict[str, Any] = {}
    for scenario in scenarios:
        bound_task = partial(scale_of, scenario, options.runs, options.seed)
        bound_tasks[f"bounds of {scenario.name}"] = bound_task
    for name, controller in controllers.items():
        for scenario in scenarios:
            run_task = partial(run_case, scenario, controller, options.runs, options.seed)
            run_tasks[f"{name}, {scenario.name}"] = run_task
    tasks = bound_tasks | run_tasks
    # Long tasks start first, so that no core waits long at the end. The first argument of each
    # task is a scenario.
    names = sorted(tasks, key=lambda name: -tasks[name].args[0].samples)
    sorted_tasks = {name: tasks[name] for name in names}
    finished = options.controllers.fan_out.run(sorted_tasks, "compare")
    results = [finished.results[name] for name in run_tasks if name in finished.results]
    scales = [finished.results[name] for name in bound_tasks if name in finished.results]
    if results:
        write(results, scales, controllers, folder, provenance, finished.error)
        print(f"The report, tables, data and plots are in {folder}/")
    if finished.error:
        raise finished.error


def cases(options: Options) -> tuple[str, list[Scenario]]:
    """Return the name of the default output folder in `results/`, and the scenarios to run.

    A `CommandError` is raised if `options` has options that exclude each other, or the name of
    an unknown scenario.
    """
    if options.presets and options.plant.name:
        raise CommandError("--presets cannot be combined with --plant, --preset and --set")
    if options.presets:
        folder_name, available = "compare-presets", PRESET_SCENARIOS
    elif options.plant.name:
        folder_name, available = "compare-plant", dict(options.plant.cases(SCENARIOS))
    else:
        folder_name, available = "compare", SCENARIOS
    wanted = list(available) if options.scenarios is None else options.scenarios
    scenarios = [available[name] for name in known("--scenarios", wanted, available)]
    if not scenarios:
        raise CommandError("--scenarios: name at least one case")
    return folder_name, scenarios


main = command("compare", Options, work)

if __name__ == "__main__":
    raise SystemExit(main())
