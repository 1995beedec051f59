"""Identify a plant from a log and tune a PI for it: `python -m benchmarks.identify --help`."""

from __future__ import annotations

import os

from benchmarks.identify.options import Options
from benchmarks.lib.command import command

# NumPy reads it when it is imported. Threads for small matrices only wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def work(options: Options) -> str:
    """Identify a plant from a log and write the results."""
    from benchmarks.identify.report import execute  # slow to import

    return execute(options)


main = command("identify", Options, work, interrupted="nothing is written.")

if __name__ == "__main__":
    raise SystemExit(main(None))
