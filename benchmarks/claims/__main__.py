"""Judge the paper's claims: `python -m benchmarks.claims --help`."""

from dataclasses import dataclass, field
from functools import partial

from benchmarks.lib.command import Count, Folder, command, options
from benchmarks.lib.fan_out import FanOut, Task
from benchmarks.lib.outputs import new_folder, provenance_of
from benchmarks.lib.seeds import SEEDS

SEED = SEEDS["claims"].start  # seed of the random settings, and of the first run
RUNS = 20  # number of runs of each setting that is drawn
LEVEL_RUNS = 100  # number of runs of each named setting at a level other than `PAPER_LEVEL`


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Judge the paper's claims in many settings of the numbers that the paper leaves open.

    The shares of settings in which the claims hold are written to report.md, all settings with
    their numbers to claims.csv, and the errors of ten days of operation to life.csv.
    """

    draws: Count = 300
    """The number of random settings."""
    runs: Count = 1000
    """The number of runs of each of the two settings that have names."""
    days: Count = 10
    """The length of the continuous operation, days."""
    fan_out: FanOut = field(default_factory=FanOut)
    out: Folder = None


def work(options: Options) -> None:
    """Judge all claims, write the report, the tables and the pictures, and print the shares."""
    import pandas as pd

    from benchmarks.claims import conditions, life, pictures
    from benchmarks.claims.claims import judge
    from benchmarks.claims.settings import (
        NAMED_LEVELS,
        PAPER_LEVEL,
        Batch,
        draw_settings,
        named,
    )
    from benchmarks.claims.tables import sections
    from benchmarks.lib.sections import show, write_report

    provenance = provenance_of(seeds={"first": SEED, "draws": options.draws})
    folder = new_folder(options.out, "claims", provenance)
    settings = draw_settings(options.draws, SEED)
    paper_batch = Batch(named(), PAPER_LEVEL, options.runs, SEED)
    # The tasks that take longest start first.
    tasks: dict[str, Task] = {
        f"named, {PAPER_LEVEL:g}": partial(conditions.measure, paper_batch)
    }
    for plant in conditions.PLANTS:
        tasks[f"life, {plant}"] = partial(life.operate, plant, options.days, SEED)
    levels = sorted(set(settings["level"].tolist()))
    for level in levels:
        of_level = settings[settings["level"] == level]
        batch = Batch(of_level, level, RUNS, SEED + RUNS * int(of_level.index[0]))
        tasks[f"drawn, {level:g}"] = partial(conditions.measure, batch)
    for level in set(NAMED_LEVELS) - {PAPER_LEVEL}:
        batch = Batch(named(), level, LEVEL_RUNS, SEED)
        tasks[f"named, {level:g}"] = partial(conditions.measure, batch, is_complete=False)
    finished = options.fan_out.run(tasks, "claims")
    if finished.error:
        raise finished.error

    verdicts = pd.concat([judge(finished.results[f"drawn, {level:g}"]) for level in levels])
    draws = settings.join(verdicts.set_axis(settings.index))
    operation = pd.concat([finished.results[f"life, {plant}"] for plant in conditions.PLANTS])
    by_level = {level: finished.results[f"named, {level:g}"] for level in NAMED_LEVELS}
    report = sections(draws, by_level, life.summarise(operation))
    draws.to_csv(folder / "claims.csv", index_label="draw", float_format="%.4g")
    operation.to_csv(folder / "life.csv", index=False, float_format="%.4g")
    pictures.draw_figures(folder)
    pictures.draw_life(operation, folder / "life.png")
    write_report(folder, "The paper's claims", report, provenance)
    show(report[0])
    print(f"All criteria and pictures are in {folder}/report.md, all settings in claims.csv")


main = command("claims", Options, work)

if __name__ == "__main__":
    raise SystemExit(main())
