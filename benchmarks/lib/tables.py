"""The former names of what stands in `report`, `statistics` and `storage`."""

from __future__ import annotations

from benchmarks.lib import report
from benchmarks.lib.statistics import PERCENTILES, groups, percentiles
from benchmarks.lib.storage import write_csv

ScreenTable = report.on_screen
__all__ = ["PERCENTILES", "ScreenTable", "groups", "percentiles", "write_csv"]
