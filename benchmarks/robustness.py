"""Compare the linear rules at one robustness: `python -m benchmarks.robustness --help`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.controllers.roster import ROSTER, label
from benchmarks.controllers.spec import ROBUSTNESS
from benchmarks.lib.command import FanOut, Folder, Runs, command, options
from benchmarks.lib.provenance import origin
from benchmarks.lib.results import results_folder
from benchmarks.lib.storage import write_csv
from benchmarks.loop.rollout import is_random, measure
from benchmarks.loop.scenarios import SCENARIOS, Scenario
from mptc_gym.evaluation import SEED

if TYPE_CHECKING:
    import pandas as pd

RULES = [name for name, spec in ROSTER.items() if spec.tuned_by]
CASES = "square", "square-noise", "constant", "load"
PANELS = {  # of the picture: cases and titles
    "square-noise": "square wave with noise, R = 0.5 °C²",
    "load": "load steps at a held set point",
}
SENSITIVITIES = 1.2, 1.3, 1.4, 1.5, ROBUSTNESS, 1.7, 1.8, 2.0, 2.3  # values of Ms
TICKS = 200, 500, 1000, 2000, 5000  # of the valve travel in noise, t/h
TEXT = (
    "Each tuning rule has one free time constant. In the table, the time constant is chosen "
    f"such that the loop has a maximum sensitivity Ms of {ROBUSTNESS:g} on the paper's plant, "
    "without its dead zone and limits. The columns of the cases are mean errors divided by the "
    "least possible error. The range of stable delays, in samples, is the range around the "
    "plant's delay of 18 samples in which the loop is stable."
)
CAPTION = "Error over valve travel along the robustness of three rules"


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Run PI (SIMC), Smith and Dahlin on the paper's plant along their robustness."""

    runs: Runs = 100
    """Runs of each rule in each case with noise or load."""
    fan_out: FanOut = field(default_factory=FanOut)
    out: Folder = Path("results/robustness")


def work(options: Options) -> str:
    """Run the rules, and write the table, the picture and all numbers."""
    import pandas as pd

    from benchmarks.lib.report import Section, write_report

    provenance = origin()
    bounds: dict[str, Any] = {name: partial(lowest, SCENARIOS[name]) for name in CASES}
    loops: dict[str, Any] = {
        f"{name}, Ms {ms:g}": partial(run_rule, name, ms, options.runs)
        for name in RULES
        for ms in SENSITIVITIES
    }
    results = dict(options.fan_out.stream({**bounds, **loops}, "robustness"))
    table = pd.DataFrame([row for name in loops for row in results[name]])
    table["ratio"] = table["mean_error"] / table["case"].map(results)
    compared = table[table["Ms"] == ROBUSTNESS]
    title = f"Three rules at an Ms of {ROBUSTNESS:g}"
    pictures = {"robustness.png": CAPTION}
    sections = [Section(title, [TEXT], overview(compared), pictures=pictures)]
    with results_folder(options.out) as folder:
        write_csv(folder / "robustness.csv", table)
        draw(table, folder / "robustness.png")
        write_report(folder, "Rules at one robustness", sections, provenance)
    return f"The report, all numbers and the picture are in {options.out}/"


def lowest(scenario: Scenario) -> float:
    """Return the least possible mean error of a case, degC."""
    from benchmarks.bounds.least import least_possible

    return least_possible(samples=scenario.samples, **scenario.arguments).value


