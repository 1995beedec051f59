"""Test the paper's claims: `python -m benchmarks.claims --help`."""

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.lib.command import Folder, Names, Runs, command, known, options
from benchmarks.lib.parallel import FanOut
from benchmarks.lib.provenance import origin
from benchmarks.lib.results import results_folder
from benchmarks.lib.storage import write_csv


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Test the paper's claims, each on a thousand runs.

    The verdicts on the claims are written to report.md, and all numbers to claims.csv.
    """

    claims: Names = field(default=(), kw_only=False)
    """Claims to test (default: all)."""
    runs: Runs = 1000
    """The number of runs of each case."""
    fan_out: FanOut = field(default_factory=FanOut)
    out: Folder = Path("results/claims")


def work(options: Options) -> str:
    """Test claims of the paper, write a report, and return a message with its path.

    If the test of a claim raises an error, the report on the finished tests is written before
    the error is raised again.
    """
    from benchmarks.claims.claims import CLAIMS, examined
    from benchmarks.claims.findings import sections, table
    from benchmarks.claims.runs import Batch
    from benchmarks.lib.report import write_report

    names = known("CLAIM", options.claims or list(CLAIMS), list(CLAIMS))
    provenance = origin()
    # The tests of the last claims take longest, so these tests start first.
    tasks = {name: partial(examined, name, Batch(options.runs)) for name in reversed(names)}
    findings: dict[str, Any] = {}
    with results_folder(options.out) as folder:
        try:
            findings.update(options.fan_out.stream(tasks, "claims"))
        finally:
            missing = len(tasks) - len(findings)
            if missing:
                provenance["missing"] = f"{missing} of {len(tasks)} claims are missing"
            if findings:
                in_order = {name: findings[name] for name in names if name in findings}
                numbers = table(CLAIMS, in_order)
                report = sections(CLAIMS, numbers)
                write_csv(folder / "claims.csv", numbers)
                write_report(folder, "The paper's claims", report, provenance, printed=1)
    return f"All numbers are in {options.out}/report.md and claims.csv"


main = command("claims", Options, work)

if __name__ == "__main__":
    raise SystemExit(main(None))
