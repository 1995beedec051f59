"""Run controllers on plants they were not made for: `python -m benchmarks.sweep --help`."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from benchmarks.controllers.options import AgentNames, ControllerOptions, chosen
from benchmarks.controllers.roster import ROSTER, label
from benchmarks.lib.command import Runs, Seed, blame, command, options
from benchmarks.lib.storage import Kept, UsageError, origin, out_folder, write_csv, write_json
from benchmarks.loop.rollout import Trajectory
from benchmarks.loop.scenarios import PlantOptions
from mptc_gym import Parameters

if TYPE_CHECKING:
    import pandas as pd

    from benchmarks.lib.report import Section

Arguments = dict[str, Any]  # of the environment

SWEPT = tuple(name for name, controller in ROSTER.items() if controller.swept)
SETPOINT: Arguments = {"setpoint": "square", "setpoint_period": 600}
SEED = 0  # of a plant's first run, and of the bootstraps
OSCILLATES = 1.0  # degC by which the swing must exceed that without control
GROUPS = (  # groups of drifting plants, by half-open intervals; each has a row of its own
    ("gain falls to less than 0.8 times", "gain_drift", 0.0, 0.8),
    ("gain stays within 0.8 to 1.25 times", "gain_drift", 0.8, 1.25),
    ("gain rises to more than 1.25 times", "gain_drift", 1.25, np.inf),
    ("delay below 14 samples", "delay", 0, 14),
    ("delay from 14 to 22 samples", "delay", 14, 23),
    ("delay above 22 samples", "delay", 23, np.inf),
)
MEASURES = {"mae": "over a whole run", "late": "over the second half of a run"}
# Questions about pairs of controllers: does the first make the smaller error?
QUESTIONS = (
    (
        "Does online learning help when the plant drifts?",
        "All were made for the nominal plant: the networks learnt on it, the PI is tuned by "
        "rule from its step test.",
        (("nn", "pi-simc"), ("nn", "nn-frozen"), ("nn-frozen", "pi-simc")),
    ),
    (
        "What does adaptation buy?",
        "The self-tuning controllers identify the plant while they control it. The Smith "
        "predictor and the network behind a model know the nominal plant.",
        (
            ("nn-self-tuning", "nn-smith"),
            ("nn-self-tuning", "self-tuning"),
            ("nn-smith", "smith"),
            ("self-tuning", "smith"),
        ),
    ),
)
OVERVIEW_TEXT = (
    "Multiple: mean error / least possible error, the median and 90th percentile over the "
    "plants (the median run of each). Travel: of the valve in a run, the median. "
    "Oscillates: on steady stretches the standard deviation of the error is "
    f"{OSCILLATES:g} °C larger than without control. This, and no better than no control, are "
    "shares of the runs."
)
DIFFERENCES_TEXT = (
    "Differences of the mean error (°C), run by run in the same noise, with 95 % intervals "
    "over plants and runs: below 0 the first of the two is better. At the end: the share "
    "of runs in which it is."
)

COLUMNS = {  # of the overview: headings and formats
    "agent": ("controller", "{}"),
    "multiple": ("multiple, median", "{:.3f}"),
    "multiple_p90": ("multiple, 90 %", "{:.3f}"),
    "travel": ("travel (t/h)", "{:,.0f}"),
    "oscillates": ("oscillates (%)", "{:.1f}"),
    "useless": ("no better than no control (%)", "{:.1f}"),
}
# Plants on which this happens in half the runs or more: column, size and look of the mark.
MARKS: tuple[tuple[str, int, Any], ...] = (
    ("oscillates", 12, {"color": "white", "edgecolor": "black", "label": "oscillates"}),
    ("useless", 64, {"marker": "X", "color": "red", "label": "no better than no control"}),
)


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Run controllers on plants that they were not made for.

    They were made for the paper's plant, or that of --plant, --preset or --set; the design says
    how the other plants differ from it.
    """

    design: Literal["grid", "random"] = "grid"
    """grid: 20 delays by 10 gains; random: plants that differ in everything, half of which
    drift."""
    plants: Runs | None = None
    """Plants of a random design (default: 200)."""
    design_seed: Seed | None = None
    """Seed for the plants of a random design (default: 0)."""
    told: Literal["nominal", "each"] = "nominal"
    """nominal: every controller is made for the one plant above; each: for the plant that it
    controls, as it is before any drift."""
    runs: Runs = 20
    """Runs of a controller on a plant."""
    samples: Runs = 1200
    """Samples of 8 s in a run."""
    agents: AgentNames = SWEPT
    controllers: ControllerOptions = field(default_factory=ControllerOptions)
    plant: PlantOptions = field(default_factory=PlantOptions)
    out: Path | None = None
    """Folder to write to (default: results/sweep-DESIGN)."""


