"""Run controllers on plants they were not made for: `python -m benchmarks.sweep --help`."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray

from benchmarks.controllers.options import AgentNames, ControllerOptions, chosen
from benchmarks.controllers.roster import ROSTER, Controller, label
from benchmarks.lib.command import Folder, Parameter, Runs, Seed, blame, command, options
from benchmarks.lib.storage import Kept, UsageError, origin, out_folder, write_csv, write_json
from benchmarks.loop.rollout import Trajectory, held, measure
from benchmarks.loop.scenarios import Arguments, PlantOptions, around, random_design
from mptc_gym import Parameters

if TYPE_CHECKING:
    import pandas as pd

SAMPLES = 1200  # of a run
SETPOINT: Arguments = {"setpoint": "square", "setpoint_period": 600}
SEED = 0  # of a plant's first run, and of the bootstraps
OSCILLATES = 1.0  # degC by which the swing must exceed that without control
COLUMNS = {  # of the overview: headings and formats
    "multiple": ("multiple, median", "{:.3f}"),
    "multiple_p90": ("multiple, 90 %", "{:.3f}"),
    "travel": ("travel (t/h)", "{:,.0f}"),
    "oscillates": ("oscillates (%)", "{:.1f}"),
    "useless": ("no better than no control (%)", "{:.1f}"),
}
TEXT = (
    "Multiple: mean error / least possible error, the median and 90th percentile over the "
    "plants (the median run of each). Travel: of the valve in a run, the median. Oscillates: "
    f"on steady stretches the standard deviation of the error is {OSCILLATES:g} °C larger "
    "than without control. This, and no better than no control, are shares of the runs."
)
PICTURE = "Error on each plant, as a multiple of the least possible"
GROUPS = {  # of the plants of a random design, a row each
    "no drift": "gain_drift.isna()",
    "all that drift": "gain_drift > 0",
    "delay below 14 samples": "gain_drift > 0 and delay < 14",
    "delay from 14 to 22 samples": "gain_drift > 0 and 14 <= delay <= 22",
    "delay above 22 samples": "gain_drift > 0 and delay > 22",
}
QUESTIONS = {  # about pairs of controllers: does the first make the smaller error?
    "Does online learning help when the plant drifts?": (
        ("nn", "pi-simc"),
        ("nn", "nn-frozen"),
        ("nn-frozen", "pi-simc"),
    ),
    "What does adaptation buy?": (
        ("neural-self-tuning", "neural-smith"),
        ("neural-self-tuning", "self-tuning"),
        ("neural-smith", "smith"),
        ("self-tuning", "smith"),
    ),
}
DIFFERENCES = "Differences of the mean error (°C), 95 % interval; below 0 the first is better."


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Run controllers on plants that they were not made for.

    They were made for the paper's plant, or that of --plant, --preset or --set; the design says
    how the other plants differ from it.
    """

    design: Literal["grid", "random"] = "grid"
    """20 delays by 10 gains, or plants that differ in everything, half of which drift."""
    plants: Runs | None = None
    """Plants of a random design (default: 200)."""
    design_seed: Seed | None = None
    """Seed for the plants of a random design (default: 0)."""
    told: Literal["nominal", "each"] = "nominal"
    """nominal: every controller is made for the one plant above; each: for the plant that it
    controls, as it is before any drift."""
    runs: Runs = 20
    """Runs of a controller on a plant."""
    agents: AgentNames = tuple(name for name, each in ROSTER.items() if each.swept)
    controllers: ControllerOptions = field(default_factory=ControllerOptions)
    plant: PlantOptions = field(default_factory=PlantOptions)
    out: Annotated[Folder | None, Parameter(help="Default: results/sweep-DESIGN.")] = None


