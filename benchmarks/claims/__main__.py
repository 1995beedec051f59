"""Test the paper's claims: `python -m benchmarks.claims --help`."""

from benchmarks.lib.commands import command

main = command("claims", interrupted="the claims that are done are kept.")

if __name__ == "__main__":
    raise SystemExit(main(None))
