"""Identify known plants from synthetic logs: `python -m benchmarks.identify.study`."""

from benchmarks.lib.commands import command

main = command(
    "identify.study", interrupted="what has finished is kept, and the next call goes on."
)

if __name__ == "__main__":
    raise SystemExit(main(None))