def work(options: Options) -> str:
    """Run the sweep and write its results, also after an error: of what has finished."""
    made_by = chosen(options.agents, options.controllers.agent)
    members = {name: each.members() for name, each in made_by.items()}
    nominal = options.plant.arguments()
    plants = design(options, nominal)
    made, out = origin(), out_folder(options.out or Path(f"results/sweep-{options.design}"))
    tasks: dict[str, Any] = {}
    for i, plant in enumerate(plants):
        case = {**nominal, **plant, **SETPOINT}
        tasks[f"plant {i}"] = partial(scale_of, case, options.runs)
        told = case if options.told == "each" else {**nominal, **SETPOINT}
        for name, of in members.items():
            # The plants take the members in turn, so that the maps show how much they differ.
            member = of[i % len(of)]
            tasks[f"plant {i}, {name}"] = partial(run_agent, member, told, case, options.runs)
    found: dict[str, Any] = {}
    try:
        # The code of a user's own may change without a new commit.
        kept = None if options.controllers.agent else Kept(out / "tasks")
        found.update(options.controllers.fan_out.stream(tasks, "sweep", kept))
    finally:
        runs = table(plants, list(members), found)
        if missing := len(tasks) - len(found):
            made["missing"] = f"{missing} of {len(tasks)} tasks are missing"
        if not runs.empty:
            write_json(out / "provenance.json", made | {"options": asdict(options)})
            write_csv(out / "runs.csv", runs)
            write_csv(out / "summary.csv", summarise(runs))
            report(runs, out, Parameters(**nominal), made)
    return f"The report, the data and a map are in {out}/"


def design(options: Options, nominal: Arguments) -> list[Arguments]:
    """Return the arguments in which the plants of the design differ from the nominal one."""
    gains = np.linspace(0.75, 1.65, 10).round(6).tolist()
    plants = [{"delay": at, "gain_factor": gain} for gain in gains for at in range(2, 42, 2)]
    if options.design == "random":
        plants = random_design(options.plants or 200, options.design_seed or 0, SAMPLES)
    elif options.plants or options.design_seed is not None:
        raise UsageError("--plants and --design-seed are for --design random")
    with blame(f"--design {options.design}"):
        plants = around(nominal, plants)
        for plant in plants:
            Parameters(**{**nominal, **plant})
    return plants


def run_agent(
    controller: Controller, told: Arguments, case: Arguments, runs: int
) -> dict[str, Any]:
    """Run a controller that is made for the plant it is `told` on another one; measure it."""
    agent = controller.in_service(told, runs, SEED)
    trajectory = controller.run(case, SAMPLES, runs, SEED, agent)
    measures = measure(trajectory, Parameters(**case))
    return {"run": np.arange(runs), **measures, "swing": swing(trajectory)}


def scale_of(case: Arguments, runs: int) -> dict[str, Any]:
    """Run no control on a plant; add the reference (`limit`), NaN if it does not settle."""
    from benchmarks.bounds.least import least_possible

    found = {**run_agent(ROSTER["nothing"], case, case, runs), "limit": math.nan}
    with suppress(ValueError):
        found["limit"] = least_possible(samples=SAMPLES, kind="reference", **case).value
    return found


