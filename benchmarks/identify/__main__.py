"""Identify a plant from a log and tune controllers: `python -m benchmarks.identify --help`."""

from benchmarks.lib.commands import command

main = command("identify", interrupted="nothing is written.")

if __name__ == "__main__":
    raise SystemExit(main(None))
