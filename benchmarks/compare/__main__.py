"""Compare controllers in the same noise: `python -m benchmarks.compare --help`."""

import itertools
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Annotated, Any

from benchmarks.controllers.known_plant import KnownPlant
from benchmarks.controllers.own import check_own, own_controllers
from benchmarks.controllers.roster import ROSTER, ControllerSpec
from benchmarks.lib.command import (
    CommandError,
    Count,
    Folder,
    Names,
    Parameter,
    Seed,
    choose,
    command,
    options,
)
from benchmarks.lib.fan_out import FanOut
from benchmarks.lib.outputs import new_folder, provenance_of
from benchmarks.loop.linear import describe, unfit
from benchmarks.loop.scenarios import (
    PRESET_SCENARIOS,
    SCENARIOS,
    SETPOINTS,
    PlantOptions,
    Scenario,
)
from mptc_gym import Parameters
from mptc_gym.evaluation import SEED

_SCENARIOS_HELP = (
    f"The cases to run (default: all). The cases are {', '.join(SCENARIOS)}. With "
    f"--presets, the cases are {', '.join(PRESET_SCENARIOS)}. With --plant, --preset or --set, "
    f"the cases are {', '.join(setpoint.name for setpoint in SETPOINTS)}; or run, with the set "
    "point of the plant's arguments, if these have one."
)


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Run controllers on the same cases in the same noise, and write a report."""

    agents: Annotated[
        Names, Parameter(help=f"The controllers to run, from {', '.join(ROSTER)}.")
    ] = tuple(name for name, spec in ROSTER.items() if spec.compared)
    agent: Names = ()
    """A controller of your own, which runs in addition to those of --agents. Its form is
    NAME=MODULE:FACTORY; NAME=gains.json for a file of benchmarks.tune; or NAME=FILE.npz for a
    file of benchmarks.train. The same name again adds another training run of it."""
    scenarios: Annotated[Names, Parameter(help=_SCENARIOS_HELP)] = ()
    plant: PlantOptions = field(default_factory=PlantOptions)
    presets: bool = False
    """Run a case for each preset of the environment instead of the default cases."""
    runs: Count = 100
    """The number of runs of each controller in each case. The reference error is a mean
    over the same runs. If plants or set points are random, it takes about a second per run."""
    seed: Seed = SEED
    """The seed of the first run (default: the seed of the first published episode)."""
    fan_out: FanOut = field(default_factory=FanOut)
    out: Folder = None


def work(options: Options) -> None:
    """Compare controllers, write the results, and print a table and the path of the report.

    If the user has chosen a plant, a line that describes the plant is printed first. A user's
    own controllers are checked before the first task begins. If a task fails or the user
    interrupts the comparison, the results of the controllers that have finished are written
    before an error is raised.
    """
    from benchmarks.compare.cases import Result, reference_of, run_case
    from benchmarks.compare.report import write

    own = own_controllers(options.agent)
    chosen = choose("--agents", options.agents, ROSTER) | own
    controllers, note = fitting_the_gain(chosen, options.plant)
    folder_name, scenarios = cases(options)
    runs, seed = options.runs, options.seed
    # The roster makes its controllers for the plant of each scenario, so they fit.
    of_user = [controller for name, controller in controllers.items() if name in own]
    for controller, scenario in itertools.product(of_user, scenarios.values()):
        check_own(controller, scenario, runs, seed)
    provenance = provenance_of(
        options={**asdict(options), "agents": list(controllers)},
        seeds=list(range(seed, seed + runs)),
        scenarios={name: vars(scenario) for name, scenario in scenarios.items()},
    )
    folder = new_folder(options.out, folder_name, provenance)
    if options.plant.name:
        print(describe(Parameters(**options.plant.arguments())), flush=True)
    task_of_reference = {case: f"reference error of {case}" for case in scenarios}
    tasks: dict[str, Any] = {}
    for case, scenario in scenarios.items():
        tasks[task_of_reference[case]] = partial(reference_of, scenario, runs, seed)
    for name, controller in controllers.items():
        for case, scenario in scenarios.items():
            tasks[f"{name}, {case}"] = partial(run_case, scenario, controller, runs, seed)
    finished = options.fan_out.run(tasks, "compare")
    references = {
        case: finished.results[task]
        for case, task in task_of_reference.items()
        if task in finished.results
    }
    # The other results are the reference errors.
    results = [item for item in finished.results.values() if isinstance(item, Result)]
    if results:
        text = write(
            results,
            scenarios,
            references,
            controllers,
            folder,
            provenance,
            note,
            finished.error,
        )
        print(text)
    if finished.error:
        raise finished.error


def cases(options: Options) -> tuple[str, dict[str, Scenario]]:
    """Return the name of the default output folder in `results/`, and the scenarios by name.

    A `CommandError` is raised if `options` has options that exclude each other, the name of an
    unknown scenario, or a plant that is not for a scenario.
    """
    if options.presets and options.plant.name:
        raise CommandError("--presets cannot be combined with --plant, --preset and --set")
    if options.presets:
        folder_name, available = "compare-presets", PRESET_SCENARIOS
    elif options.plant.name:
        folder_name, available = "compare-plant", dict(options.plant.cases(SCENARIOS))
    else:
        folder_name, available = "compare", SCENARIOS
    names = options.scenarios or list(available)
    chosen = choose("--scenarios", names, available)
    for name, scenario in chosen.items():
        reason = unfit(scenario.parameters)
        if reason:
            raise CommandError(f"the case {name}: {reason}")
    return folder_name, chosen


def fitting_the_gain(
    controllers: Mapping[str, ControllerSpec], plant: PlantOptions
) -> tuple[dict[str, ControllerSpec], str]:
    """Return the controllers that fit the sign of the plant's gain, and a sentence on others.

    A `CommandError` is raised if no controller is left.
    """
    allowed = None, KnownPlant(plant.arguments()).direction  # None fits both signs
    fitting = {name: spec for name, spec in controllers.items() if spec.direction in allowed}
    labels = [spec.label for name, spec in controllers.items() if name not in fitting]
    note = ""
    if labels:
        note = f"Left out, because made for a gain of the other sign: {', '.join(labels)}."
    if not fitting:
        raise CommandError(f"--agents, --agent: name at least one controller. {note}")
    return fitting, note


main = command("compare", Options, work)

if __name__ == "__main__":
    raise SystemExit(main())
