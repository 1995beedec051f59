"""Compare linear controllers of equal robustness: `python -m benchmarks.robustness --help`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.controllers.roster import ROSTER, label
from benchmarks.controllers.spec import ROBUSTNESS
from benchmarks.lib.command import Folder, Runs, command, options
from benchmarks.lib.parallel import FanOut
from benchmarks.lib.provenance import origin
from benchmarks.lib.results import results_folder
from benchmarks.lib.storage import write_csv
from benchmarks.loop.rollout import is_random, measure
from benchmarks.loop.scenarios import SCENARIOS, Scenario
from mptc_gym.evaluation import SEED

if TYPE_CHECKING:
    import pandas as pd

# Controllers with a tuning rule that has a single parameter, a time constant.
TUNED_BY_RULE = [name for name, spec in ROSTER.items() if spec.tuned_by]
CASES = "square", "square-noise", "constant", "load"  # names of scenarios
# The panels of the picture: a case, and the title of its panel.
PANELS = {
    "square-noise": "square wave with noise, R = 0.5 °C²",
    "load": "load steps at a held set point",
}
# Values of Ms, the largest magnitude of the loop's sensitivity function: the lower Ms is, the
# more robust is the loop. `ROBUSTNESS` is the Ms at which controllers are compared.
SENSITIVITIES = 1.2, 1.3, 1.4, 1.5, ROBUSTNESS, 1.7, 1.8, 2.0, 2.3
TRAVEL_TICKS = 200, 500, 1000, 2000, 5000  # ticks of the axis of valve travel in noise, t/h
TEXT = (
    "The maximum sensitivity Ms is the largest magnitude of the sensitivity function of a "
    "control loop: the lower Ms is, the more robust is the loop. Each of the three controllers "
    "is tuned by a rule with one free time constant. In the table, this time constant is "
    f"chosen such that the loop with the paper's plant has an Ms of {ROBUSTNESS:g}, where dead "
    "zone and limits of the actuator are left out. The columns square, square-noise, constant "
    "and load have the error ratio in these cases of the comparison, which is the mean error "
    "divided by the least possible error. The valve travel is the sum of all changes of the "
    "applied flow in a run of the case square-noise. The last column has the range of delays "
    "with which the loop is stable; the paper's plant has a delay of 18 samples."
)
LEGEND = (
    "marks of a line, from left to right: maximum sensitivity Ms of "
    f"{', '.join(f'{ms:g}' for ms in SENSITIVITIES)} (a low Ms is robust)"
)
CAPTION = "Error ratio over valve travel of three linear controllers at several values of Ms"


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Run PI (SIMC), Smith and Dahlin, each tuned to several maximum sensitivities Ms."""

    runs: Runs = 100
    """The number of runs of each controller in each case with noise or load."""
    fan_out: FanOut = field(default_factory=FanOut)
    out: Folder = Path("results/robustness")


def work(options: Options) -> str:
    """Run all controllers, write the results, and return a sentence that names their folder."""
    import pandas as pd

    from benchmarks.lib.report import Section, write_report

    provenance = origin()
    bounds: dict[str, Any] = {name: partial(lowest, SCENARIOS[name]) for name in CASES}
    loops: dict[str, Any] = {
        f"{name}, Ms {ms:g}": partial(run_rule, name, ms, options.runs)
        for name in TUNED_BY_RULE
        for ms in SENSITIVITIES
    }
    results = dict(options.fan_out.stream({**bounds, **loops}, "robustness"))
    table = pd.DataFrame([row for name in loops for row in results[name]])
    table["ratio"] = table["mean_error"] / table["case"].map(results)
    compared = table[table["Ms"] == ROBUSTNESS]
    title = f"Three linear controllers with a maximum sensitivity Ms of {ROBUSTNESS:g}"
    pictures = {"robustness.png": CAPTION}
    sections = [Section(title, [TEXT], overview(compared), pictures=pictures)]
    with results_folder(options.out) as folder:
        write_csv(folder / "robustness.csv", table)
        draw(table, folder / "robustness.png")
        write_report(folder, "Linear controllers of equal robustness", sections, provenance)
    return f"The report, all numbers and the picture are in {options.out}/"


def lowest(scenario: Scenario) -> float:
    """Return the least possible mean error of a scenario, degC."""
    from benchmarks.bounds.least import least_possible

    return least_possible(samples=scenario.samples, **scenario.arguments).value


def run_rule(name: str, sensitivity: float, runs: int) -> list[dict[str, Any]]:
    """Run a controller that is tuned to a maximum sensitivity, and return a row for each case.

    The control loop with the paper's plant has the maximum sensitivity `sensitivity`, which is
    the largest magnitude of the loop's sensitivity function. `name` is one of `TUNED_BY_RULE`.
    Cases with noise or load have `runs` runs, and all other cases have one run.

    Returns
    -------
    list of dict
        A dict for each case, with these keys:

        - `agent`: the name of the controller;
        - `Ms`: the maximum sensitivity;
        - `closed_loop_time_constant` or `filter_time_constant`: the time constant of the tuning
          rule, chosen such that the loop has the maximum sensitivity `sensitivity`, s;
        - `shortest_delay` and `longest_delay`: the shortest and the longest delay with which
          the loop is stable, samples;
        - `case`: the name of the case;
        - `mean_error`: the mean absolute error over the runs, degC;
        - `travel`: the mean valve travel over the runs, t/h.
    """
    spec = replace(ROSTER[name], sensitivity=sensitivity)
    shortest, longest = spec.loop({}).stable_delays() or (None, None)
    rows = []
    for case in CASES:
        scenario = SCENARIOS[case]
        parameters = scenario.parameters
        count = runs if is_random(parameters) else 1
        trajectory = spec.run(scenario.arguments, scenario.samples, count, SEED)
        measures = measure(trajectory, parameters)
        row = {
            "agent": name,
            "Ms": sensitivity,
            spec.tuned_by: spec.robust_time_constant(scenario.arguments),
            "shortest_delay": shortest,
            "longest_delay": longest,
            "case": case,
            "mean_error": measures["mae"].mean(),
            "travel": measures["total_variation"].mean(),
        }
        rows.append(row)
    return rows


