"""Write the bounds that come with the package: `python -m benchmarks.limits --package`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.lib.fan_out import FanOut
from benchmarks.lib.fingerprint import fingerprint
from benchmarks.lib.storage import ROOT, commit, versions, write_json
from benchmarks.limits.bounds import least_possible
from mptc_gym import PRESETS
from mptc_gym.evaluation import EPISODES, SAMPLES, SEED

PLACE = ROOT / "mptc_gym" / "bounds.json"
MORE = 20  # episodes beyond those of a score, to choose policies by
CASES = PRESETS | {
    f"{name}, random set points": {**PRESETS[name], "setpoint": "random"}
    for name in ("paper", "disturbed", "fouling")  # of the data sets
}


def write(cache: Path, fan_out: FanOut, place: Path = PLACE) -> None:
    """Write the least possible error of each case, episode by episode where they differ."""
    case: dict[str, Any] = {"samples": SAMPLES, "seed": SEED, "episodes": EPISODES + MORE}
    tasks = {
        name: partial(_least, {**case, **arguments}, cache) for name, arguments in CASES.items()
    }
    found = fan_out.run(tasks, title="bounds")
    cases = {name: {"arguments": arguments, **found[name]} for name, arguments in CASES.items()}
    about = {
        "command": "python -m benchmarks.limits --package",
        "commit": commit(),
        "code": fingerprint("benchmarks.limits.bounds"),
        "versions": versions(),
        "unit": "degC, mean of |e(k)| over k = 1 to samples",
    }
    write_json(place, {**about, **case, "cases": cases})


def _least(case: dict[str, Any], cache: Path) -> dict[str, Any]:
    found = least_possible(folder=cache, **case)
    return {"kind": found.kind, "least": found.episodes}
