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
    section: str  # where the claim is in the paper
    criteria: tuple[Criterion, ...]
    setpoints: tuple[str, ...] = BOTH  # set points under which the claim is judged
    is_reported: bool = False  # whether Section 5 of the paper reports this as a result


def share(name: str) -> Callable[[Measured], Array]:
    """Return a function that returns the percentage of the runs in which something happened."""
    return lambda measured: 100.0 * measured[name].mean(axis=-1)


def ratio(name: str, divisor: str) -> Callable[[Measured], Array]:
    """Return a function that returns the median of one quantity divided by that of another."""
    return lambda measured: _median(measured[name]) / _median(measured[divisor])


def median(name: str) -> Callable[[Measured], Array]:
    """Return a function that returns the median of a quantity over the runs."""
    return lambda measured: _median(measured[name])


def _median(values: Array) -> Array:
    """Return the medians over the runs, shape (settings,)."""
    return np.asarray(np.median(values, axis=-1))


def _against_pi(name: str) -> tuple[Criterion, ...]:
    """Return the criteria of a comparison with the paper's PI controller, by its name."""
    quantity = "avoidable error / that of the PI controller"
    return (
        Criterion(quantity, ratio("error, plain", f"error, {name}"), at_most=1 - LARGE),
        Criterion(
            f"{quantity}, R = 0.5",
            ratio("error, noise", f"error, {name}, noise"),
            at_most=1 - LARGE,
        ),
    )


def _pi_gains(name: str) -> tuple[Criterion, ...]:
    """Return the criteria of what the paper says of its PI controller, by its name."""
    return (
        Criterion("peak to peak / set point", median(f"swing, {name}"), at_least=0.1),
        Criterion(
            "avoidable error with the best lower Kp / that with Kp = 2.2",
            median(f"error of the best lower Kp, {name}"),
            at_least=1 - NOTABLE,
        ),
        Criterion("largest pole, twice Kp", median(f"pole, twice Kp, {name}"), at_least=1.0),
        Criterion(
            "largest pole, twice Kp / largest pole, Kp",
            ratio(f"pole, twice Kp, {name}", f"pole, {name}"),
            at_least=1.0,
        ),
        Criterion("largest pole, Kp", median(f"pole, {name}")),
    )


def _no_better(shapes: Iterable[str]) -> tuple[Criterion, ...]:
    """Return the criteria of larger networks, with the same rates for information."""
    criteria = []
    for shape in shapes:
        for rates, at_least in (("", 1 - NOTABLE), (", same rates", -inf)):
            criteria.append(
                Criterion(
                    f"avoidable error, {shape}{rates} / that of the paper's network",
                    ratio(f"error, {shape}{rates}", "error, plain"),
                    at_least=at_least,
                )
            )
    return tuple(criteria)


def _keep_updating() -> tuple[Criterion, ...]:
    """Return the criteria of networks that go on learning, against frozen networks."""
    return tuple(
        Criterion(
            f"avoidable error, {updates} / frozen, {plant}",
            ratio(f"error, {plant}, {updates}", f"error, {plant}, frozen"),
            at_most=1 - NOTABLE if updates == "learning" else inf,
        )
        for updates in ("learning", "every 2nd sample", "every 5th sample")
        for plant in CHANGED_PLANTS
    )


def _reliable() -> tuple[Criterion, ...]:
    """Return the criteria of networks in which a hidden node fails."""
    criteria = []
    for rates, at_most in (("", 1 - NOTABLE), (", same rates", inf)):
        for stuck_at in (0, 1):
            case = f"one stuck at {stuck_at}"
            criteria.append(
                Criterion(
                    f"error after the failure, 6 nodes{rates} / 3 nodes, {case}",
                    ratio(f"error, 6 nodes, {case}{rates}", f"error, 3 nodes, {case}"),
                    at_most=at_most,
                )
            )
    return tuple(criteria)


