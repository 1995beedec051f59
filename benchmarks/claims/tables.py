"""Lay out the verdicts on the paper's claims, as shares of settings, for the report."""

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.claims.claims import CLAIMS, PI_CLAIMS, REPORTED, judge
from benchmarks.claims.conditions import Measured
from benchmarks.claims.settings import NAMED_SETTINGS, PAPER_LEVEL
from benchmarks.lib.sections import Section
from benchmarks.lib.statistics import share

# The words "yes", "no" or "undecided" by "CLAIM, SETPOINT", by the name of a setting.
Verdicts = Mapping[str, Mapping[Any, str]]

SETPOINTS = {"constant": "constant", "square": "square wave"}  # words in reports
RESAMPLES = 200  # number of resamples of the runs of a named setting
RESULTS = dict.fromkeys(claim.result for claim in REPORTED.values())  # in order
DECIDED = 0.95  # least share of the resamples that must agree with a verdict

SHARES_NOTE = (
    "The claims are those of the paper by Cui and Shin (1992), and tests of our own. The NN is "
    "the paper's controller, a neural network that learns online. The paper leaves six numbers "
    "of the NN and the set points open. A setting is a random choice of these six numbers and "
    "of the level of the set point. A setting controls at all if most runs settle at a "
    "constant set point without noise. The columns have the percentages of settings in which a "
    "claim holds, at a constant set point and on a square wave, with 95 % intervals that cover "
    "the choice of the settings only. Settings do not count in which the flow cannot hold the "
    "set point in one of a claim's cases. The last two columns say whether the claim holds at "
    f"{PAPER_LEVEL:g} °C with the numbers of least error, and with those that a search found, "
    "'as reported'. Larger networks have learning rates in proportion, unless 'same rates' "
    "says otherwise."
)
PI_NOTE = (
    "What the paper says of its PI controller depends on the level of the set point only. The "
    "table has the number of levels at which it holds. The largest pole is that of the linear "
    "loop, without dead zone and limits, and is the same at all levels."
)
CRITERIA_NOTE = (
    "A claim holds in a setting if the setting meets all criteria of the claim. Most runs are "
    "90 %, notable is a tenth, and large is a half. A mean error is the mean of |e| over the "
    "samples of a run, where e is the set point minus the temperature; an avoidable error is "
    "the mean error minus the reference error of the same case. Errors are medians over the "
    "runs, and after the failure of a node mean errors. A number without a criterion is for "
    "information. The median and the percentiles are over the settings that control at all."
)


LEVELS_NOTE = (
    "The table has the number of results of the paper's Section 5 that hold, of those that can "
    "be judged, by the level of the set point. The results are: "
    f"{', '.join(RESULTS)}. At levels below 4.78 °C, a dead zone of 7 t/h cannot be judged. "
    "Convergence within 150 samples is not judged on the square wave."
)
LIFE_NOTE = (
    "All controllers operate continuously on the square wave of 5 °C, without a restart. An "
    "error is the mean of |e| over 160 min (1,200 samples), and the median over 40 runs. The "
    "NN has the numbers of least error, with learning rates times 1, 0.3, 0.1 and 0.03. It has "
    "learnt when its error is first within a tenth of its best, and is ruined when, after its "
    "best, its error reaches 95 % of that of PI (1992). A cell is empty if that has not "
    "happened, and for a PI controller. Weights are the largest magnitudes of all weights and "
    "thresholds. Two variants are not the paper's, and show why the NN is "
    "ruined: in one, weights stay within ±3; in the other, the learning rates fall in inverse "
    "proportion to time from sample 600 on."
)
LIFE_PICTURE = {"life.png": "Error of continuous operation over days, for each plant"}
FIGURES_NOTE = (
    "The paper's figures 5 to 12 on the paper's plant with the seed 0: first with the numbers "
    "'as reported' at a constant set point, then with those of least error on the square wave. "
    "Figures 7 and 9 have the control input of the runs of figures 6 and 8, and figure 9 also "
    "the noise n(k). Figures 8, 9 and 11 have the same noise."
)
FIGURES = {
    "figures-constant.png": "Figures 5 to 12 at a constant set point",
    "figures-square.png": "Figures 5 to 12 on the square wave",
}


