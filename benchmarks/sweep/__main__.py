"""Run controllers on other plants: `python -m benchmarks.sweep --help`."""

from benchmarks.lib.commands import command

main = command(
    "sweep", width=150, interrupted="what has finished is kept, and the next call goes on."
)

if __name__ == "__main__":
    raise SystemExit(main(None))
