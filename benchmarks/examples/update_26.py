"""Compare the paper's update (27) of the network with one that equation (26) might suggest.

Equation (26) multiplies the present error by the activations d + 1 = 19 samples before, from
which the present temperature results: `python -m benchmarks.examples.update_26`.
"""

from collections import deque
from typing import Any

import numpy as np

from agents import DirectNNController
from benchmarks.loop.measures import mean_error
from benchmarks.loop.runs import make_plants, simulate
from mptc_gym.plant.parameters import EPISODE_STEPS

RUNS = 100
MULTIPLES = 0.01, 0.03, 0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 3.0  # of the learning rates


class DelayedUpdate(DirectNNController):
    """The paper's network, which learns from the inputs 19 samples before."""

    def _control(self, rows: Any) -> Any:
        """Return the commands u(k), and update the weights by equation (26)."""
        if self._sample == 0:
            # The present inputs and those of the 19 samples before. Element 0 has the oldest,
            # which are those of sample 0 until sample 19.
            self._past: deque[Any] = deque(maxlen=20)
            self.error_index = self.n_inputs  # The present error follows the inputs.
        inputs = rows[:, : self.n_inputs]
        error = rows[:, 3:4]  # e(k), which follows three set points in an observation
        self._past.append(inputs)
        self.learning = False
        u = super()._control(np.hstack([inputs, error]))
        self.learning = True
        super()._control(np.hstack([self._past[0], error]))  # for its update alone
        return u


def main() -> None:
    """Print the median over the runs of the mean error on the square wave, for both updates."""
    print("multiple   (27)     (26)")
    paper = DirectNNController()
    for multiple in MULTIPLES:
        rates = {
            name: multiple * getattr(paper, name)
            for name in ("eta", "eta_1", "eta_theta", "eta_1_theta")
        }
        errors = []  # of the update (27), and of the update (26)
        for kind in (DirectNNController, DelayedUpdate):
            networks = kind(num_envs=RUNS, **rates)
            plants = make_plants(RUNS, EPISODE_STEPS)
            errors.append(np.median(mean_error(simulate(plants, networks, EPISODE_STEPS, 0))))
        print(f"{multiple:8g}   {errors[0]:.3f}    {errors[1]:.3f}")


if __name__ == "__main__":
    main()
