"""Identify a plant from a log and tune controllers: `python -m benchmarks.identify --help`."""

import os

# NumPy reads it when it is imported. Threads for small matrices only wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from benchmarks.identify.options import Options
from benchmarks.lib.command import command

main = command(Options, "benchmarks.identify.command", interrupted="nothing is written.")

if __name__ == "__main__":
    raise SystemExit(main(None))
