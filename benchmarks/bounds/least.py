"""Compute the least possible mean error of any case of the environment, and scores from it.

The kinds "preview" and "causal" are theorems; "reference" holds under a condition. README.md
says for which controllers. The mean error is that of the rewards, of |e(k)| over k = 1 to N. A
bound is the mean over the episodes that the environment draws; for each, it is the optimum of
`linear_program.py`, given what `unknown.py` leaves unknown. The bounds assume that the plant is
(28) and (29), and that a controller at k knows the transmitter's
readings up to k, and perhaps any set points, plant numbers and loads up to k, but not the true
output, `info["output"]`. It may undo the dead zone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchmarks.bounds.causal import SetPointLaw
from benchmarks.bounds.linear_program import SMOOTH, TAIL, Plan, plan, reference
from benchmarks.bounds.unknown import Unknown, unknown
from benchmarks.lib.statistics import Estimate, student
from benchmarks.lib.storage import ROOT, Kept
from benchmarks.loop.linear import TimeVaryingModel, time_varying_model
from benchmarks.loop.rollout import IdleValve, drawn_numbers, make_plants, rollout
from mptc_gym import Parameters
from mptc_gym.evaluation import EPISODES, SEED
from mptc_gym.ranges import numbers_of_plant

Array = NDArray[np.float64]

KINDS = {  # the controllers that cannot do better
    "preview": "every controller that reads the transmitter and not the true output, even one "
    "that knows the set point beforehand",
    "causal": "controllers that read the transmitter and not the true output, and that learn "
    "of a change of the set point when it happens",
    "reference": "none: a reference, if each change finds the plant settled",
}
CACHE = ROOT / "results" / "bounds"
PRICES = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)  # prices of travel on the frontier


@dataclass(frozen=True)
class LeastPossible(Estimate):
    """The least possible mean |e| of a case, degC, with a 95 % interval over drawn episodes.

    `value`, `low`, `high` and `runs` are those of `Estimate`; the ends equal `value` where
    nothing is drawn.
    """

    kind: str
    """One of `KINDS`."""
    idle: float
    """Mean |e| of the same episodes with the valve left alone, degC, and its interval."""
    idle_low: float
    idle_high: float
    episodes: tuple[float, ...]
    """Terms of the mean, degC; element i is for the episode of seed `seed + i`. For the kind
    "causal" only their mean is a bound."""
    seed: int
    """Seed of the first episode."""

    @property
    def holds_for(self) -> str:
        """The controllers that cannot do better."""
        return KINDS[self.kind]

    def score(self, errors: ArrayLike) -> Array:
        """Return scores: 0 for the mean error with the valve left alone, 1 for `value`.

        `errors` are mean |e| of runs, degC, of any shape; a single run may exceed 1 by chance.
        A ValueError is raised if nothing is better than leaving the valve alone.
        """
        room = self.idle - self.value
        if room <= 1e-9 * max(self.idle, 1.0):
            raise ValueError(f"there is nothing to gain: doing nothing gives {self.idle:g} °C")
        scores: Array = (self.idle - np.asarray(errors, dtype=np.float64)) / room
        return scores


def least_possible(
    *,
    samples: int,
    kind: str | None = None,
    episodes: int = EPISODES,
    seed: int = SEED,
    folder: Path | None = CACHE,
    **arguments: Any,
) -> LeastPossible:
    """Return the least possible mean |e(k)| over k = 1 to `samples`.

    Parameters
    ----------
    samples
        N, length of an episode.
    kind
        One of `KINDS`. None chooses as reports and `mptc_gym.evaluate` do: "causal" for random
        set points; otherwise "reference", or "preview" if a set point changes before the plant
        has settled, or if both are the same.
    episodes
        Number of episodes, if anything is drawn.
    seed
        Episode i is the one that the environment draws with seed `seed + i`. The defaults are
        the episodes of `mptc_gym.evaluate`.
    folder
        Folder in which the result is kept, under a name made from the arguments and the code.
        None: it is computed anew.
    **arguments
        Arguments of the environment.

    Raises
    ------
    ValueError
        If an argument is out of range; if the kind is "causal" and set points are not random;
        or if it is "reference" and a set point changes before the plant has settled.
    """
    parameters = Parameters(**arguments)
    for name, count in (("samples", samples), ("episodes", episodes)):
        if not isinstance(count, int) or count < 1:
            raise ValueError(f"{name} must be an integer of at least 1, got {count!r}")
    if kind is None and theorem(parameters) == "preview":
        case = {**arguments, "samples": samples, "episodes": episodes, "seed": seed}
        preview = least_possible(kind="preview", folder=folder, **case)
        with suppress(ValueError):  # the plant does not settle between changes
            unaware = least_possible(kind="reference", folder=folder, **case)
            # Foresight makes no difference where nothing changes.
            return unaware if abs(unaware.value - preview.value) >= 1e-4 else preview
        return preview
    kind = kind or "causal"
    if kind not in KINDS:
        raise ValueError(f"kind must be one of {', '.join(KINDS)}, got {kind!r}")
    if kind == "causal" and theorem(parameters) != "causal":
        raise ValueError(f'kind must not be "causal" for the set point {parameters.setpoint!r}')
    task = partial(_least_possible, parameters, samples, kind, episodes, seed)
    if folder is None:
        found = task()
    else:
        try:
            found = Kept(folder).load(task)
        except LookupError:
            found = task()
            Kept(folder).save(task, found)
    return LeastPossible(**{**found, "episodes": tuple(found["episodes"])})


def _least_possible(
    parameters: Parameters, samples: int, kind: str, episodes: int, seed: int
) -> dict[str, Any]:
    """Return the fields of `LeastPossible`."""
    cases, idle = _draw(parameters, samples, episodes, seed)
    # Rounded to be the same on every machine, as solvers differ in later digits.
    values = [round(best(kind).cost / samples, 6) for best in cases]
    least, left_alone = student(values), student(idle)
    alone = {"": left_alone.value, "_low": left_alone.low, "_high": left_alone.high}
    found = {**vars(least), **{f"idle{end}": value for end, value in alone.items()}}
    return {**found, "kind": kind, "episodes": values, "seed": seed}


def theorem(parameters: Parameters) -> str:
    """Return the kind of the highest proven bound; the reference may be beaten."""
    return "causal" if parameters.setpoint == "random" else "preview"


def frontier(
    *,
    samples: int,
    kind: str | None = None,
    prices: Sequence[float] = PRICES,
    episodes: int = 20,
    seed: int = SEED,
    **arguments: Any,
) -> list[tuple[float, float]]:
    """Return the least mean error for a given mean travel of the valve.

    For each price p of travel the program minimises mean error plus p times mean travel. No
    controller comes below its value, so none lies below the line error = value - p * travel.
    The points are where these lines touch their envelope; between two points the bound is the
    straight line, by convexity. The travel is that of the applied flow, which may jump over the
    dead zone: a mean of such flows travels no more than they do on average. The bound is loose
    where noise requires moves that the mean does not show.

    Prices are in degC times samples for each t/h; for the other arguments see `least_possible`.
    Returned are travel, t/h per sample (the sum of |u_a(k) - u_a(k-1)| divided by `samples`),
    and error, degC, by descending travel; the last point is a valve that does not move.
    """
    parameters = Parameters(**arguments)
    kind = kind or theorem(parameters)
    cases, idle = _draw(parameters, samples, episodes, seed)
    points = []
    for price in sorted(prices):
        plans = [best(kind, price) for best in cases]
        travel = float(np.mean([each.travel for each in plans])) / samples
        value = float(np.mean([each.cost for each in plans])) / samples
        points.append((travel, value - price * travel))
    return [*points, (0.0, float(np.mean(idle)))]


def _is_drawn(parameters: Parameters) -> bool:
    return bool(parameters.ranges) or parameters.setpoint == "random"


def is_random(parameters: Parameters) -> bool:
    """Return whether episodes differ in their errors, even if only by their noise."""
    noises = "noise_variance", "measurement_noise_variance"
    noisy = any(parameters.range_of(name)[1] > 0.0 for name in noises)
    return _is_drawn(parameters) or noisy or parameters.is_disturbed


def _draw(
    parameters: Parameters, samples: int, episodes: int, seed: int
) -> tuple[list[Callable[..., Plan]], Array]:
    """Return `_best` of the drawn episodes, and mean |e| with the valve left alone."""
    count = episodes if _is_drawn(parameters) else 1
    runs = episodes if is_random(parameters) else 1
    numbers = drawn_numbers(parameters, runs, seed)
    plants = make_plants(runs, samples + 1, **asdict(parameters))
    trajectory = rollout(plants, IdleValve(numbers.u_min, numbers.u_max), samples + 1, seed)
    plants.close()
    cases: list[Callable[..., Plan]] = []
    for i in range(count):
        of_plant, setpoint = numbers_of_plant(numbers, i), trajectory.setpoint[:, i].copy()
        longer = samples + 1 + int(of_plant.delay) + len(parameters.b) + TAIL
        along = time_varying_model(parameters, of_plant, longer)
        cases.append(partial(_best, parameters, along, unknown(along), setpoint))
    return cases, np.abs(trajectory.setpoint - trajectory.output)[1:].mean(axis=0)


def _best(
    parameters: Parameters,
    model: TimeVaryingModel,
    unknown: Unknown,
    setpoint: Array,
    kind: str,
    price: float = 0.0,
) -> Plan:
    """Return the best plan for a set point from k = 0 to N; the model goes on for a tail."""
    if kind == "reference":
        return reference(model, unknown, setpoint, price=max(price, SMOOTH))
    samples = len(setpoint)
    model, unknown = model.first(samples), unknown.of(0, samples)
    penalty = None
    if kind == "causal" and parameters.setpoint_amplitude > 0.0:
        penalty = SetPointLaw(parameters, model, unknown).penalty(setpoint)
    return plan(model, unknown, setpoint, price=price, penalty=penalty)