def work(options: Options) -> str:
    """Run the sweep and write its results, also after an error: of what has finished."""
    from benchmarks.lib.report import provenance_line, show, write_report

    controllers = chosen(options.agents, options.controllers.agent)
    nominal = options.plant.arguments()
    plants = _plants(options, nominal)
    told = [{**nominal, **each} if options.told == "each" else nominal for each in plants]
    made, began = origin(), time.perf_counter()
    out = out_folder(options.out or Path(f"results/sweep-{options.design}"))
    known = {"nothing": ROSTER["nothing"], **controllers}  # which sets the scale
    members = {name: each.members() for name, each in known.items()}
    tasks: dict[str, Any] = {}
    for i, plant in enumerate(plants):
        case = {**nominal, **plant, **SETPOINT}
        tasks[f"plant {i}"] = partial(least_error, case, options.samples)
        for name, factories in members.items():
            # The plants take the members in turn, so that the maps show how much they differ.
            given = factories[i % len(factories)], told[i], case, options.samples, options.runs
            tasks[f"plant {i}, {name}"] = partial(run_agent, *given)
    found: dict[str, Any] = {}
    try:
        found.update(options.controllers.fan_out.stream(tasks, "sweep", Kept(out / "tasks")))
    finally:
        runs, seconds = table(plants, list(controllers), found), time.perf_counter() - began
        if not runs.empty:
            write_csv(out / "runs.csv", runs)
            write_csv(out / "summary.csv", summarise(runs))
            origins = {
                name: [dict(each.provenance) for each in of] for name, of in members.items()
            }
            about = {"seconds": round(seconds), "options": asdict(options), "policies": origins}
            write_json(out / "provenance.json", {**made, **about})
            sections = report(runs, out, options, Parameters(**nominal))
            knowing = "know" if options.told == "each" else "were not made for"
            title = f"Controllers on plants that they {knowing}"
            write_report(out, title, sections, provenance_line("sweep", made))
            show(sections)
    return f"{len(tasks)} tasks in {seconds:.0f} s. The report, data and maps are in {out}/"


def _plants(options: Options, nominal: Arguments) -> list[Arguments]:
    """Return the arguments in which the plants of the design differ from the nominal one."""
    from benchmarks.loop.scenarios import around, grid, random_design

    design = grid()
    if options.design == "random":
        count, seed = options.plants or 200, options.design_seed or 0
        design = random_design(count, seed, options.samples)
    elif options.plants or options.design_seed is not None:
        raise UsageError("--plants and --design-seed are for --design random")
    with blame("--plant, --preset, --set"):
        design = around(nominal, design)
    with blame(f"--design {options.design}"):
        for plant in design:
            Parameters(**{**nominal, **plant})
    return design


def least_error(case: Arguments, samples: int) -> float | None:
    """Return the least mean |e| on a plant, degC; None if it does not settle between changes.

    This is the least possible error if each change of the set point finds the plant settled
    and is not foreseen; see `benchmarks.bounds`.
    """
    from benchmarks.bounds.least import least_possible

    try:
        return least_possible(samples=samples, kind="reference", folder=None, **case).value
    except ValueError:
        return None


