"""Write the bounds that come with the package: `python -m benchmarks.limits --package`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tqdm import tqdm

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


def write(cache: Path, place: Path = PLACE) -> None:
    """Write the least possible error of each case, episode by episode where they differ.

    Parameters
    ----------
    cache
        Where bounds are kept once they are known.
    place
        The file.
    """
    case: dict[str, Any] = {"samples": SAMPLES, "seed": SEED, "episodes": EPISODES + MORE}
    cases = {}
    for name, arguments in tqdm(CASES.items(), unit="case"):
        found = least_possible(folder=cache, **case, **arguments)
        cases[name] = {"arguments": arguments, "kind": found.kind, "least": found.episodes}
    about = {
        "command": "python -m benchmarks.limits --package",
        "commit": commit(),
        "code": fingerprint("benchmarks.limits.bounds"),
        "versions": versions(),
        "unit": "degC, mean of |e(k)| over k = 1 to samples",
    }
    write_json(place, {**about, **case, "cases": cases})
