"""Compare controllers in the same noise: `python -m benchmarks.compare --help`."""

from benchmarks.lib.commands import command

main = command("compare", width=190)

if __name__ == "__main__":
    raise SystemExit(main(None))
