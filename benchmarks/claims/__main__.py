"""Test the paper's claims: `python -m benchmarks.claims --help`."""

from dataclasses import dataclass, field
from functools import partial

from benchmarks.lib.command import Count, Folder, Names, choose, command, options
from benchmarks.lib.fan_out import FanOut
from benchmarks.lib.outputs import new_folder, provenance_of


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Test the paper's claims, each on a thousand runs.

    The verdicts on the claims are written to report.md, and all numbers to claims.csv.
    """

    claims: Names = field(default=(), kw_only=False)
    """Claims to test (default: all)."""
    runs: Count = 1000
    """The number of runs of each case."""
    fan_out: FanOut = field(default_factory=FanOut)
    out: Folder = None


def work(options: Options) -> None:
    """Test claims of the paper, write a report on those that could be tested, and print it."""
    from benchmarks.claims.claims import CLAIMS, examined
    from benchmarks.claims.findings import sections, table
    from benchmarks.claims.runs import Batch
    from benchmarks.lib.sections import show, write_report

    chosen = choose("CLAIM", options.claims or list(CLAIMS), CLAIMS)
    batch = Batch(options.runs)
    provenance = provenance_of(seeds={"first": batch.seed, "runs": batch.runs})
    folder = new_folder(options.out, "claims", provenance)
    # The tests of the last claims take longest, so these tests start first.
    tasks = {name: partial(examined, name, batch) for name in reversed(chosen)}
    finished = options.fan_out.run(tasks, "claims")
    numbers = table(CLAIMS, dict(reversed(finished.results.items())))
    report = sections(CLAIMS, numbers)
    numbers.to_csv(folder / "claims.csv", index=False)
    write_report(folder, "The paper's claims", report, provenance, finished.error)
    show(report[0])
    print(f"All numbers are in {folder}/report.md and claims.csv")
    if finished.error:
        raise finished.error


main = command("claims", Options, work)

if __name__ == "__main__":
    raise SystemExit(main())
