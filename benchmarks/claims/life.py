"""Measure how long the paper's network works if it never stops learning.

All controllers operate continuously on the square wave, without a restart. An error is the mean
of |e| over 160 min (1,200 samples), in degC, and of several runs the median is taken.
"""

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from agents import DirectNNController, PIController
from benchmarks.claims.claims import NOTABLE
from benchmarks.claims.conditions import DAY, PAPER_PI, PLANTS, WINDOW, errors_by_window
from benchmarks.claims.settings import LEAST_ERROR, PAPER_LEVEL, Array, Batch
from benchmarks.controllers.roster import ROSTER

RUNS = 40  # number of runs of each controller
RUINED = 0.95  # A network is ruined from this share of the error of PI (1992) on.
RATES = "eta", "eta_1", "eta_theta", "eta_1_theta"  # the learning rates


@dataclass(frozen=True)
class Variant:
    """A variant of the paper's network, of which the paper has the one with the defaults."""

    rates: float = 1.0  # factor of the learning rates of the setting "least error"
    bound: float = np.inf  # largest magnitude of a weight or threshold
    # Sample from which on the learning rates are inversely proportional to the time.
    falls_from: float = np.inf


VARIANTS = {
    "NN, rates x 1": Variant(),
    "NN, rates x 0.3": Variant(rates=0.3),
    "NN, rates x 0.1": Variant(rates=0.1),
    "NN, rates x 0.03": Variant(rates=0.03),
    "not the paper's: weights within ±3": Variant(bound=3.0),
    "not the paper's: rates fall": Variant(falls_from=600.0),
}
PAPER_PI_LABEL = "PI (1992)"
PI_LABELS = PAPER_PI_LABEL, "PI (1992), Ki per minute", "PI (SIMC)", "PI (searched)"


class LimitedNetworks(DirectNNController):
    """Networks whose weights are bounded, or whose learning rates fall, for information.

    The attributes `bound` and `falls_from`, as in `Variant`, have a number for each loop, and
    `first_rates` has the learning rates at the first sample by name.
    """

    bound: Array
    falls_from: Array
    first_rates: dict[str, Array]

    def _control(self, rows: Array) -> Array:
        """Return the commands u(k), update the weights, and limit the weights."""
        factor = np.minimum(1.0, self.falls_from / (self._sample + 1))
        vars(self).update({name: factor * rate for name, rate in self.first_rates.items()})
        u = super()._control(rows)
        for array in self._arrays:  # whose last axis is the loops
            np.clip(array, -self.bound, self.bound, out=array)
        return u


def operate(condition: str, days: int, seed: int) -> pd.DataFrame:
    """Operate all controllers on the plants of a condition, and return what happens over time.

    Parameters
    ----------
    condition
        Name of the plant in `PLANTS`.
    days
        Length of the operation, days.
    seed
        Seed of the first loop.

    Returns
    -------
    DataFrame
        A row for each controller and each 160 min, with the columns `plant`, `controller`,
        `days` (the time at the end of the 160 min), `error` (degC) and `largest_weight` (the
        largest magnitude of a weight or threshold of a network at that time; else NaN). Error
        and weight are medians over the runs.
    """
    variants = pd.DataFrame([vars(variant) for variant in VARIANTS.values()])
    settings = pd.DataFrame([LEAST_ERROR] * len(variants))
    settings[[*RATES]] = settings[[*RATES]].mul(variants["rates"], axis=0)
    of_networks = Batch(settings, PAPER_LEVEL, RUNS, seed)
    networks = of_networks.networks(kind=LimitedNetworks)
    limits = {
        name: np.repeat(variants[name].to_numpy(), RUNS) for name in ("bound", "falls_from")
    }
    first_rates = {name: getattr(networks, name) for name in RATES}
    vars(networks).update(limits, first_rates=first_rates)

    controllers: list[Any] = [networks]
    controllers += [PIController(gains["kp"], gains["ki"]) for gains in PAPER_PI.values()]
    for name in ("pi-simc", "pi-searched"):
        controller, _ = ROSTER[name].start({}, RUNS, seed)
        controllers.append(controller)
    # Each PI controller has as many loops as a variant of the network.
    ends = of_networks.loops + RUNS * np.arange(len(PI_LABELS))
    largest_weights = []
    samples = itertools.count(1)

    def act(observations: Any) -> Any:
        """Return the actions of all controllers, each from the observations of its loops."""
        parts = zip(controllers, np.split(observations, ends), strict=True)
        actions = np.concatenate([controller.act(part) for controller, part in parts])
        if next(samples) % WINDOW == 0:
            arrays = vars(networks.weights).values()
            columns = [array.reshape(of_networks.loops, -1) for array in arrays]
            largest_weights.append(np.abs(np.hstack(columns)).max(axis=1))
        return actions

    labels = [*VARIANTS, *PI_LABELS]
    everyone = Batch(pd.DataFrame(index=labels), PAPER_LEVEL, RUNS, seed)
    errors = errors_by_window(act, everyone, days * DAY, **PLANTS[condition])
    windows = len(errors)
    weights = np.full((windows, len(labels)), np.nan)
    weights[:, : len(VARIANTS)] = np.median(of_networks.by_setting(largest_weights), axis=-1)
    columns = {
        "plant": condition,
        "controller": np.tile(labels, windows),
        "days": np.repeat((1 + np.arange(windows)) * WINDOW / DAY, len(labels)),
        "error": np.median(errors, axis=-1).ravel(),
        "largest_weight": weights.ravel(),
    }
    return pd.DataFrame(columns)


def summarise(operation: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each plant and controller, from the tables that `operate` returns.

    The columns are the errors over the first 160 min, after a day, the best and the last, degC;
    the times until a controller has learnt and until it is ruined, days; and the largest
    magnitudes of the weights after a day and at the end.

    A controller has learnt when its error is first within `NOTABLE` of its best, and is ruined
    when, after its best, its error first reaches `RUINED` times the mean error of PI (1992).
    The time of an event that does not happen is NaN, and so is that of a PI controller.
    """
    rows = []
    for plant, of_plant in operation.groupby("plant", sort=False):
        is_paper_pi = of_plant["controller"] == PAPER_PI_LABEL
        paper_error = of_plant.loc[is_paper_pi, "error"].mean()
        for controller, of_controller in of_plant.groupby("controller", sort=False):
            error: Any = of_controller.set_index("days")["error"]
            weight: Any = of_controller.set_index("days")["largest_weight"]
            best = error.idxmin()
            has_learnt = error <= (1 + NOTABLE) * error[best]
            is_ruined = (error >= RUINED * paper_error) & (error.index > best)
            is_network = controller in VARIANTS
            rows.append(
                {
                    "plant": plant,
                    "controller": controller,
                    "first": error.iloc[0],
                    "best": error[best],
                    "after a day": error[1.0],
                    "last": error.iloc[-1],
                    "learnt": has_learnt.idxmax() if is_network else np.nan,
                    "ruined": is_ruined.idxmax() if is_network and is_ruined.any() else np.nan,
                    "weight after a day": weight[1.0],
                    "last weight": weight.iloc[-1],
                }
            )
    return pd.DataFrame(rows)
