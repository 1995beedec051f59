"""List the paper's claims with their criteria, and judge settings by the criteria.

The paper is that of Cui and Shin (1992), whose controller is a neural network (NN) that learns
online.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from math import inf
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.claims.conditions import CHANGED_PLANTS, OTHER_PLANTS, PLANTS, Measured
from benchmarks.claims.settings import Array

# Limits that give words of the claims a meaning, the same for all claims.
NOTABLE = 0.1  # A relative change of an error is "notable" from this share on.
LARGE = 0.5  # "much better", "seriously worse": the error changes by at least this share.
FIFTH = 0.2  # "large" for the claims that show how much depends on the limit
MOST = 90.0  # percentage of the runs that counts as most runs

BOTH = "constant", "square"


@dataclass(frozen=True)
class Criterion:
    """A number of a setting, and the values of the number that a claim allows.

    If `at_least` and `at_most` are infinite, the number is for information only.
    """

    quantity: str  # name of the number in reports
    value: Callable[[Measured], Array]  # from what was measured to the number of each setting
    at_least: float = -inf
    at_most: float = inf

    @property
    def limit(self) -> str:
        """The allowed values in words; "" for a number that is for information only."""
        bounds = {"at least": self.at_least, "at most": self.at_most}
        return " and ".join(f"{name} {x:.4g}" for name, x in bounds.items() if np.isfinite(x))


@dataclass(frozen=True)
class Claim:
    """A claim of the paper, which holds in a setting if the setting meets all criteria."""

    statement: str
    source: str  # where the claim is in the paper, or that the test is ours
    criteria: tuple[Criterion, ...]
    setpoints: tuple[str, ...] = BOTH  # set points under which the claim is judged
    result: str = ""  # the result of Section 5 to which the claim belongs; "" if to none


def share(name: str) -> Callable[[Measured], Array]:
    """Return a function that returns the percentage of the runs in which something happened."""
    return lambda measured: 100.0 * measured[name].mean(axis=-1)


def ratio(name: str, divisor: str) -> Callable[[Measured], Array]:
    """Return a function that returns the median of one quantity divided by that of another."""
    return lambda measured: median(name)(measured) / median(divisor)(measured)


def median(name: str) -> Callable[[Measured], Array]:
    """Return a function that returns the median of a quantity over the runs."""
    return lambda measured: np.asarray(np.median(measured[name], axis=-1))


def ratios(
    quantity: str, name: str, divisor: str, cases: Iterable[Any], **limits: float
) -> tuple[Criterion, ...]:
    """Return a criterion for each case, whose name stands for "{}" in all names."""
    return tuple(
        Criterion(
            quantity.format(case), ratio(name.format(case), divisor.format(case)), **limits
        )
        for case in cases
    )


def _against_pi(name: str, at_most: float = 1 - LARGE) -> tuple[Criterion, ...]:
    """Return the criteria of a comparison with the paper's PI controller, by its name."""
    quantity = "avoidable error / that of the PI controller"
    return (
        Criterion(quantity, ratio("error, plain", f"error, {name}"), at_most=at_most),
        Criterion(
            f"{quantity}, R = 0.5",
            ratio("error, noise", f"error, {name}, noise"),
            at_most=at_most,
        ),
    )


def _no_better(*networks: str) -> tuple[Criterion, ...]:
    """Return the criteria of larger networks, by their names."""
    return ratios(
        "avoidable error, {} / that of the paper's network",
        "error, {}",
        "error, plain",
        networks,
        at_least=1 - NOTABLE,
    )


def _reliable(rates: str = "") -> tuple[Criterion, ...]:
    """Return the criteria of networks in which a hidden node fails."""
    return ratios(
        f"error after the failure, 6 nodes{rates} / 3 nodes, one stuck at {{}}",
        f"error, 6 nodes, one stuck at {{}}{rates}",
        "error, 3 nodes, one stuck at {}",
        (0, 1),
        at_most=1 - NOTABLE,
    )


def _keep_updating(updates: str) -> tuple[Criterion, ...]:
    """Return the criteria of networks that go on learning, against frozen networks."""
    return ratios(
        f"avoidable error, {updates} / frozen, {{}}",
        f"error, {{}}, {updates}",
        "error, {}, frozen",
        CHANGED_PLANTS,
        at_most=1 - NOTABLE,
    )


def _settles(plants: Iterable[str]) -> tuple[Criterion, ...]:
    """Return the criteria of networks that settle on several plants."""
    return tuple(
        Criterion(f"settled, {plant}, % of runs", share(f"settled, {plant}"), at_least=MOST)
        for plant in plants
    )


