"""Print the least possible mean error: `python -m benchmarks.bounds --help`."""

from benchmarks.lib.commands import command

main = command("bounds", width=180, interrupted="bounds that are known are kept.")

if __name__ == "__main__":
    raise SystemExit(main(None))
