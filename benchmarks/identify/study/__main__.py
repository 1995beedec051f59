"""Identify known plants from synthetic logs: `python -m benchmarks.identify.study`."""

from benchmarks.identify.study.options import Options
from benchmarks.lib.command import command

main = command(Options, "benchmarks.identify.study.command")

if __name__ == "__main__":
    raise SystemExit(main(None))
