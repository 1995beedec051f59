"""Name a saved result after everything that shapes it, and nothing else.

A trained policy or a swept task is shaped by its arguments, its code and the environment. The
code is every module of the checkout that is imported, directly or not, without comments and
docstrings. The environment is represented by its behaviour, a set of trajectories. An edited
comment thus keeps a result valid, and a moved function cannot leave a stale one in use.
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

SAMPLES = 60  # length of each trajectory


def fingerprint(*modules: str, **shaped_by: Any) -> str:
    """Return sixteen hexadecimal digits that identify the result of modules.

    Their imports count too. `shaped_by` holds everything else that matters, as JSON values.
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
    """Return a hash of the environment's behaviour: a trajectory of each preset."""
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
    """Return the names of a module and of all modules of the checkout that it depends on."""
    finder: Any = ModuleFinder([str(ROOT)], excludes=["mptc_gym"])
    with suppress(ImportError):  # a user's own controller may be elsewhere
        finder.import_hook(module)
    return {name for name, found in finder.modules.items() if found.__file__}


@cache
def code(module: str) -> str:
    """Return a hash of a module's code, which ignores comments, docstrings and layout."""
    path = ROOT.joinpath(*module.split("."))
    file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    tree = _WithoutTexts().visit(ast.parse(file.read_text(encoding="utf-8")))
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()


class _WithoutTexts(ast.NodeTransformer):
    """Removes docstrings, those below the fields of a dataclass included."""

    def visit_Expr(self, node: ast.Expr) -> ast.Expr | None:
        """Drop a text that stands alone."""
        is_text = isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        return None if is_text else node