def sections(
    draws: pd.DataFrame, named: Mapping[float, Mapping[str, Measured]], life: pd.DataFrame
) -> list[Section]:
    """Return the sections of the report; the first has the shares of settings.

    Parameters
    ----------
    draws
        Settings that were drawn, and the columns that `judge` returns.
    named
        What was measured with the settings in `NAMED_SETTINGS`, a row for each, by the level of
        the set point, degC, and by the set point. At the level `PAPER_LEVEL`, all claims can be
        judged, and at the others those that the paper reports as results.
    life
        Table that `life.summarise` returns.
    """
    verdicts = _verdicts(named[PAPER_LEVEL])
    return [
        Section("", [SHARES_NOTE, *_sentences(draws)], _shares(draws, verdicts)),
        Section("The paper's PI controller alone", [PI_NOTE], _pi(draws)),
        Section("The paper's results by level of the set point", [LEVELS_NOTE], _levels(named)),
        Section("How long the network lasts", [LIFE_NOTE], _life(life), LIFE_PICTURE),
        Section("Figures 5 to 12", [FIGURES_NOTE], None, FIGURES),
        Section("All criteria", [CRITERIA_NOTE], _criteria(draws, judge(named[PAPER_LEVEL]))),
    ]


def _shares(draws: pd.DataFrame, verdicts: Verdicts) -> pd.DataFrame:
    """Return a row for each claim: shares of settings, and verdicts in the named settings.

    `draws` has a row for each drawn setting, with the columns that `judge` returns: `controls`
    is 1 if most runs settle at a constant set point without noise.
    """
    groups = {"all": draws, "that control": draws[draws["controls"] == 1.0]}
    rows = []
    for name, claim in CLAIMS.items():
        row = {"claim": claim.statement, "in": claim.source}
        for setpoint, words in SETPOINTS.items():
            for group, settings in groups.items():
                estimate = ""
                if setpoint in claim.setpoints:
                    estimate = _share_that_holds(settings[f"{name}, {setpoint}"])
                row[f"{words}: {group} (%)"] = estimate
        for setting in NAMED_SETTINGS:
            answers = [verdicts[setting][f"{name}, {setpoint}"] for setpoint in claim.setpoints]
            row[setting] = " / ".join(answers)
        rows.append(row)
    return pd.DataFrame(rows)


def _share_that_holds(judged: "pd.Series[float]") -> str:
    """Return the percentage of the settings that can be judged in which a claim holds."""
    holds = judged.dropna().to_numpy() == 1.0
    return f"{share(holds).scaled(100):.0f}" if len(holds) else "not judged"


def _sentences(draws: pd.DataFrame) -> list[str]:
    """Return what the table of shares does not say: results together, and what is undecided."""
    controls = draws["controls"] == 1.0
    together = []
    for setpoint, words in SETPOINTS.items():
        held = _results(draws, setpoint).dropna()
        together.append(
            f"{words}: in {len(held)} settings, {controls[held.index].sum()} of which control "
            f"at all, all {held.shape[1]} results that the paper reports can be judged; in "
            f"{held.all(axis=1).sum()} of them, all hold, and in one, at most "
            f"{held.sum(axis=1).max():.0f}"
        )
    unclear = []
    for name, claim in CLAIMS.items():
        for setpoint in claim.setpoints:
            holds = draws.loc[controls, f"{name}, {setpoint}"].dropna().to_numpy() == 1.0
            if len(holds) and share(holds).low < 0.5 < share(holds).high:
                unclear.append(f"{claim.statement!r} ({SETPOINTS[setpoint]})")
    return [
        f"{len(draws)} settings were drawn, of which {controls.sum()} control at all: "
        f"{_share_that_holds(draws['controls'])} %. {'. '.join(together)}.",
        "It is undecided whether these claims hold in more than half of the settings that "
        f"control at all: {'; '.join(unclear) or 'none'}. A verdict on a named setting is "
        f"undecided if less than {DECIDED:.0%} of {RESAMPLES} resamples of its runs agree with "
        "it.",
    ]


