"""Test the paper's claims: `python -m benchmarks.claims --help`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.lib.command import FanOut, Folder, Names, Runs, command, known, options
from benchmarks.lib.storage import origin, out_folder, write_csv
from mptc_gym import Parameters

if TYPE_CHECKING:
    import pandas as pd

    from benchmarks.claims.runs import Claim
    from benchmarks.lib.report import Section


NOTE = (
    "Every number rests on independent draws of initial weights and noise. What a claim asks "
    "of a number counts as shown if the whole 95 % interval keeps it. A claim holds if all "
    "that it asks is shown, and in part if some is."
)
PICTURE = {"figures.png": "The cases of the paper's figures: a typical run, and all runs"}
SIGNALS = {
    "output": ("temperature y (°C)", "#0072B2"),
    "command": ("command u (t/h)", "#009E73"),
    "noise": ("noise n (°C)", "#CC79A7"),
}


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Test the paper's claims, each on a thousand runs.

    The verdicts go to report.md, all numbers to claims.csv.
    """

    claims: Names = field(default=(), kw_only=False)
    """Claims to test (default: all)."""
    runs: Runs = 1000
    """Runs of each case."""
    fan_out: FanOut = field(default_factory=FanOut)
    out: Folder = Path("results/claims")


def work(options: Options) -> str:
    """Examine the claims and write the verdicts, also where some examinations have failed."""
    from benchmarks.claims.claims import CLAIMS
    from benchmarks.claims.runs import Batch
    from benchmarks.lib.report import write_report

    chosen = known("CLAIM", options.claims or list(CLAIMS), list(CLAIMS))
    made, out = origin(), out_folder(options.out)
    # The last claims take longest, and start first.
    tasks = {
        name: partial(CLAIMS[name].examined, Batch(options.runs)) for name in reversed(chosen)
    }
    done: dict[str, Claim] = {}
    try:
        done.update(options.fan_out.stream(tasks, "claims"))
    finally:
        claims = [done[each] for each in chosen if each in done]
        if claims:
            write_csv(out / "claims.csv", table(claims))
            if curves := [each.curves for each in claims if each.curves is not None]:
                write_csv(out / "figures.csv", curves[0])
                plot_figures(curves[0], out / "figures.png")
            found = sections(claims, pictures=bool(curves))
            write_report(out, "The paper's claims", found, "claims", made, printed=1)
    return f"All numbers are in {out}/report.md and claims.csv"


def table(claims: Sequence[Claim]) -> pd.DataFrame:
    """Return one row for each finding, and one for each claim without findings."""
    import pandas as pd

    rows: list[dict[str, Any]] = []
    for claim in claims:
        about = {name: getattr(claim, name) for name in ("section", "statement", "verdict")}
        about = {"claim": claim.name, **about}
        rows += [{**about, **finding} for finding in claim.findings] or [about]
    frame = pd.DataFrame(rows)
    # Nullable integers, as a claim without findings has no runs.
    return frame.astype({"runs": "Int64"}) if "runs" in frame else frame


def sections(claims: Sequence[Claim], *, pictures: bool = False) -> list[Section]:
    """Return the sections of the report: the verdicts, then the numbers of each claim."""
    import pandas as pd

    from benchmarks.lib.report import Section

    verdicts = [{"claim": each.statement, "verdict": each.verdict} for each in claims]
    found = [Section("", [NOTE], pd.DataFrame(verdicts), PICTURE if pictures else {})]
    for claim in claims:
        rows = pd.DataFrame([_row(**finding) for finding in claim.findings])
        title, text = f"{claim.statement}: {claim.verdict}", f"{claim.section}. {claim.method}"
        found.append(Section(title, [text], rows if len(rows) else None))
    return found


def _row(
    quantity: str, unit: str, runs: int, criterion: str, shown: str, **numbers: float
) -> dict[str, str]:
    value, low, high = (_three_digits(numbers[name]) for name in ("value", "low", "high"))
    return {
        "measured": quantity + (f" ({unit})" if unit else ""),
        "value": value,
        "95 % interval": "exact" if runs == 1 else f"{low} to {high}",
        "asked": criterion,
        "shown": "**no**" if shown == "no" else shown,
    }


def _three_digits(value: float) -> str:
    if math.isinf(value):
        return "never" if value > 0 else "?"
    digits = 0 if abs(value) >= 100 else 1 if abs(value) >= 10 else 3
    return f"{value:,.{digits}f}"


def plot_figures(curves: pd.DataFrame, path: Path) -> None:
    """Draw counterparts of Figs 5 to 12: a typical run, and the spread of all runs."""
    from benchmarks.claims.runs import FIGURES
    from benchmarks.lib.report import draw_actuator, draw_legend, panels

    found = [
        (f"Fig. {number}: {title}", curves[curves["case"] == title], arguments, signal)
        for title, arguments, _, figures in FIGURES
        for signal, number in figures.items()
    ]
    with panels(path, [title for title, *_ in found], 1.7, 2, *PICTURE.values()) as (
        sheet,
        all_axes,
    ):
        entries: dict[str, Any] = {}
        for axes, (_, case, arguments, signal) in zip(all_axes, found, strict=True):
            minutes, (name, colour) = case["time_s"] / 60, SIGNALS[signal]
            low, high = (case[f"{signal}_{end}"] for end in ("p10", "p90"))
            look: Any = {"color": colour, "alpha": 0.25, "linewidth": 0}
            axes.fill_between(minutes, low, high, label="10th to 90th percentile", **look)
            typical = case[f"{signal}_typical"]
            axes.plot(minutes, typical, color=colour, linewidth=1, label="a typical run")
            if signal == "output":
                axes.plot(minutes, case["setpoint"], "k--", linewidth=1, label="set point")
            if signal == "command":
                draw_actuator(axes, Parameters(**arguments))
            axes.set(xlim=(0, minutes.max()), ylabel=name)
            handles, names = axes.get_legend_handles_labels()
            entries = dict(zip(names, handles, strict=True)) | entries
        for axes in all_axes[-2:]:  # the lowest of each column
            axes.set_xlabel("time (min)")
        draw_legend(sheet, entries)


main = command("claims", Options, work)

if __name__ == "__main__":
    raise SystemExit(main(None))
