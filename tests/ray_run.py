"""Runs cells on the Ray cluster of RAY_ADDRESS; one kills its worker, another fails."""

import json
import sys
from functools import partial
from pathlib import Path

from ray import cloudpickle

from benchmarks.lib.fan_out import CellsFailedError, FanOut
from tests import cells

cloudpickle.register_pickle_by_value(cells)  # the tests do not travel

scratch = Path(sys.argv[1])
calls = scratch / "calls"
work = {f"plant {seed}": partial(cells.draw, seed, calls, 0.05) for seed in range(24)}
work["plant 9"] = partial(cells.die_once, 9, scratch / "died", calls)
fan_out = FanOut(backend="ray")
results = fan_out.run(work, scratch / "results", progress=False)
faulty = {"the fault": partial(cells.fail, 1), "plant 3": work["plant 3"]}
try:
    fan_out.run(faulty, scratch / "results", progress=False)
except CellsFailedError as error:
    out = {"results": results, "errors": error.errors, "jobs": fan_out.jobs}
    (scratch / "out.json").write_text(json.dumps(out))