def _pi(draws: pd.DataFrame) -> pd.DataFrame:
    """Return at how many levels each claim about the PI controller alone holds."""
    levels = draws.drop_duplicates("level")
    return pd.DataFrame(
        {"claim": claim.statement}
        | {
            words: f"{levels[f'{name}, {setpoint}'].sum():.0f} of {len(levels)}"
            for setpoint, words in SETPOINTS.items()
        }
        for name, claim in PI_CLAIMS.items()
    )


def _results(judged: pd.DataFrame, setpoint: str) -> pd.DataFrame:
    """Return a column for each result of Section 5: whether all of its claims hold."""
    results = {f"{name}, {setpoint}": claim.result for name, claim in REPORTED.items()}
    columns = judged[[name for name in results if name in judged]]
    return columns.rename(columns=results).T.groupby(level=0).min().T


def _verdicts(measured: Mapping[str, Measured]) -> Verdicts:
    """Return the verdicts in the named settings, from what was measured in them.

    A verdict is undecided if less than `DECIDED` of the resamples of the runs agree with it, or
    if the claim cannot be judged.
    """
    judged = [f"{name}, {sp}" for name, claim in CLAIMS.items() for sp in claim.setpoints]
    verdicts = judge(measured)[judged]
    generator = np.random.default_rng(0)
    # Share of the resamples that agree with each verdict. NaN stays NaN, which is not at least
    # `DECIDED`, so a claim that cannot be judged is undecided.
    agreement = 0.0 * verdicts
    for _ in range(RESAMPLES):
        resampled = {}
        for setpoint, quantities in measured.items():
            runs = next(iter(quantities.values())).shape[-1]
            which = generator.integers(runs, size=runs)
            # Each array x has the shape (settings, runs).
            resampled[setpoint] = {name: x[:, which] for name, x in quantities.items()}
        agreement += (judge(resampled)[judged] == verdicts) / RESAMPLES
    words = verdicts.replace({1.0: "yes", 0.0: "no"}).where(agreement >= DECIDED, "undecided")
    return dict(zip(NAMED_SETTINGS, words.to_dict("records"), strict=True))


def _levels(named: Mapping[float, Mapping[str, Measured]]) -> pd.DataFrame:
    """Return how many results of the paper hold in the named settings, by level."""
    rows = []
    for level, measured in sorted(named.items()):
        judged = judge(measured, REPORTED)
        row = {"level (°C)": f"{level:.2f}"}
        for place, setting in enumerate(NAMED_SETTINGS):
            for setpoint, words in SETPOINTS.items():
                holds = _results(judged, setpoint).iloc[place].dropna()
                row[f"{setting}, {words}"] = f"{holds.sum():.0f} of {len(holds)}"
        rows.append(row)
    return pd.DataFrame(rows)


def _life(life: pd.DataFrame) -> pd.DataFrame:
    """Return the table of `life.summarise` as texts, with units in the names of columns."""
    units = dict.fromkeys(["first", "best", "after a day", "last"], " (°C)")
    units |= dict.fromkeys(["learnt", "ruined"], " (days)")
    texts = life.map(lambda x: f"{x:.2f}" if isinstance(x, float) else x).replace("nan", "")
    return texts.rename(columns={name: name + unit for name, unit in units.items()})


def _criteria(draws: pd.DataFrame, named: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each criterion: limits, and numbers of settings."""
    controlling = draws[draws["controls"] == 1.0]
    rows = []
    for name, claim in (CLAIMS | PI_CLAIMS).items():
        for setpoint, criterion in itertools.product(claim.setpoints, claim.criteria):
            column = f"{name}, {setpoint}: {criterion.quantity}"
            low, middle, high = controlling[column].quantile([0.1, 0.5, 0.9])
            row = {"claim": name, "number": criterion.quantity}
            row |= {"set point": SETPOINTS[setpoint], "asked": criterion.limit}
            row["median (10 % to 90 %)"] = f"{middle:.4g} ({low:.4g} to {high:.4g})"
            row |= zip(NAMED_SETTINGS, named[column].map("{:.4g}".format), strict=True)
            rows.append(row)
    return pd.DataFrame(rows)
