"""Print the least possible mean error: `python -m benchmarks.limits --help`."""

from benchmarks.lib.commands import command

main = command("limits", width=180, interrupted="bounds that are known are kept.")

if __name__ == "__main__":
    raise SystemExit(main(None))
