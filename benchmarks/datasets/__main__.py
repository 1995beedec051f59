"""Write offline data sets: `python -m benchmarks.datasets --help`."""

import sys

from benchmarks.lib.command_line import command

main = command("datasets")

if __name__ == "__main__":
    sys.exit(main(None))
