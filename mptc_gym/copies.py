"""Copy environments layer by layer, so that a policy can act in a copy.

`copy.deepcopy` alone does not do. It fails for files and for most wrappers of
Stable-Baselines3, loses what a `VecNormalize` wraps, and closes the pipes of environments in
other processes.
"""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from multiprocessing import connection
from multiprocessing.process import BaseProcess
from types import FunctionType, ModuleType
from typing import Any, Final

import numpy as np
from gymnasium.vector import VectorEnv

from mptc_gym.env import MiddlePointEnv
from mptc_gym.layers import (
    INNER,
    VEC_ENV,
    inner_environments,
    is_environment,
    layers,
    loaded,
    runs_processes,
)
from mptc_gym.vector_env import MiddlePointVectorEnv

_NATIVE: Final = MiddlePointEnv, MiddlePointVectorEnv
# Values of these types hold no pipe and need not be searched.
_PLAIN: Final = str, bytes, int, float, np.ndarray, type, FunctionType, ModuleType
# On Windows, pipes are of a class of their own.
_PIPES: Final = (
    connection.Connection,
    getattr(connection, "PipeConnection", BaseProcess),
    BaseProcess,
)
# Layers that record what they see and change nothing: a copy goes without them.
_RECORDERS: Final = (
    "gymnasium.wrappers.RecordVideo",
    "gymnasium.wrappers.vector.RecordVideo",
    "minari.DataCollector",
    f"{VEC_ENV}.VecVideoRecorder",
)


@dataclass
class Copy:
    """A copy of an environment, to act in.

    `shared` are the layers that could not be copied, outermost first, so that the copy runs
    those of the original; and `reason` says why not.
    """

    env: Any = None
    shared: list[Any] = field(default_factory=list)
    reason: str = ""


class _SilentWriter:
    """Stands for the file of a monitor, and writes nothing."""

    def write_row(self, _: Mapping[str, Any]) -> None:
        """Do not write."""

    def close(self) -> None:
        """Do nothing, as nothing is open."""


def copied(env: Any) -> Copy:
    """Return a copy of an environment and of all that it wraps, in mid-episode if need be.

    The original stays as it is, and what happens in the copy is neither written to a file of
    the original nor closes anything. Environments in other processes, with a window, with a
    pipe, or with anything else that cannot be copied are shared.
    """
    copying = _Copying()
    copying.result.env = copying.copy(env)
    return copying.result


class _Copying:
    """The layers that have been copied so far, in `memo`, as `copy.deepcopy` wants it."""

    def __init__(self) -> None:
        self.memo: dict[int, Any] = {}
        self.result = Copy()

    def copy(self, layer: Any) -> Any:
        """Return a copy of a layer and of those within it, or the layer itself if it has to."""
        if id(layer) in self.memo:
            return self.memo[id(layer)]
        for inner in inner_environments(layer):
            self.copy(inner)
        reason = _why_not(layer)
        if not reason:
            known = len(self.memo)
            try:
                return self._copy_layer(layer)
            except Exception as error:  # whatever a layer of anybody raises
                for key in [*self.memo][known:]:  # parts of the copy that failed
                    del self.memo[key]
                reason = f"{type(layer).__name__} cannot be copied: {error}"
        self._share(layer, reason)
        return layer

    def _copy_layer(self, layer: Any) -> Any:
        """Return a copy of a layer, within which everything is in the memo."""
        memo = self.memo
        if isinstance(layer, tuple(map(loaded, _RECORDERS))):
            (inner,) = inner_environments(layer)
            memo[id(layer)] = memo[id(inner)]
            return memo[id(layer)]
        attributes = vars(layer)
        writer = attributes.get("results_writer")  # the file of a Monitor or a VecMonitor
        if writer is not None:
            memo[id(writer)] = _SilentWriter()
        if "class_attributes" in attributes:  # the same for all of a class
            memo[id(layer.class_attributes)] = layer.class_attributes
        if not inner_environments(layer):
            duplicate = copy.deepcopy(layer, memo)
        else:
            # Wrappers define how they are pickled, but not for this purpose.
            duplicate = object.__new__(type(layer))
            for name in INNER:  # first, as attributes of wrappers are looked up in them
                if name in attributes:
                    vars(duplicate)[name] = copy.deepcopy(attributes[name], memo)
            memo[id(layer)] = duplicate
            vars(duplicate).update(copy.deepcopy(attributes, memo))
        if isinstance(duplicate, VectorEnv):
            duplicate.closed = True  # so that nothing is closed when the copy is forgotten
        freeze(duplicate)
        return duplicate

    def _share(self, layer: Any, reason: str) -> None:
        """Let copies use a layer itself, and all that is within it."""
        for original in layers(layer):
            self.memo[id(original)] = original
        inner = {id(original) for original in layers(layer)}
        outside = [other for other in self.result.shared if id(other) not in inner]
        self.result.shared = [layer, *outside]
        self.result.reason = reason


def freeze(layer: Any) -> None:
    """Stop a layer that normalises from updating its statistics."""
    flag = training_flag(layer)
    if flag is not None:
        setattr(layer, flag, False)


def training_flag(layer: Any) -> str | None:
    """Return the attribute by which a layer updates statistics; None if it has none."""
    if isinstance(layer, loaded(f"{VEC_ENV}.VecNormalize")):
        return "training"
    # The wrappers of Gymnasium that normalise, of one environment or many.
    return "update_running_mean" if hasattr(type(layer), "update_running_mean") else None


def _why_not(layer: Any) -> str:
    """Return why a layer must not be copied, before it is tried; "" if it may be."""
    name = type(layer).__name__
    if runs_processes(layer):
        return f"{name} runs in other processes"
    in_window = getattr(layer, "render_mode", None) == "human"
    if in_window and not _shows_window_of_another(layer):
        return f"{name} shows a window"
    if not isinstance(layer, _NATIVE) and _holds_pipe(layer):
        return f"{name} holds a pipe to another process"
    return ""


def _shows_window_of_another(layer: Any) -> bool:
    """Whether the window that a layer shows is that of an environment within it."""
    return any(
        getattr(inner, "render_mode", None) == "human" for inner in inner_environments(layer)
    )


def _holds_pipe(layer: Any) -> bool:
    """Whether a pipe or a process is among the values of a layer, at any depth.

    A copy of a pipe closes the original when it is forgotten.
    """
    values = [*vars(layer).values()]
    searched = set()
    while values:
        value = values.pop()
        if isinstance(value, _PIPES):
            return True
        if id(value) in searched or isinstance(value, _PLAIN) or is_environment(value):
            continue
        searched.add(id(value))
        if isinstance(value, dict):
            values += value.values()
        elif isinstance(value, list | tuple | set | deque):
            values += value
        else:
            values += getattr(value, "__dict__", {}).values()
    return False
