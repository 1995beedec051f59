"""Train the neural controllers: `python -m benchmarks.train --help`."""

from benchmarks.lib.commands import command

main = command("train", interrupted="the same command trains what is missing.")

if __name__ == "__main__":
    raise SystemExit(main(None))
