"""Trains small networks on a Ray cluster, below the folder that is the argument."""

import sys
from dataclasses import replace
from pathlib import Path

from benchmarks.lib.fan_out import FanOut
from benchmarks.train.__main__ import run
from benchmarks.train.through_plant import Training

SMALL = Training(steps=6, batch=4, samples=60, window=20, hidden=4, validate_every=2)
TRAININGS = [replace(SMALL, seed=seed) for seed in range(3)]

if __name__ == "__main__":
    run(TRAININGS, Path(sys.argv[1]), FanOut(backend="ray"))
