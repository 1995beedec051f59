"""Tune a controller's gains: `python -m benchmarks.tune --help`."""

from benchmarks.lib.commands import command

main = command("tune", interrupted="the same command goes on from here.")

if __name__ == "__main__":
    raise SystemExit(main(None))
