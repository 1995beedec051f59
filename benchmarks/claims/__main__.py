"""The paper's claims, each tested on a thousand runs: `python -m benchmarks.claims`.

The verdicts go to `claims.md` and all numbers to `claims.csv`; what is drawn lies beside them.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from rich.console import Console
from tqdm import tqdm

from benchmarks.claims import verdicts
from benchmarks.claims.claims import CLAIMS
from benchmarks.claims.plots import PLOTS
from benchmarks.claims.runs import Batch
from benchmarks.lib import command_line
from benchmarks.lib.storage import write_text
from benchmarks.lib.tables import on_screen, write_csv

RUNS = 1000
SEED = 0  # run i starts from the weights, and meets the noise, of seed SEED + i


def _add_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("claims", nargs="*", default=list(CLAIMS), metavar="CLAIM",
        help="which claims to test")  # fmt: skip
    add("--runs", type=command_line.number, default=RUNS, metavar="N", help="runs of each case")
    command_line.add_out(parser, "results/claims")


@command_line.command(
    "claims", __doc__, _add_options, interrupted="the claims that are done are kept."
)
def main(options: argparse.Namespace, console: Console) -> str:
    """Examine the claims and write the verdicts."""
    chosen = command_line.known("CLAIM", options.claims, list(CLAIMS))
    called = f"python -m benchmarks.claims --runs {options.runs}"
    command_line.out_folder(options.out)
    batch = Batch(options.runs, SEED)
    entries: list[verdicts.Entry] = []
    try:
        with tqdm(chosen, unit="claim") as bar:
            for name in bar:
                bar.set_description(name)
                results = CLAIMS[name].examine(batch)
                entries.append(CLAIMS[name].entry(results))
                write(options.out, entries, results.tables, called)
    finally:
        if entries:
            overview = verdicts.overview(entries)
            console.print(on_screen(overview[["claim", "verdict"]]))
    return f"All numbers are in {options.out}/claims.md and claims.csv"


def write(
    out: Path, entries: Sequence[verdicts.Entry], tables: dict[str, pd.DataFrame], called: str
) -> None:
    """Write the verdicts so far, and the tables and pictures of the latest claim."""
    write_csv(out / "claims.csv", verdicts.table(entries))
    write_text(out / "claims.md", verdicts.markdown(entries, called))
    for name, table in tables.items():
        write_csv(out / f"{name}.csv", table)
        PLOTS[name](table, out / f"{name}.png")


if __name__ == "__main__":
    sys.exit(main(None))