CLAIMS = {
    "convergence": Claim(
        "The weights converge within 150 samples",
        "Section 5, result 1",
        (Criterion("weights converged at sample 150, % of runs", share("converged"), MOST),),
        is_reported=True,
    ),
    "dead-zone": Claim(
        "A dead zone of 7 t/h costs seriously, and the NN still works",
        "Section 5, result 2",
        (
            Criterion(
                "settled, dead zone 7, % of runs", share("settled, dead zone 7"), at_least=MOST
            ),
            Criterion(
                "avoidable error, dead zone 7 / dead zone 5",
                ratio("error, dead zone 7", "error, plain"),
                at_least=1 + LARGE,
            ),
        ),
        is_reported=True,
    ),
    "noise": Claim(
        "The NN works with noise, R = 0.5",
        "Section 5, result 3",
        (
            Criterion("settled without noise, % of runs", share("settled, plain"), MOST),
            Criterion(
                "avoidable error, R = 0.5 / without noise",
                ratio("error, noise", "error, plain"),
                at_most=1 + NOTABLE,
            ),
        ),
        is_reported=True,
    ),
    "pi": Claim(
        "The NN is much better than the paper's PI controller",
        "Section 5, Figs 5 and 10, 8 and 11",
        _against_pi("PI"),
        is_reported=True,
    ),
    "pi-per-minute": Claim(
        "The NN is much better than the paper's PI controller, Ki per minute",
        "Section 5, Figs 5 and 10, 8 and 11",
        _against_pi("PI per minute"),
    ),
    "wrong-direction": Claim(
        "With -D(G), the training diverges at once",
        "Section 5, on (27)",
        (
            Criterion("diverged, % of runs", share("diverged, wrong sign"), at_least=MOST),
            Criterion("diverged with the right sign, % of runs", share("diverged, plain")),
        ),
        is_reported=True,
    ),
    "six-nodes": Claim(
        "Six hidden nodes are no better than three",
        "Section 5, Fig. 12",
        _no_better(["6 nodes"]),
        is_reported=True,
    ),
    "more-inputs": Claim(
        "More delayed inputs are no better",
        "Section 5, on the choice of inputs",
        _no_better(["6 inputs", "20 inputs"]),
        is_reported=True,
    ),
    "reliability": Claim(
        "More hidden nodes are more reliable",
        "Section 5, last sentence",
        _reliable(),
        ("constant",),
    ),
    "keep-updating": Claim(
        "On a plant that changes, the weights must keep being updated",
        "Section 4, last paragraph",
        _keep_updating(),
        ("square",),
    ),
    "direction-only": Claim(
        "Only the direction of the response must be known",
        "Abstract and Section 6",
        tuple(
            Criterion(f"settled, {plant}, % of runs", share(f"settled, {plant}"), MOST)
            for plant in OTHER_PLANTS
        ),
        ("constant",),
    ),
    "searched-pi": Claim(
        "After a day, the NN is better than PI (searched)",
        "Section 5, end of the comparison",
        tuple(
            Criterion(
                f"avoidable error, {time} 160 min of a day / that of PI (searched), {plant}",
                ratio(f"error, {time}, {plant}, NN", f"error, {time}, {plant}, PI"),
                at_most=1 - NOTABLE if time == "last" else inf,
            )
            for time in ("last", "first")
            for plant in PLANTS
        ),
        ("square",),
    ),
    "day": Claim(
        "The NN goes on working for a day",
        "Section 4, last paragraph",
        tuple(
            Criterion(
                f"mean error, last 160 min of a day / best 160 min, {plant}",
                ratio(f"mean error, last, {plant}, NN", f"mean error, best, {plant}, NN"),
                at_most=1 + NOTABLE,
            )
            for plant in PLANTS
        ),
        ("square",),
    ),
    "pi-gains": Claim(
        "The paper's PI controller oscillates; a lower Kp is no better, a higher one unstable",
        "Section 5, after Fig. 10",
        _pi_gains("PI"),
    ),
    "pi-gains-per-minute": Claim(
        "The same of the paper's PI controller, Ki per minute",
        "Section 5, after Fig. 10",
        _pi_gains("PI per minute"),
    ),
}
CONTROLS = Criterion("settled, % of runs", share("settled, plain"), at_least=MOST)


REPORTED = {name: claim for name, claim in CLAIMS.items() if claim.is_reported}


def judge(
    measured: Mapping[str, Measured], claims: Mapping[str, Claim] = CLAIMS
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
        SETPOINT" is 1 if the claim holds, 0 if not, and NaN if it cannot be judged: the flow
        that the set point needs lies inside a dead zone. A column "CLAIM, SETPOINT: QUANTITY"
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
            # A criterion that cannot be judged does not count beside one that can.
            columns[judged] = pd.DataFrame(verdicts).min().to_numpy()
    return pd.DataFrame(columns)


def _meets(criterion: Criterion, values: Array) -> Array:
    """Return 1.0 where values meet a criterion, 0.0 where not, and NaN where they are NaN."""
    is_met = (criterion.at_least <= values) & (values <= criterion.at_most)
    return np.where(np.isnan(values), np.nan, is_met)
