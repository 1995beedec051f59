"""Run controllers on the plants of a sweep, as the options say, and write the results."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from benchmarks.bounds.least import least_possible
from benchmarks.controllers.options import chosen
from benchmarks.controllers.records import Factory, provenances
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command import blame, out_folder
from benchmarks.lib.report import provenance_line, show, write_report
from benchmarks.lib.storage import Kept, origin, write_json
from benchmarks.lib.tables import write_csv
from benchmarks.loop.designs import SPANS, WIDE, Arguments, around, grid, random_design
from benchmarks.loop.metrics import held, mean_error, measure, split
from benchmarks.loop.rollout import Trajectory
from benchmarks.sweep.__main__ import Options
from benchmarks.sweep.report import report, table
from mptc_gym import Parameters

SETPOINT: Arguments = {"setpoint": "square", "setpoint_period": 600}
SEED = 0  # of a plant's first run


def execute(options: Options, console: Console) -> str:
    """Run the sweep and write its results."""
    controllers = chosen(options.agents, options.controllers.agent)
    nominal = options.plant.chosen().arguments
    if options.design == "grid":
        differing = grid()
    else:
        spans = SPANS if options.design == "random" else WIDE
        differing = random_design(options.plants, options.design_seed, options.samples, spans)
    with blame("--plant, --preset, --set"):
        differing = around(nominal, differing)
    plants = [{**nominal, **plant} for plant in differing]
    for plant in plants:
        with blame(f"--design {options.design}"):
            Parameters(**plant)
    told = plants if options.told == "each" else [nominal] * len(plants)
    made = origin()
    out = out_folder(options.out or Path(f"results/sweep-{options.design}"))
    known = {"nothing": ROSTER["nothing"], **controllers}  # which sets the scale
    members = {name: entry.members() for name, entry in known.items()}
    began = time.perf_counter()

    tasks: dict[str, Callable[[], Any]] = {
        f"plant {i}": partial(limit_task, plant, options.samples)
        for i, plant in enumerate(plants)
    }
    for name, factories in members.items():
        # The plants take the members in turn, so that the maps show how much they differ.
        for i, given in enumerate(zip(cycle(factories), told, plants, strict=False)):
            tasks[f"plant {i}, {name}"] = partial(
                agent_task, *given, options.samples, options.runs
            )
    found = options.controllers.fan_out.run(tasks, "sweep", Kept(out / "tasks"))
    seconds = time.perf_counter() - began

    runs = table(differing, list(controllers), found)
    centre = Parameters(**nominal) if options.design == "grid" else None
    sections = report(runs, out, centre, options.told)
    write_csv(out / "runs.csv", runs)
    about = {"seconds": round(seconds, 1), "options": asdict(options)}
    write_json(out / "provenance.json", {**made, **about, "policies": provenances(members)})
    knowing = "are told" if options.told == "each" else "were not made for"
    title = f"Controllers on plants that they {knowing}"
    write_report(out, title, sections, provenance_line("sweep", made))
    show(sections, console)
    return f"{len(tasks)} tasks in {seconds:.0f} s. The report, data and maps are in {out}/"


def limit_task(plant: Arguments, samples: int) -> float | None:
    """Return the least mean |e| on a plant, degC; None if it does not settle between changes.

    This is the least possible error if each change of the set point finds the plant settled
    and is not foreseen; see `benchmarks.bounds`.
    """
    case = {**plant, **SETPOINT}
    try:
        return least_possible(samples=samples, kind="reference", folder=None, **case).value
    except ValueError:
        return None


def agent_task(
    factory: Factory, told: Arguments, plant: Arguments, samples: int, runs: int
) -> dict[str, list[float]]:
    """Run a controller that is made for the plant it is `told` on another plant.

    Run i has the noise and the initial weights of seed `SEED + i`.

    Returns
    -------
    dict of list
        For each run, all measures of `METRICS`; `late`, the mean |e| of its second half, degC;
        and `swing`.
    """
    controller = factory.in_service({**told, **SETPOINT}, runs, SEED)
    case = {**plant, **SETPOINT}
    trajectory = factory.run(case, samples, runs, SEED, controller)
    measures = {
        **measure(trajectory, Parameters(**case)),
        "late": mean_error(split(trajectory, samples // 2)[1]),
        "swing": swing(trajectory),
    }
    return {name: values.tolist() for name, values in measures.items()}


def swing(trajectory: Trajectory) -> NDArray[np.float64]:
    """Return the swing of the error while a set point is held, degC, shape (runs,).

    This is the root mean square of the standard deviations in the second half of each hold.
    """
    error = trajectory.setpoint - trajectory.output
    variances = [
        error[(start + stop) // 2 : stop].var(axis=0)
        for start, stop in held(trajectory.setpoint[:, 0])
    ]
    deviation: NDArray[np.float64] = np.sqrt(np.mean(variances, axis=0))
    return deviation
