"""Compare the error of every controller with the bounds: `python -m tests.verify_bounds`.

No controller was tuned on the cases of this module. The command takes twenty minutes. The
output is in benchmarks/published/bounds_verified.txt.
"""

import numpy as np
import pandas as pd

from benchmarks.bounds import reference_error
from benchmarks.controllers.roster import ROSTER, ControllerSpec
from benchmarks.lib.sections import on_screen
from benchmarks.lib.statistics import student
from benchmarks.loop.measures import mean_error
from benchmarks.loop.scenarios import SCENARIOS
from mptc_gym import PRESETS
from mptc_gym.evaluation import SEED
from mptc_gym.plant.actuator import action_from_command
from mptc_gym.plant.parameters import EPISODE_STEPS

RUNS = 300
ODD = {"delay": 30, "u_min": -12.0, "u_max": 6.0, "dead_zone": 4.0, "setpoint_amplitude": 3.0}
RANDOM = {"setpoint": "random"}
NOISE = {"noise_variance": 0.5}
PERIODS = 20, 38, 40, 76, 100, 152, 160, 200, 320  # samples
SQUARE_WAVES = {
    f"square, held {period / 2:g}": {"setpoint_period": period} for period in PERIODS
}
CASES = {
    **PRESETS,
    "constant": {"setpoint": 5.0},
    "constant, noise": {"setpoint": 5.0, **NOISE},
    "constant, load": SCENARIOS["load"].arguments,
    **SQUARE_WAVES,
    "random": RANDOM,
    "random, noise": {**RANDOM, **NOISE},
    "random, held 20 to 60": {**RANDOM, "setpoint_period": 120},
    "odd limits": ODD,
    "odd limits, random": {**ODD, **RANDOM},
    "odd limits, noise": {**ODD, **NOISE},
}


class Counting:
    """A controller that knows when a square wave changes.

    The flow at sample k is the flow that holds the set point of the sample k + d + 10, where d
    is the delay. If the set point is no square wave, the flow holds the present set point.
    """

    def __init__(self, plant, runs, seed):
        self.plant = plant.parameters
        self.gain = plant.gain
        self.limits = [np.mean(self.plant.range_of(name)) for name in ("u_min", "u_max")]

    def reset(self):
        self.k = self.plant.range_of("delay")[0] + 10

    def act(self, observation):
        level = np.asarray(observation, np.float64)[:, :1]
        if self.plant.setpoint == "square":
            period, amplitude = self.plant.setpoint_period, self.plant.setpoint_amplitude
            is_high = self.k % period < (period + 1) // 2
            level = np.full_like(level, amplitude if is_high else -amplitude)
        self.k += 1
        return action_from_command(level / self.gain, *self.limits)


COUNTING = ControllerSpec(name="counting", label="counting", group="own", make=Counting)
CONTROLLERS = {name: spec.members()[0] for name, spec in ROSTER.items()}
CONTROLLERS["counting"] = COUNTING


def errors(controller, runs, samples, **arguments):
    """Return the mean |e| of runs with the seeds from `SEED` on, degC, shape (runs,)."""
    return mean_error(controller.run(arguments, samples, runs, SEED))


def beats(run_errors, reference):
    """Return whether the mean errors of runs, degC, shape (runs,), are smaller than a bound.

    The errors are smaller if the confidence interval of the difference from the bound lies
    below 0. If each episode has its own bound, each run is compared with the bound of its
    episode.
    """
    bounds = np.full(len(run_errors), reference.value)
    if len(reference.episodes) == len(run_errors):
        bounds = np.array(reference.episodes)
    return student(run_errors - bounds).high < -1e-6 * reference.value


def main(runs=RUNS):
    """Print the bound of each case and each controller's mean error, degC."""
    rows = []
    beaten = []
    for case, arguments in CASES.items():
        kind = "causal" if arguments.get("setpoint") == "random" else "preview"
        reference = reference_error(
            samples=EPISODE_STEPS, kind=kind, episodes=runs, **arguments
        )
        row = {"case": case, "bound": f"{reference.value:.3f}", "kind": reference.kind}
        for name, controller in CONTROLLERS.items():
            run_errors = errors(controller, runs, EPISODE_STEPS, **arguments)
            row[name] = f"{run_errors.mean():.3f}"
            if beats(run_errors, reference):
                beaten.append(f"{name}: {case}")
        rows.append(row)
    print(on_screen(pd.DataFrame(rows)))
    print("Beaten beyond the interval:", ", ".join(beaten) or "no bound")
    return 1 if beaten else 0


if __name__ == "__main__":
    raise SystemExit(main())
