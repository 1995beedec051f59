"""Watch a controller at work, or take its place: `python -m benchmarks.watch --help`."""

from benchmarks.lib.commands import command

main = command("watch", interrupted="nothing is kept.")

if __name__ == "__main__":
    raise SystemExit(main(None))
