"""Draw counterparts of the paper's figures: `python -m benchmarks.figures --help`."""

from benchmarks.lib.commands import command

main = command("figures", interrupted="the figures that are done are kept.")

if __name__ == "__main__":
    raise SystemExit(main(None))
