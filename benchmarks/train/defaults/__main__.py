"""Train with default settings: `python -m benchmarks.train.defaults --help`."""

import sys

from benchmarks.lib.commands import command

main = command("train.defaults")

if __name__ == "__main__":
    sys.exit(main(None))
