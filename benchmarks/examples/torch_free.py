"""Score the paper's network and its PI controller, with Gymnasium and NumPy alone.

`python -m benchmarks.examples.torch_free` prints their mean errors over 100 episodes, as
multiples of the least possible error. Another id can be given, such as `MiddlePointNoisy-v0`.
"""

from __future__ import annotations

import argparse

from agents import DirectNNController, PIController
from mptc_gym import IDS, evaluate


def main(arguments: list[str] | None = None) -> None:
    """Score both controllers; `arguments` is the command line without the program's name."""
    parser = argparse.ArgumentParser(description="The paper's controllers, scored.")
    parser.add_argument("env", nargs="?", default="MiddlePoint-v0", choices=IDS.values())
    env = parser.parse_args(arguments).env
    print("NN:", evaluate(DirectNNController(num_envs=100), env))  # one network per episode
    print("PI:", evaluate(PIController(), env))


if __name__ == "__main__":
    main()
