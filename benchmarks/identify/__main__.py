"""Identify a plant from a log and tune controllers: `python -m benchmarks.identify --help`."""

import os

# NumPy reads it when it is imported. Threads for small matrices only wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from benchmarks.lib.commands import command

main = command("identify", interrupted="nothing is written.")

if __name__ == "__main__":
    raise SystemExit(main(None))
