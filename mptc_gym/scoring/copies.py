"""Copy environments layer by layer, so that a policy can act in a copy.

A layer is one environment object in a nesting: a wrapper, a vector environment or an innermost
environment. `copy.deepcopy` alone is not enough: `deepcopy` fails for files and for most
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

# The classes of wrappers that record episodes and change neither observations nor actions: the
# copy of an environment is without these wrappers.
_RECORDERS: Final = (
    "gymnasium.wrappers.RecordVideo",
    "gymnasium.wrappers.vector.RecordVideo",
    "minari.DataCollector",
    f"{VEC_ENV}.VecVideoRecorder",
)
# The classes of a pipe's ends. Only Windows has the class `PipeConnection`.
_PIPE_ENDS: Final[set[Any]] = {
    connection.Connection,
    getattr(connection, "PipeConnection", connection.Connection),
}


class Copy:
    """A copy of an environment and all environments within it, at their present samples.

    The copy writes to no file of the original, and closes nothing. Layers that run in other
    processes, show a window, or raise an error when they are copied are not copied: copy and
    original share these layers and all layers within them.

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
        # The argument `memo` of `copy.deepcopy`: each copy by the `id` of its original.
        # `deepcopy` takes the copies in `memo` instead of copying their originals again.
        self._copies: dict[int, Any] = {}
        with _pipes_refused():
            self.env = self._copy(env)

    def _copy(self, layer: Any) -> Any:
        """Return a copy of a layer and its inner layers; the layer itself if it is shared."""
        if id(layer) in self._copies:
            return self._copies[id(layer)]
        copies_of_inner = [self._copy(inner) for inner in inner_environments(layer)]
        if isinstance(layer, tuple(map(loaded, _RECORDERS))):
            self._copies[id(layer)] = copies_of_inner[0]  # a recorder wraps one environment
            return self._copies[id(layer)]
        reason = _why_not_copied(layer)
        if not reason:
            copies_before = dict(self._copies)
            try:
                return self._copy_alone(layer)
            except Exception as error:  # whatever a layer of another package raises
                reason = f"{type(layer).__name__} cannot be copied: {error}"
                self._copies.clear()  # forget the parts of the copy that failed
                self._copies.update(copies_before)
        self.reason = reason
        for original in layers(layer):
            self.shared[id(original)] = original
            self._copies[id(original)] = original
        return layer

    def _copy_alone(self, layer: Any) -> Any:
        """Return a copy of a layer, around the copies of its inner layers in `_copies`."""
        if inner_environments(layer):
            duplicate = self._copy_attributes(layer)
        else:
            duplicate = copy.deepcopy(layer, self._copies)
        if isinstance(duplicate, VectorEnv):
            duplicate.closed = True  # as a vector environment closes itself when it is deleted
        return duplicate

    def _copy_attributes(self, wrapper: Any) -> Any:
        """Return a copy of a wrapper or a vector environment, attribute by attribute.

        The methods by which wrappers are pickled do not serve: a pickled `VecNormalize` lacks
        the environment that it wraps.
        """
        duplicate = object.__new__(type(wrapper))
        self._copies[id(wrapper)] = duplicate
        attributes = dict(vars(wrapper))
        if "results_writer" in attributes:
            attributes["results_writer"] = None  # so that the copy of a monitor writes no file
        if "class_attributes" in attributes:
            # A VecEnvWrapper has these from its class, so the copy has them, too.
            class_attributes = attributes["class_attributes"]
            self._copies[id(class_attributes)] = class_attributes
        # The inner environments come first: a wrapper takes attributes that it lacks from them.
        inner_names = [name for name in INNER if name in attributes]
        for name in [*inner_names, *attributes]:
            vars(duplicate)[name] = copy.deepcopy(attributes[name], self._copies)
        return duplicate


@contextmanager
def _pipes_refused() -> Iterator[None]:
    """Return a context in which copying the end of a pipe raises a TypeError.

    Without the context, the copy of a pipe closes the original pipe when the copy is deleted.
    """
    table = copyreg.dispatch_table  # how `copy` and `pickle` treat objects, by class
    treatments_before = dict(table)
    table.update(dict.fromkeys(_PIPE_ENDS, _refuse_pipe))
    try:
        yield
    finally:
        for pipe_end in _PIPE_ENDS:
            del table[pipe_end]
        table.update(treatments_before)


def _refuse_pipe(_: Any) -> NoReturn:
    """Raise a TypeError, in place of copying the end of a pipe."""
    raise TypeError("a pipe to another process cannot be copied")


def _why_not_copied(layer: Any) -> str:
    """Return why a copy of a layer must not even be tried; "" if a copy may be tried."""
    name = type(layer).__name__
    if runs_processes(layer):
        return f"{name} runs in other processes"
    # Wrappers around an environment with a window report its render mode "human" as theirs.
    inner = inner_environments(layer)
    inner_modes = [getattr(environment, "render_mode", None) for environment in inner]
    if getattr(layer, "render_mode", None) == "human" and "human" not in inner_modes:
        return f"{name} shows a window"
    return ""