def _smallest(criteria: Iterable[Criterion]) -> Callable[[Measured], Array]:
    """Return a function that returns the smallest of the numbers of several criteria."""
    return lambda measured: np.min([each.value(measured) for each in criteria], axis=0)


def _lasts(quantity: str, window: str, **limits: float) -> tuple[Criterion, ...]:
    """Return the criteria of 160 min of a day's operation, against PI (searched)."""
    return ratios(
        quantity, f"error, {window}, {{}}, NN", f"error, {window}, {{}}, PI", PLANTS, **limits
    )


SECTION_5 = "Section 5"
OURS = "our own test"
CLAIMS = {
    "convergence": Claim(
        "The weights converge within 150 samples",
        SECTION_5,
        (Criterion("weights converged at sample 150, % of runs", share("converged"), MOST),),
        # On the square wave, the weights would have to be final before the first change of
        # sign of the set point, at sample 300.
        ("constant",),
        result="convergence",
    ),
    "dead-zone-works": Claim(
        "With a dead zone of 7 t/h, the NN still works well",
        SECTION_5,
        _settles(["dead zone 7"]),
        result="dead zone",
    ),
    "dead-zone-serious": Claim(
        "A dead zone of 7 t/h affects the NN seriously",
        SECTION_5,
        (
            Criterion(
                "avoidable error, dead zone 7 / dead zone 5",
                ratio("error, dead zone 7", "error, plain"),
                at_least=1 + LARGE,
            ),
        ),
        result="dead zone",
    ),
    "dead-zone-fifth": Claim(
        "A dead zone of 7 t/h costs at least a fifth",
        OURS,
        (
            Criterion(
                "avoidable error, dead zone 7 / dead zone 5",
                ratio("error, dead zone 7", "error, plain"),
                at_least=1 + FIFTH,
            ),
        ),
    ),
    "noise": Claim(
        "Noise, R = 0.5, adds little to the NN's error",
        SECTION_5,
        (
            Criterion("settled without noise, % of runs", share("settled, plain"), MOST),
            Criterion(
                "avoidable error, R = 0.5 / without noise",
                ratio("error, noise", "error, plain"),
                at_most=1 + NOTABLE,
            ),
        ),
        result="noise",
    ),
    "pi": Claim(
        "The NN is much better than the paper's PI controller",
        SECTION_5,
        _against_pi("PI"),
        result="the paper's PI controller",
    ),
    "pi-fifth": Claim(
        "The NN is better by a fifth than the paper's PI controller",
        OURS,
        _against_pi("PI", 1 - FIFTH),
    ),
    "pi-per-minute": Claim(
        "The NN is much better than the paper's PI controller, Ki per minute",
        SECTION_5,
        _against_pi("PI per minute"),
    ),
    "wrong-direction": Claim(
        "With -D(G), the training diverges at once",
        SECTION_5,
        (
            Criterion("diverged, % of runs", share("diverged, wrong sign"), at_least=MOST),
            Criterion("diverged with the right sign, % of runs", share("diverged, plain")),
        ),
        result="direction",
    ),
    "six-nodes": Claim(
        "Six hidden nodes are no better than three",
        SECTION_5,
        _no_better("6 nodes"),
        result="six nodes",
    ),
    "six-nodes-same-rates": Claim(
        "Six hidden nodes are no better than three, same rates",
        SECTION_5,
        _no_better("6 nodes, same rates"),
    ),
    "more-inputs": Claim(
        "More delayed inputs are no better",
        SECTION_5,
        _no_better("6 inputs", "20 inputs"),
        result="more inputs",
    ),
    "more-inputs-same-rates": Claim(
        "More delayed inputs are no better, same rates",
        SECTION_5,
        _no_better("6 inputs, same rates", "20 inputs, same rates"),
    ),
    "reliability": Claim(
        "More hidden nodes are more reliable", SECTION_5, _reliable(), ("constant",)
    ),
    "reliability-same-rates": Claim(
        "More hidden nodes are more reliable, same rates",
        SECTION_5,
        _reliable(", same rates"),
        ("constant",),
    ),
    "keep-updating": Claim(
        "The weights must keep being updated, after each of three changes of the plant",
        "Section 4",
        _keep_updating("learning"),
        ("square",),
    ),
    "keep-updating-one": Claim(
        "The weights must keep being updated, after at least one of the changes",
        "Section 4",
        (
            Criterion(
                "avoidable error, learning / frozen, smallest of all changes",
                _smallest(_keep_updating("learning")),
                at_most=1 - NOTABLE,
            ),
        ),
        ("square",),
    ),
    "every-2nd": Claim(
        "Updates at every 2nd sample help, after each of the changes",
        "Section 4",
        _keep_updating("every 2nd sample"),
        ("square",),
    ),
    "every-5th": Claim(
        "Updates at every 5th sample help, after each of the changes",
        "Section 4",
        _keep_updating("every 5th sample"),
        ("square",),
    ),
    "other-plants": Claim(
        "The same numbers work on six other plants",
        OURS,
        _settles(OTHER_PLANTS),
        ("constant",),
    ),
    "other-plants-five": Claim(
        "The same numbers work on the five of them without twice the gain",
        OURS,
        _settles(name for name in OTHER_PLANTS if name != "gain 2"),
        ("constant",),
    ),
    "searched-pi": Claim(
        "After a day, the NN is better than PI (searched)",
        OURS,
        (
            *_lasts(
                "avoidable error, last 160 min of a day / that of PI (searched), {}",
                "last",
                at_most=1 - NOTABLE,
            ),
            *_lasts(
                "avoidable error, first 160 min of a day / that of PI (searched), {}", "first"
            ),
        ),
        ("square",),
    ),
    "day": Claim(
        "The NN goes on working for a day",
        OURS,
        ratios(
            "mean error, last 160 min of a day / best 160 min, {}",
            "mean error, last, {}, NN",
            "mean error, best, {}, NN",
            PLANTS,
            at_most=1 + NOTABLE,
        ),
        ("square",),
    ),
}


