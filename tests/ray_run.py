"""Runs tasks on the Ray cluster of RAY_ADDRESS; one kills its worker, another fails."""

import json
import os
import sys
from functools import partial
from pathlib import Path

from ray import cloudpickle

from benchmarks.lib.fan_out import FanOut, TasksFailedError
from tests import tasks

cloudpickle.register_pickle_by_value(tasks)  # the tests do not travel

scratch = Path(sys.argv[1])
calls = scratch / "calls"
work = {f"plant {seed}": partial(tasks.draw, seed, calls, 0.05) for seed in range(24)}
work["plant 9"] = partial(tasks.die_once, 9, scratch / "died", calls)
fan_out = FanOut(backend="ray")
results = fan_out.run(work, scratch / "results")
faulty = {"the fault": partial(tasks.fail, 1), "plant 3": work["plant 3"]}
try:
    fan_out.run(faulty, scratch / "results")
except TasksFailedError as error:
    there = fan_out.run({"there": os.listdir})["there"]
    out = {"results": results, "errors": error.errors, "there": there}
    (scratch / "out.json").write_text(json.dumps(out))