def run_agent(
    factory: Any, told: Arguments, case: Arguments, samples: int, runs: int
) -> dict[str, list[float]]:
    """Run a controller that is made for the plant it is `told` on another plant.

    Run i has the noise and the initial weights of seed `SEED + i`. Returned are, for each run,
    all that `measure` returns; `late`, the mean |e| of its second half, degC; and `swing`.
    """
    from benchmarks.loop.rollout import mean_error, measure, split

    controller = factory.in_service({**told, **SETPOINT}, runs, SEED)
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
    from benchmarks.loop.rollout import held

    error = trajectory.setpoint - trajectory.output
    variances = [
        error[(start + stop) // 2 : stop].var(axis=0)
        for start, stop in held(trajectory.setpoint[:, 0])
    ]
    deviation: NDArray[np.float64] = np.sqrt(np.mean(variances, axis=0))
    return deviation


def table(
    plants: Sequence[Arguments], agents: Sequence[str], found: Mapping[str, Any]
) -> pd.DataFrame:
    """Return one row for each run: its plant, its measures, and how they compare.

    Found are, by the names of the tasks, the least error of each plant and the measures of each
    controller on it, and of "nothing". What is missing, as its task has failed, has no row.
    """
    import pandas as pd

    rows = []
    for i, plant in enumerate(plants):
        if not {f"plant {i}", f"plant {i}, nothing"} <= set(found):
            continue
        nothing = pd.DataFrame(found[f"plant {i}, nothing"])
        for agent in agents:
            if (name := f"plant {i}, {agent}") not in found:
                continue
            task = pd.DataFrame({"plant": i, "agent": agent, **found[name]})
            task.insert(2, "run", range(len(task)))
            task["limit"] = found[f"plant {i}"] or np.nan  # None where it does not settle
            task["ratio"] = task["mae"] / task["limit"]
            # Doing nothing in the same noise sets both scales.
            task["oscillates"] = task["swing"] > nothing["swing"] + OSCILLATES
            task["useless"] = task["mae"] >= nothing["mae"]
            rows.append(task.assign(**plant))
    return pd.concat(rows, ignore_index=True) if rows else pd.DataFrame()


def report(
    runs: pd.DataFrame, out: Path, options: Options, nominal: Parameters
) -> list[Section]:
    """Draw the map and return the sections of the report.

    `QUESTIONS` are asked unless the design is a grid or controllers are told each plant.
    """
    from benchmarks.lib.report import Section
    from benchmarks.loop.scenarios import SPANS

    picture = "map.png" if options.design == "grid" else "plants.png"
    best = plot_map(runs, out / picture, nominal if options.design == "grid" else None)
    ends = runs[[name for name in SPANS if name in runs]].agg(["min", "max"])
    spans = ", ".join(f"{name} {low:.4g} to {high:.4g}" for name, (low, high) in ends.items())
    text = [f"The plants have: {spans}.", OVERVIEW_TEXT]
    title = "How many plants each controller works on"
    sections = [Section(title, text, overview(runs), {picture: best})]
    if options.design == "grid" or options.told == "each" or "gain_drift" not in runs:
        return sections
    for title, text_of, pairs in QUESTIONS:
        asked = [pair for pair in pairs if set(pair) <= set(runs["agent"])]
        for measure, when in MEASURES.items() if asked else ():
            compared = differences(runs, asked, measure)
            heading = f"{title} Mean error {when}"
            sections.append(Section(heading, [text_of, DIFFERENCES_TEXT], compared))
    return sections


def summarise(runs: pd.DataFrame) -> pd.DataFrame:
    """Return one row of numbers for each controller; see `OVERVIEW_TEXT`."""
    import pandas as pd

    of = runs.groupby("agent", sort=False)
    ratios = runs.groupby(["agent", "plant"], sort=False)["ratio"].median().groupby("agent")
    columns = {
        "multiple": ratios.median(),
        "multiple_p90": ratios.quantile(0.9),
        "travel": of["total_variation"].median(),
        "oscillates": 100.0 * of["oscillates"].mean(),
        "useless": 100.0 * of["useless"].mean(),
    }
    return pd.DataFrame(columns).reindex(runs["agent"].unique()).reset_index(names="agent")


def overview(runs: pd.DataFrame) -> pd.DataFrame:
    """Return `summarise` as text for the report."""
    found = summarise(runs)
    found["agent"] = found["agent"].map(label)
    for name, (_, form) in COLUMNS.items():
        found[name] = found[name].map(form.format)
    return found.rename(columns={name: heading for name, (heading, _) in COLUMNS.items()})


def differences(
    runs: pd.DataFrame, pairs: Sequence[tuple[str, str]], measure: str
) -> pd.DataFrame:
    """Return differences, a row for each group of plants, a column for each pair."""
    import pandas as pd

    from benchmarks.lib.statistics import bootstrap, improvement

    drifting = runs[runs["gain_drift"].notna()]
    groups = {"no drift": runs[runs["gain_drift"].isna()], "all that drift": drifting}
    for name, column, low, high in GROUPS:
        groups[name] = drifting[drifting[column].between(low, high, inclusive="left")]
    rows = []
    for name, group in groups.items():
        row = {"plants": name, "number": str(group["plant"].nunique())}
        errors = group.pivot_table(index="plant", columns=["agent", "run"], values=measure)
        for pair in pairs if len(errors) > 1 else ():
            ours, theirs = (errors[agent].to_numpy() for agent in pair)
            difference = bootstrap(ours - theirs, seed=SEED)
            better = improvement(ours, theirs, SEED)
            shown = f"{difference:+.3f}; {100 * better.value:.0f} %"
            row[" - ".join(map(label, pair))] = shown
        rows.append(row)
    return pd.DataFrame(rows).fillna("")


def plot_map(runs: pd.DataFrame, path: Path, centre: Parameters | None) -> str:
    """Draw each controller's errors over delay and gain, and return what that shows.

    Errors are multiples of the least possible, the median of each plant. `centre` is the plant
    around which the others are, if they are a grid: then the map marks it.
    """
    import pandas as pd
    from matplotlib.colors import LogNorm

    from benchmarks.lib.report import MULTIPLE, draw_legend, panels, scale_by_excess
    from benchmarks.lib.statistics import groups

    drift = runs.get("gain_drift", pd.Series(np.nan, runs.index))
    largest = runs["gain_factor"] * drift.fillna(1.0).clip(1.0)
    runs = runs.assign(gain=largest, drifts=drift.notna())
    found = summarise(runs).set_index("agent")["multiple"]
    title = (
        f"{label(str(found.idxmin()))} comes closest to the least possible error: "
        f"{found.min():.2f} times in the median plant"
    )
    names = [label(agent) for agent in runs["agent"].unique()]
    size, scale = 14 if centre is None else 26, LogNorm(0.01, 3.0)
    with panels(path, names, 2.3, 3, title, grid=centre is None) as (figure, axes, free):
        for panel, (_, cases) in zip(axes, groups(runs, "agent"), strict=True):
            plants = cases.groupby("plant")
            where = plants[["delay", "gain", "drifts"]].first()
            excess = plants["ratio"].median().sub(1.0).clip(0.01)
            for drifts, part in where.groupby("drifts"):
                marker, text = ("^", "drifts") if drifts else ("s", "as it is")
                shown = excess[part.index]
                image = panel.scatter(
                    part["delay"], part["gain"], size, shown, marker=marker, label=text
                )
                image.set(cmap="cividis_r", norm=scale)
            for name, large, look in MARKS:
                often = where[plants[name].mean() >= 0.5]
                panel.scatter(often["delay"], often["gain"], large, linewidth=0.8, **look)
            if centre is not None:
                at = (sum(centre.range_of(name)) / 2.0 for name in ("delay", "gain_factor"))
                panel.plot(*at, "k+", markersize=12, label="the nominal plant")
        for panel in axes[-3:]:
            panel.set_xlabel("delay (samples)")
        gain = "largest gain factor" if centre is None else "gain factor"
        figure.supylabel(gain, fontsize="medium")
        bar = figure.colorbar(
            image, ax=axes, label=MULTIPLE, extend="both", location="bottom", aspect=60
        )
        scale_by_excess(bar.ax, "x", 0.013, 3.0 / 1.3)
        handles, texts = panel.get_legend_handles_labels()
        draw_legend(figure, free, dict(zip(texts, handles, strict=True)))
    return title


main = command("sweep", Options, work)

if __name__ == "__main__":
    raise SystemExit(main(None))