def overview(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the table of the report, a table of texts with a row for each controller.

    The table of the report has a column of error ratios for each case. `rows` has the rows that
    `run_rule` returns for all controllers at a single Ms, and an additional column `ratio`: the
    mean error divided by the least possible error.
    """
    import pandas as pd

    lines = []
    for name in TUNED_BY_RULE:
        by_case = rows[rows["agent"] == name].set_index("case")
        noisy: Any = by_case.loc["square-noise"]
        argument = ROSTER[name].tuned_by
        delays = f"{noisy['shortest_delay']:g} to {noisy['longest_delay']:g}"
        ratios = {case: f"{by_case['ratio'][case]:.3f}" for case in CASES}
        line = {
            "controller": label(name),
            "time constant": f"{argument.replace('_', ' ')} {noisy[argument]:.3g} s",
            **ratios,
            "valve travel in noise (t/h)": f"{noisy['travel']:,.0f}",
            "stable with delays of (samples)": delays,
        }
        lines.append(line)
    return pd.DataFrame(lines)


def finding(rows: pd.DataFrame) -> str:
    """Return the picture's title, which compares errors and valve travels in noise.

    The title compares the controllers with the least and the most valve travel at an Ms of
    `ROBUSTNESS`. `rows` is a table like the argument `rows` of `draw`.
    """
    noisy = rows[(rows["Ms"] == ROBUSTNESS) & (rows["case"] == "square-noise")]
    ordered = noisy.sort_values("travel")
    least, most = ordered.iloc[0], ordered.iloc[-1]
    share = 100.0 * least["travel"] / most["travel"]
    return (
        f"At equal robustness (Ms {ROBUSTNESS:g}) and in noise, {label(least['agent'])} moves "
        f"the valve {share:.0f} % as far as {label(most['agent'])}, with an error ratio of "
        f"{least['ratio']:.3f} against {most['ratio']:.3f}"
    )


def draw(rows: pd.DataFrame, path: Path) -> None:
    """Draw error ratios over valve travel, and write the picture to the file `path`.

    The picture has a panel for each case of `PANELS`. `rows` has the rows that `run_rule`
    returns for all controllers and values of Ms, and an additional column `ratio`: the mean
    error divided by the least possible error.
    """
    from matplotlib.lines import Line2D
    from matplotlib.ticker import MaxNLocator, NullLocator

    from benchmarks.lib.pictures import open_picture

    with open_picture(path, 4.3, finding(rows)) as figure:
        panels = figure.subplots(1, len(PANELS))
        for panel, (case, title) in zip(panels, PANELS.items(), strict=True):
            panel.set_title(title)
            rows_of_case = rows[rows["case"] == case]
            for name in TUNED_BY_RULE:
                _draw_rule(panel, rows_of_case[rows_of_case["agent"] == name], name)
            panel.set_xlabel("valve travel in a run (t/h)")
            panel.set_ylabel("mean error / least possible error")
            panel.yaxis.set_major_locator(MaxNLocator(5))
        noisy = panels[0]
        noisy.set_xscale("log")
        noisy.set_xticks(TRAVEL_TICKS, [f"{tick:,}" for tick in TRAVEL_TICKS])
        noisy.xaxis.set_minor_locator(NullLocator())
        handles, names = noisy.get_legend_handles_labels()
        large: Any = {"marker": "o", "markersize": 9, "markeredgecolor": "k", "linestyle": ""}
        handles.append(Line2D([], [], color="0.8", **large))
        names.append(f"Ms {ROBUSTNESS:g}")
        figure.legend(
            handles, names, title=LEGEND, loc="outside lower center", ncols=len(names)
        )


def _draw_rule(panel: Any, rows: pd.DataFrame, name: str) -> None:
    """Draw a controller's line of error ratio over valve travel in a panel.

    The line has a mark for each value of Ms, and a large mark at an Ms of `ROBUSTNESS`. `rows`
    has the rows of one controller and one case, in the order of Ms.
    """
    colour, marker = ROSTER[name].look
    style: Any = {"color": colour, "marker": marker}
    panel.plot(rows["travel"], rows["ratio"], **style, markersize=4, label=label(name))
    compared = rows[rows["Ms"] == ROBUSTNESS]
    panel.plot(compared["travel"], compared["ratio"], **style, ms=10, mec="k")


main = command("robustness", Options, work)

if __name__ == "__main__":
    raise SystemExit(main(None))
