"""Write offline data sets: `python -m benchmarks.datasets --help`."""

from benchmarks.lib.commands import command

main = command("datasets")

if __name__ == "__main__":
    raise SystemExit(main(None))
