"""Name a kept result after all that shapes it, and nothing else.

Three things shape a trained policy or a swept task: its arguments, the code that runs, and the
environment. Code is every module of the checkout that the code imports, directly or not,
without comments and docstrings. Of the environment it is what it does: trajectories. So an
edited comment keeps a result, and a moved function cannot leave a stale one in use.
"""

from __future__ import annotations

import ast
import hashlib
import json
from contextlib import suppress
from functools import cache
from modulefinder import ModuleFinder
from typing import Any

import gymnasium
import numpy as np

import mptc_gym
from benchmarks.lib.storage import ROOT, versions

SAMPLES = 60  # of each trajectory
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def fingerprint(*modules: str, **shaped_by: Any) -> str:
    """Return sixteen hexadecimal digits that name what modules compute.

    What they import counts, too, and all else that shapes the result, in a form for JSON.
    """
    everything = {
        **shaped_by,
        "code": sorted({code(name) for module in modules for name in imported(module)}),
        "environment": behaviour(),
        "versions": versions(),
    }
    return hashlib.sha256(json.dumps(everything, sort_keys=True).encode()).hexdigest()[:16]


@cache
def behaviour() -> str:
    """Return a hash of what the environment does: of a trajectory of each preset."""
    digest = hashlib.sha256()
    for name, arguments in sorted(mptc_gym.PRESETS.items()):
        windowed: dict[str, Any] = {**arguments, "output_window": 2, "action_window": 3}
        plants = gymnasium.make_vec("MiddlePoint-v0", 2, **windowed)
        actions = np.random.default_rng(0).uniform(-1.2, 1.2, (SAMPLES, 2, 1))
        digest.update(name.encode())
        observation, _ = plants.reset(seed=0)
        digest.update(observation.tobytes())
        for action in actions.astype(np.float32):
            observation, reward, *_ = plants.step(action)
            digest.update(observation.tobytes() + np.asarray(reward).tobytes())
        plants.close()
    return digest.hexdigest()


@cache
def imported(module: str) -> set[str]:
    """Return a module's name and those that it imports of the checkout, directly or not."""
    finder: Any = ModuleFinder([str(ROOT)], excludes=["mptc_gym"])
    with suppress(ImportError):  # a controller of one's own may lie elsewhere
        finder.import_hook(module)
    return {name for name, found in finder.modules.items() if found.__file__}


@cache
def code(module: str) -> str:
    """Return a hash of a module's code without comments, docstrings and layout."""
    path = ROOT.joinpath(*module.split("."))
    file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    tree = ast.parse(file.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node) is not None:
            del node.body[0]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()
