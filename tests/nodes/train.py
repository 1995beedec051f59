"""Trains small networks on a Ray cluster, below the folder that is the argument."""

import sys
from dataclasses import replace
from pathlib import Path

from benchmarks.lib.fan_out import FanOut
from benchmarks.train.command import trained
from benchmarks.train.through_plant import Training

SMALL = Training(steps=3, plants=4, samples=60, choosing=4, adding=3)
TRAININGS = [replace(SMALL, seed=1)]

if __name__ == "__main__":
    trained(TRAININGS, Path(sys.argv[1]), FanOut(backend="ray"), here=False)