def swing(trajectory: Trajectory) -> NDArray[np.float64]:
    """Return the rms of the error's deviations in the second half of each hold, (runs,)."""
    error = trajectory.setpoint - trajectory.output
    holds = held(trajectory.setpoint[:, 0])
    variances = [error[(start + stop) // 2 : stop].var(axis=0) for start, stop in holds]
    return np.asarray(np.sqrt(np.mean(variances, axis=0)))


def table(
    plants: Sequence[Arguments], agents: Sequence[str], found: Mapping[str, Any]
) -> pd.DataFrame:
    """Return one row for each run that there is: its plant, its measures, its comparisons."""
    import pandas as pd

    rows = [pd.DataFrame()]
    for (i, plant), agent in itertools.product(enumerate(plants), agents):
        idle, of = found.get(f"plant {i}"), found.get(f"plant {i}, {agent}")
        if idle and of:
            compared = {  # with no control in the same noise
                "limit": idle["limit"],
                "ratio": of["mae"] / idle["limit"],
                "oscillates": of["swing"] > idle["swing"] + OSCILLATES,
                "useless": of["mae"] >= idle["mae"],
            }
            rows.append(pd.DataFrame({"plant": i, "agent": agent, **of, **compared, **plant}))
    return pd.concat(rows, ignore_index=True)


def summarise(runs: pd.DataFrame) -> pd.DataFrame:
    """Return one row of numbers for each controller; see `TEXT`."""
    of = runs.groupby("agent", sort=False)
    found = 100.0 * of[["oscillates", "useless"]].mean()
    found.insert(0, "travel", of["total_variation"].median())
    ratios = runs.groupby(["agent", "plant"], sort=False)["ratio"].median().groupby("agent")
    found.insert(0, "multiple_p90", ratios.quantile(0.9))
    found.insert(0, "multiple", ratios.median())
    return found.reset_index()


def report(runs: pd.DataFrame, out: Path, nominal: Parameters, made: Arguments) -> None:
    """Draw the map, write the report and print it; of plants that drift, with `QUESTIONS`."""
    from benchmarks.lib.report import Section, write_report

    draw(runs, out / "map.png", nominal)
    overview = summarise(runs)
    overview.insert(0, "controller", overview.pop("agent").map(label))
    for name, (heading, form) in COLUMNS.items():
        overview[heading] = overview.pop(name).map(form.format)
    sections = [Section("Errors on other plants", [TEXT], overview, {"map.png": PICTURE})]
    for title, pairs in QUESTIONS.items():
        asked = [pair for pair in pairs if set(pair) <= set(runs["agent"])]
        if asked and "gain_drift" in runs and len(compared := differences(runs, asked)):
            sections.append(Section(title, [DIFFERENCES], compared))
    write_report(out, "Controllers on other plants", sections, "sweep", made)


def differences(runs: pd.DataFrame, pairs: Sequence[tuple[str, str]]) -> pd.DataFrame:
    """Return a row for each group of two plants and more on which none failed."""
    import pandas as pd

    from benchmarks.lib.statistics import bootstrap

    agents = list({agent for pair in pairs for agent in pair})
    errors = runs.pivot(index="plant", columns=["agent", "run"], values="mae")[agents].dropna()
    plants = runs.drop_duplicates("plant").set_index("plant").loc[errors.index]
    rows = []
    for name, which in GROUPS.items():
        of = errors.loc[plants.query(which).index]
        if len(of) > 1:
            rows.append({"plants": name, "number": str(len(of))})
            for ours, theirs in pairs:
                difference = bootstrap((of[ours] - of[theirs]).to_numpy(), seed=SEED)
                rows[-1][f"{label(ours)} - {label(theirs)}"] = f"{difference:+.3f}"
    return pd.DataFrame(rows)


def draw(runs: pd.DataFrame, path: Path, nominal: Parameters) -> None:
    """Draw each controller's errors over delay and gain, the median of each plant."""
    from matplotlib.colors import LogNorm

    from benchmarks.lib.report import MULTIPLE, panels, scale_by_excess

    centre = [sum(nominal.range_of(name)) / 2.0 for name in ("delay", "gain_factor")]
    look: Any = {"marker": "s", "cmap": "cividis_r", "norm": LogNorm(0.01, 3.0)}
    names = list(runs["agent"].unique())
    with panels(path, [*map(label, names)], 2.3, 3, PICTURE) as (figure, axes):
        for panel, name in zip(axes, names, strict=True):
            plants = runs[runs["agent"] == name].groupby("plant")
            delay, gain = plants["delay"].first(), plants["gain_factor"].first()
            excess = plants["ratio"].median().sub(1.0).clip(lower=0.01)
            image = panel.scatter(delay, gain, 20, excess, **look)
            often = plants["oscillates"].mean() >= 0.5
            panel.plot(delay[often], gain[often], "wo", ms=3.5, mec="k", label="oscillates")
            often = plants["useless"].mean() >= 0.5
            panel.plot(delay[often], gain[often], "rX", label="no better than no control")
            panel.plot(*centre, "k+", ms=12, label="the nominal plant")
        for panel in axes[-3:]:
            panel.set_xlabel("delay (samples)")
        figure.supylabel("gain factor", fontsize="medium")
        below: Any = {"location": "bottom", "aspect": 60, "extend": "both"}
        bar = figure.colorbar(image, ax=axes, label=MULTIPLE, **below)
        scale_by_excess(bar.ax, "x", 0.013, 3.0 / 1.3)
        figure.legend(*panel.get_legend_handles_labels(), loc="outside lower center", ncols=4)


main = command("sweep", Options, work)

if __name__ == "__main__":
    raise SystemExit(main(None))
