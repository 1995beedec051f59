"""Run every controller against its bound, an hour on one core: `python -m tests.verify_bounds`.

Nothing was tuned on these cases. The output is kept in benchmarks/published.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from benchmarks.bounds.least import LeastPossible, least_possible
from benchmarks.controllers.roster import ROSTER, Controller
from benchmarks.lib.statistics import student
from benchmarks.loop.linear import nominal
from benchmarks.loop.rollout import mean_error
from mptc_gym import PRESETS, Parameters
from mptc_gym.evaluation import SEED
from mptc_gym.plant import action_from_command

Array = NDArray[np.float64]

SAMPLES = 1200
ODD: dict[str, Any] = {"delay": 30, "u_min": -12.0, "u_max": 6.0, "dead_zone": 4.0}
CASES: dict[str, dict[str, Any]] = {
    **PRESETS,
    "constant": {"setpoint": 5.0},
    "constant, noise": {"setpoint": 5.0, "noise_variance": 0.5},
    **{
        f"square, held {period / 2:g}": {"setpoint_period": period}
        for period in (20, 38, 40, 76, 100, 152, 160, 200, 320)
    },
    "random": {"setpoint": "random"},
    "random, noise": {"setpoint": "random", "noise_variance": 0.5},
    "random, held 20 to 60": {"setpoint": "random", "setpoint_period": 120},
    "odd limits": {**ODD, "setpoint_amplitude": 3.0},
    "odd limits, random": {**ODD, "setpoint": "random", "setpoint_amplitude": 3.0},
    "odd limits, noise": {**ODD, "setpoint_amplitude": 3.0, "noise_variance": 0.5},
}


class Counting:
    """A controller that counts samples, and so knows when the square wave changes.

    On that wave it applies the flow that holds the set point d + 10 samples ahead.
    """

    def __init__(self, plant: Parameters, runs: int, seed: int) -> None:
        self._plant = plant
        self._gain = nominal(plant).gain
        self._limits = [np.mean(plant.range_of(name)) for name in ("u_min", "u_max")]

    def reset(self) -> None:
        """Restart the count."""
        self._k = self._plant.range_of("delay")[0] + 10

    def act(self, observation: Array) -> Array:
        """Return actions for observations, both with one row for each run."""
        level = np.asarray(observation, dtype=np.float64)[:, 0]
        if self._plant.setpoint == "square":
            period, amplitude = self._plant.setpoint_period, self._plant.setpoint_amplitude
            first_half = self._k % period < (period + 1) // 2
            level = np.full_like(level, amplitude if first_half else -amplitude)
        self._k += 1
        action: Array = action_from_command(level / self._gain, *self._limits)
        return action[:, np.newaxis]


def controllers() -> dict[str, Controller]:
    """Return factories by name: the roster's that need no training, and `Counting`."""
    known = {name: entry.members()[0] for name, entry in ROSTER.items()}
    return {**known, "counting": Controller("counting", "counting", ("", ""), Counting)}


def errors(factory: Controller, runs: int, samples: int, **arguments: Any) -> Array:
    """Return mean |e| of runs with seeds from `SEED` on, degC, shape (runs,)."""
    return mean_error(factory.run(arguments, samples, runs, SEED))


def beats(found: Array, least: LeastPossible) -> bool:
    """Return whether runs of the bound's episodes beat it.

    They do if the interval of the difference of their mean |e|, degC, from the bound lies below
    0. If the bound is the mean over as many episodes, each run is compared with its episode.
    """
    paired = len(least.episodes) == len(found)
    difference = found - (np.array(least.episodes) if paired else least.value)
    return student(difference).high < -1e-6 * least.value


def main(runs: int = 300) -> int:
    """Print the bound of each case and each controller's mean error, degC."""
    rows, beaten, factories = [], [], controllers()
    for name, arguments in CASES.items():
        kind = "causal" if arguments.get("setpoint") == "random" else "preview"
        least = least_possible(samples=SAMPLES, kind=kind, episodes=runs, **arguments)
        rows.append({"case": name, "bound": f"{least.value:.3f}", "kind": least.kind})
        for each, factory in factories.items():
            found = errors(factory, runs, SAMPLES, **arguments)
            rows[-1][each] = f"{found.mean():.3f}"
            beaten += [f"{each}: {name}"] if beats(found, least) else []
    print(pd.DataFrame(rows).to_string(index=False))
    print("Beaten beyond the interval:", ", ".join(beaten) or "no bound")
    return 1 if beaten else 0


if __name__ == "__main__":
    raise SystemExit(main())