def run_rule(name: str, sensitivity: float, runs: int) -> list[dict[str, Any]]:
    """Return a row for each case: the results of a rule that is tuned to an Ms.

    A row has the name of the rule, its Ms and time constant, s, the range of stable delays,
    samples, the case, and means over the runs: the error, degC, and the valve travel, t/h.
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
    """Return the table of the report, as text: a row for each rule, a column for each case.

    `rows` are those of `run_rule` at one Ms, with the column `ratio`.
    """
    import pandas as pd

    lines = []
    for name in RULES:
        by_case = rows[rows["agent"] == name].set_index("case")
        noisy: Any = by_case.loc["square-noise"]
        argument = ROSTER[name].tuned_by
        ratios = {case: f"{by_case['ratio'][case]:.3f}" for case in CASES}
        line = {
            "controller": label(name),
            "time constant": f"{argument.replace('_', ' ')} {noisy[argument]:.3g} s",
            **ratios,
            "valve travel in noise (t/h)": f"{noisy['travel']:,.0f}",
            "stable delays": f"{noisy['shortest_delay']:g} to {noisy['longest_delay']:g}",
        }
        lines.append(line)
    return pd.DataFrame(lines)


def finding(rows: pd.DataFrame) -> str:
    """Return the title of the picture: what the rules do in noise at one robustness."""
    noisy = rows[(rows["Ms"] == ROBUSTNESS) & (rows["case"] == "square-noise")]
    ordered = noisy.sort_values("travel")
    least, most = ordered.iloc[0], ordered.iloc[-1]
    share = 100.0 * least["travel"] / most["travel"]
    return (
        f"At an Ms of {ROBUSTNESS:g}, {label(least['agent'])}'s valve travels {share:.0f} % as "
        f"far in noise as {label(most['agent'])}'s, with {least['ratio']:.3f} against "
        f"{most['ratio']:.3f} times the least possible error"
    )


def draw(rows: pd.DataFrame, path: Path) -> None:
    """Draw error ratio over valve travel, a panel for each case of `PANELS`.

    `rows` are those of `run_rule`, with the column `ratio`.
    """
    from matplotlib.lines import Line2D
    from matplotlib.ticker import MaxNLocator, NullLocator

    from benchmarks.lib.pictures import open_panels

    with open_panels(path, [*PANELS.values()], 3.1, 2, finding(rows)) as panels:
        for panel, case in zip(panels.axes, PANELS, strict=True):
            rows_of_case = rows[rows["case"] == case]
            for name in RULES:
                _draw_rule(panel, rows_of_case[rows_of_case["agent"] == name], name)
            panel.set_xlabel("valve travel in a run (t/h)")
            panel.yaxis.set_major_locator(MaxNLocator(5))
        noisy = panels.axes[0]
        noisy.set_xscale("log")
        noisy.set_xticks(TICKS, [f"{tick:,}" for tick in TICKS])
        noisy.xaxis.set_minor_locator(NullLocator())
        noisy.set_ylabel("mean error / least possible")
        handles, names = noisy.get_legend_handles_labels()
        large: Any = {"marker": "o", "markersize": 9, "markeredgecolor": "k", "linestyle": ""}
        handles.append(Line2D([], [], color="0.8", **large))
        names.append(f"Ms {ROBUSTNESS:g}; numbers: Ms of the ends")
        panels.figure.legend(handles, names, loc="outside lower center", ncols=len(names))


def _draw_rule(panel: Any, rows: pd.DataFrame, name: str) -> None:
    """Draw the line of a rule, with the Ms at its ends and a large mark at `ROBUSTNESS`."""
    colour, marker = ROSTER[name].look
    style: Any = {"color": colour, "marker": marker}
    panel.plot(rows["travel"], rows["ratio"], **style, markersize=4, label=label(name))
    compared = rows[rows["Ms"] == ROBUSTNESS]
    panel.plot(compared["travel"], compared["ratio"], **style, ms=10, mec="k")
    offset: Any = {"xytext": (5, 4), "textcoords": "offset points"}
    for end in (rows.iloc[0], rows.iloc[-1]):
        place = end["travel"], end["ratio"]
        panel.annotate(f"{end['Ms']:g}", place, color=colour, fontsize=8, **offset)


main = command("robustness", Options, work)

if __name__ == "__main__":
    raise SystemExit(main(None))
