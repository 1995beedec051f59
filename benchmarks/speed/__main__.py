"""Measure the speed of the environments: `python -m benchmarks.speed --help`."""

from benchmarks.lib.commands import command

main = command("speed", width=130, interrupted="nothing is kept.")

if __name__ == "__main__":
    raise SystemExit(main(None))
