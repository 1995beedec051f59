"""Copy wrapped environments, so that a policy can act without changing the originals.

The name `layer` stands for one object of a wrapped environment: a wrapper, a vector environment
or the innermost environment. `copy.deepcopy` alone is not enough: `deepcopy` fails for open
files and for most wrappers of Stable-Baselines3, loses the environments in a `VecNormalize`,
and closes the pipes to worker processes.
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

# Classes of wrappers that record episodes and change neither observations nor actions. A copied
# environment has none of these wrappers.
_RECORDERS: Final = (
    "gymnasium.wrappers.RecordVideo",
    "gymnasium.wrappers.vector.RecordVideo",
    "minari.DataCollector",
    f"{VEC_ENV}.VecVideoRecorder",
)
# Classes of the ends of a pipe to a process. Only Windows has the class `PipeConnection`.
_PIPE_ENDS: Final[set[Any]] = {
    connection.Connection,
    getattr(connection, "PipeConnection", connection.Connection),
}


class Copy:
    """A copy of an environment with all wrappers, in the present state of the original.

    The copied environment writes to no file of the original environment, and closes nothing
    when the copy is deleted. A wrapper or environment is shared with the original, and not
    copied, if the wrapper or environment runs in other processes, shows a window, or raises an
    error when it is copied. All environments inside a shared wrapper are shared as well.

    Parameters
    ----------
    env
        An environment of any kind.

    Attributes
    ----------
    env : environment
        The copy.
    shared : dict of int to environment
        Wrappers and environments that the copy and the original share, by their Python `id`.
    reason : str
        Reason why a wrapper or environment is shared; "" if nothing is shared.
    """

    def __init__(self, env: Any) -> None:
        self.shared: dict[int, Any] = {}
        self.reason = ""
        # Argument `memo` of `copy.deepcopy`: each copy by the `id` of the original. `deepcopy`
        # returns the copies in `memo` instead of copying the originals again.
        self._copies: dict[int, Any] = {}
        with _pipes_refused():
            self.env = self._copy(env)

    def _copy(self, layer: Any) -> Any:
        """Return a copy of a wrapper or environment, or the original if it cannot be copied.

        For a recorder (`_RECORDERS`), a copy of the environment in the recorder is returned.
        """
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
        """Return a copy of a wrapper or environment around copies of the inner environments."""
        if inner_environments(layer):
            duplicate = self._copy_attributes(layer)
        else:
            duplicate = copy.deepcopy(layer, self._copies)
        if duplicate is layer:
            raise TypeError("its method __deepcopy__ returns the original")
        if isinstance(duplicate, VectorEnv):
            duplicate.closed = True  # as a vector environment closes itself when it is deleted
        return duplicate

    def _copy_attributes(self, wrapper: Any) -> Any:
        """Return a copy of a wrapper or vector environment, made by copying each attribute.

        `copy.deepcopy` cannot copy a `VecNormalize`, because `VecNormalize.__getstate__` drops
        the wrapped environment.
        """
        duplicate = object.__new__(type(wrapper))
        self._copies[id(wrapper)] = duplicate
        attributes = dict(vars(wrapper))
        if "results_writer" in attributes:
            attributes["results_writer"] = None  # so that the copy of a monitor writes no file
        if "class_attributes" in attributes:
            # The copy of a VecEnvWrapper has the same class, so `class_attributes` can be
            # shared.
            class_attributes = attributes["class_attributes"]
            self._copies[id(class_attributes)] = class_attributes
        # Copy the wrapped environments first: a wrapper looks up missing attributes in them.
        inner_names = [name for name in INNER if name in attributes]
        for name in [*inner_names, *attributes]:
            vars(duplicate)[name] = copy.deepcopy(attributes[name], self._copies)
        return duplicate


@contextmanager
def _pipes_refused() -> Iterator[None]:
    """Return a context in which `copy.deepcopy` of the end of a pipe raises a TypeError.

    A copied end of a pipe would close the original pipe when the copy is deleted.
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
    """Raise a TypeError, because the end of a pipe to another process cannot be copied."""
    raise TypeError("a pipe to another process cannot be copied")


def _why_not_copied(layer: Any) -> str:
    """Return why a wrapper or environment must not be copied, or "" if copying may be tried."""
    name = type(layer).__name__
    if runs_processes(layer):
        return f"{name} runs in other processes"
    # A wrapper reports the render mode of the wrapped environment. So the window belongs to the
    # innermost environment that reports the render mode "human".
    inner = inner_environments(layer)
    inner_modes = [getattr(environment, "render_mode", None) for environment in inner]
    if getattr(layer, "render_mode", None) == "human" and "human" not in inner_modes:
        return f"{name} shows a window"
    return ""