def _pi_gains(name: str, reading: str) -> dict[str, Claim]:
    """Return what the paper says of its PI controller, for a reading of the gain Ki."""
    criteria = {
        "The paper's PI controller oscillates": [
            Criterion("peak to peak / set point", median(f"swing, {name}"), at_least=0.1)
        ],
        "A lower Kp of the PI controller is no better": [
            Criterion(
                "avoidable error with the best lower Kp / that with Kp = 2.2",
                median(f"error of the best lower Kp, {name}"),
                at_least=1 - NOTABLE,
            )
        ],
        "A higher Kp of the PI controller is unstable": [
            Criterion("largest pole, twice Kp", median(f"pole, twice Kp, {name}"), 1.0),
            Criterion(
                "largest pole, twice Kp / largest pole, Kp",
                ratio(f"pole, twice Kp, {name}", f"pole, {name}"),
                at_least=1.0,
            ),
            Criterion("largest pole, Kp", median(f"pole, {name}")),
        ],
    }
    return {
        f"{name}: {statement}": Claim(f"{statement}, {reading}", SECTION_5, tuple(numbers))
        for statement, numbers in criteria.items()
    }


# Claims about the PI controller alone, which depend on the level of the set point only.
PI_CLAIMS = _pi_gains("PI", "Ki per sample") | _pi_gains("PI per minute", "Ki per minute")
CONTROLS = Criterion("settled, % of runs", share("settled, plain"), at_least=MOST)


REPORTED = {name: claim for name, claim in CLAIMS.items() if claim.result}


def judge(
    measured: Mapping[str, Measured], claims: Mapping[str, Claim] = CLAIMS | PI_CLAIMS
) -> pd.DataFrame:
    """Return all numbers of settings, and whether claims hold in the settings.

    Parameters
    ----------
    measured
        What was measured, by the set point, "constant" or "square".
    claims
        The claims to judge, by name.

    Returns
    -------
    DataFrame
        A row for each setting. The first column, "controls", says whether the network controls
        at all: whether most runs settle at a constant set point without noise. A column "CLAIM,
        SETPOINT" is 1 if the claim holds, 0 if not, and NaN if it cannot be judged, because the
        flow cannot hold the set point in one of its cases. A column "CLAIM, SETPOINT: QUANTITY"
        has the number of a criterion.
    """
    settles = CONTROLS.value(measured["constant"])
    columns: dict[str, Any] = {"controls": _meets(CONTROLS, settles)}
    for name, claim in claims.items():
        for setpoint in claim.setpoints:
            judged = f"{name}, {setpoint}"
            columns[judged] = np.nan  # to be replaced; the verdict stands before the numbers
            verdicts = []
            for criterion in claim.criteria:
                values = criterion.value(measured[setpoint])
                columns[f"{judged}: {criterion.quantity}"] = values
                if criterion.limit:
                    verdicts.append(_meets(criterion, values))
            columns[judged] = np.min(verdicts, axis=0)  # NaN if any is NaN
    return pd.DataFrame(columns)


def _meets(criterion: Criterion, values: Array) -> Array:
    """Return 1.0 where values meet a criterion, 0.0 where not, and NaN where they are NaN."""
    is_met = (criterion.at_least <= values) & (values <= criterion.at_most)
    return np.where(np.isnan(values), np.nan, is_met)
