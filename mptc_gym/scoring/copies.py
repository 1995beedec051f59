"""Copy environments layer by layer, so that a policy can act in a copy.

A layer is one environment object in a nesting: a wrapper, a vector environment or an innermost
environment. `copy.deepcopy` alone is not enough: this function fails for files and for most
wrappers of Stable-Baselines3, loses what a `VecNormalize` wraps, and closes the pipes of
environments in other processes.
"""

from __future__ import annotations

import copy
import copyreg
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import connection
from typing import Any, Final, NoReturn

from gymnasium.vector import VectorEnv

from mptc_gym.environments.layers import (
    INNER,
    VEC_ENV,
    inner_environments,
    layers,
    loaded,
    runs_processes,
)

# The classes of layers that record episodes and change neither observations nor actions: a copy
# of an environment is made without these layers.
_RECORDERS: Final = (
    "gymnasium.wrappers.RecordVideo",
    "gymnasium.wrappers.vector.RecordVideo",
    "minari.DataCollector",
    f"{VEC_ENV}.VecVideoRecorder",
)
# The classes of the ends of pipes; on Windows, some ends are of a class that other systems
# lack.
_PIPES: Final[tuple[Any, ...]] = (
    connection.Connection,
    getattr(connection, "PipeConnection", connection.Connection),
)


class Copy:
    """A copy of an environment and all environments within, also in mid-episode.

    The original environment stays as it is. The copy writes to no file of the original, and
    closes nothing. Layers that run in other processes, show a window, hold a pipe, or cannot be
    copied for another reason are not copied: copy and original share these layers.

    Parameters
    ----------
    env
        An environment of any kind.

    Attributes
    ----------
    env : environment
        The copy.
    shared : dict of int to environment
        The layers that copy and original share, by Python's `id` of the layer.
    reason : str
        Why a layer cannot be copied; "" if all layers were copied.
    """

    def __init__(self, env: Any) -> None:
        self.shared: dict[int, Any] = {}
        self.reason = ""
        self._memo: dict[int, Any] = {}  # of `copy.deepcopy`: copies by the `id` of originals
        with _pipes_refused():
            self.env = self._copy(env)

    def _copy(self, layer: Any) -> Any:
        """Return a copy of a layer and its inner layers, or the layer if that is impossible."""
        if id(layer) in self._memo:
            return self._memo[id(layer)]
        for inner in inner_environments(layer):
            self._copy(inner)
        reason = _why_not(layer)
        if not reason:
            memo_before = dict(self._memo)
            try:
                return _copy_layer(layer, self._memo)
            except Exception as error:  # whatever a layer of another package raises
                reason = f"{type(layer).__name__} cannot be copied: {error}"
                self._memo.clear()  # forget the parts of the copy that failed
                self._memo.update(memo_before)
        self.reason = reason
        for original in layers(layer):
            self.shared[id(original)] = original
            self._memo[id(original)] = original
        return layer


@contextmanager
def _pipes_refused() -> Iterator[None]:
    """Return a context in which copying the end of a pipe raises a TypeError.

    Without the context, the copy of a pipe closes the original pipe when the copy is deleted.
    """
    before = dict(copyreg.dispatch_table)
    for pipe in _PIPES:
        copyreg.pickle(pipe, _refuse_pipe)
    try:
        yield
    finally:
        for pipe in set(_PIPES):
            del copyreg.dispatch_table[pipe]
        copyreg.dispatch_table.update(before)


def _refuse_pipe(_: Any) -> NoReturn:
    """Raise a TypeError, in place of copying the end of a pipe."""
    raise TypeError("a pipe to another process cannot be copied")


def _why_not(layer: Any) -> str:
    """Return why an environment or wrapper must not be copied; "" if a copy may be tried."""
    name = type(layer).__name__
    if runs_processes(layer):
        return f"{name} runs in other processes"
    inner = inner_environments(layer)
    inner_modes = [getattr(environment, "render_mode", None) for environment in inner]
    # A wrapper around an environment that shows a window also has the render mode "human".
    if getattr(layer, "render_mode", None) == "human" and "human" not in inner_modes:
        return f"{name} shows a window"
    return ""


def _copy_layer(layer: Any, memo: dict[int, Any]) -> Any:
    """Return a copy of a layer whose inner layers have been copied before.

    `memo` holds the copies so far by the `id` of the originals, as for `copy.deepcopy`. If the
    layer only records episodes, the copy of the layer within it is returned.
    """
    if isinstance(layer, tuple(map(loaded, _RECORDERS))):
        (inner,) = inner_environments(layer)
        memo[id(layer)] = memo[id(inner)]
        return memo[id(layer)]
    if not inner_environments(layer):
        duplicate = copy.deepcopy(layer, memo)
    else:
        # Wrappers define how they are pickled, but a pickled VecNormalize loses what it wraps.
        duplicate = object.__new__(type(layer))
        memo[id(layer)] = duplicate
        attributes = dict(vars(layer))
        if "results_writer" in attributes:
            attributes["results_writer"] = None  # so that a copy of a monitor writes no file
        if "class_attributes" in attributes:  # of a VecEnvWrapper, shared by its class
            memo[id(layer.class_attributes)] = layer.class_attributes
        for name in INNER:  # first, as a wrapper looks up other attributes in what it wraps
            if name in attributes:
                vars(duplicate)[name] = copy.deepcopy(attributes[name], memo)
        for name, value in attributes.items():
            vars(duplicate)[name] = copy.deepcopy(value, memo)
    if isinstance(duplicate, VectorEnv):
        duplicate.closed = True  # so that a deleted copy closes nothing
    return duplicate
