"""Identify and control TCLab's digital twin: `python -m benchmarks.identify.tclab_twin`."""

from benchmarks.lib.commands import command

main = command("identify.tclab_twin", interrupted="nothing is kept.")

if __name__ == "__main__":
    raise SystemExit(main(None))
