"""Train with default settings: `python -m benchmarks.train.defaults --help`."""

import sys

from benchmarks.lib.command_line import runner

main = runner("train.defaults")

if __name__ == "__main__":
    sys.exit(main(None))
