"""Run every controller against its bound: `python -m tests.verify_bounds`, twenty minutes.

Nothing was tuned on these cases. The output is kept in benchmarks/published.
"""

import numpy as np
import pandas as pd

from benchmarks.bounds.least import least_possible
from benchmarks.controllers.roster import ROSTER
from benchmarks.controllers.spec import EVERYTHING, ControllerSpec
from benchmarks.lib.report import on_screen
from benchmarks.lib.statistics import student
from benchmarks.loop.linear import nominal
from benchmarks.loop.rollout import mean_error
from benchmarks.loop.scenarios import SCENARIOS
from mptc_gym import PRESETS
from mptc_gym.evaluation import SEED
from mptc_gym.plant import action_from_command

SAMPLES = 1200
ODD = {"delay": 30, "u_min": -12.0, "u_max": 6.0, "dead_zone": 4.0, "setpoint_amplitude": 3.0}
RANDOM, NOISE = {"setpoint": "random"}, {"noise_variance": 0.5}
PERIODS = 20, 38, 40, 76, 100, 152, 160, 200, 320
CASES = {
    **PRESETS,
    "constant": {"setpoint": 5.0},
    "constant, noise": {"setpoint": 5.0, **NOISE},
    "constant, load": SCENARIOS["load"].arguments,
    **{f"square, held {each / 2:g}": {"setpoint_period": each} for each in PERIODS},
    "random": RANDOM,
    "random, noise": {**RANDOM, **NOISE},
    "random, held 20 to 60": {**RANDOM, "setpoint_period": 120},
    "odd limits": ODD,
    "odd limits, random": {**ODD, **RANDOM},
    "odd limits, noise": {**ODD, **NOISE},
}


class Counting:
    """Apply the flow that holds the set point, of the square wave d + 10 samples ahead."""

    def __init__(self, parameters, **_):
        self.plant, self.gain = parameters, nominal(parameters).gain
        self.limits = [np.mean(parameters.range_of(name)) for name in ("u_min", "u_max")]

    def reset(self):
        self.k = self.plant.range_of("delay")[0] + 10

    def act(self, observation):
        level = np.asarray(observation, np.float64)[:, :1]
        if self.plant.setpoint == "square":
            period, amplitude = self.plant.setpoint_period, self.plant.setpoint_amplitude
            high = self.k % period < (period + 1) // 2
            level = np.full_like(level, amplitude if high else -amplitude)
        self.k += 1
        return action_from_command(level / self.gain, *self.limits)


CONTROLLERS = {name: entry.members()[0] for name, entry in ROSTER.items()} | {
    "counting": ControllerSpec(
        name="counting",
        label="counting",
        look=("", ""),
        build=Counting,
        prior_knowledge=EVERYTHING,
    )
}


def errors(factory, runs, samples, **arguments):
    """Return mean |e| of runs with seeds from `SEED` on, degC, shape (runs,)."""
    return mean_error(factory.run(arguments, samples, runs, SEED))


def beats(found, least):
    """Return whether runs of the bound's episodes beat it.

    They do if the interval of the difference from it lies below 0; of its own episodes, each is
    compared with its own bound.
    """
    paired = len(least.episodes) == len(found)
    difference = found - (np.array(least.episodes) if paired else least.value)
    return student(difference).high < -1e-6 * least.value


def main(runs=300):
    """Print the bound of each case and each controller's mean error, degC."""
    rows, beaten = [], []
    for name, arguments in CASES.items():
        kind = "causal" if arguments.get("setpoint") == "random" else "preview"
        least = least_possible(samples=SAMPLES, kind=kind, episodes=runs, **arguments)
        rows.append({"case": name, "bound": f"{least.value:.3f}", "kind": least.kind})
        for each, factory in CONTROLLERS.items():
            found = errors(factory, runs, SAMPLES, **arguments)
            rows[-1][each] = f"{found.mean():.3f}"
            beaten += [f"{each}: {name}"] if beats(found, least) else []
    print(on_screen(pd.DataFrame(rows)))
    print("Beaten beyond the interval:", ", ".join(beaten) or "no bound")
    return 1 if beaten else 0


if __name__ == "__main__":
    raise SystemExit(main())
