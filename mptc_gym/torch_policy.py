"""Call modules of PyTorch as policies: with tensors, in evaluation mode, without gradients."""

from __future__ import annotations

import inspect
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import torch

from mptc_gym.checks import reject

Act = Callable[[Any], Any]  # observations, one row per plant, to actions


class _Use(NamedTuple):
    """How many evaluations use a module, and its flag before the first of them."""

    evaluations: int
    was_training: bool | None  # None of a frozen script, which has no flag


_LOCK = threading.Lock()
_USES: WeakKeyDictionary[torch.nn.Module, _Use] = WeakKeyDictionary()


def of_tensors(act: Act, module: torch.nn.Module) -> Act:
    """Return the function of NumPy arrays that calls a module, or its method, with tensors.

    Tensors are of float32 on the CPU, or have the type and the device of the module's weights.
    """
    if act is module and getattr(module.forward, "__name__", "") == "_forward_unimplemented":
        allowed = "a module with forward: its part that acts, such as agent.actor_mean"
        reject("policy", module, allowed)
    like = next(module.parameters(), torch.empty(0))

    def tensors(observations: Any) -> Any:
        if isinstance(observations, Mapping):
            return {name: tensors(part) for name, part in observations.items()}
        if isinstance(observations, tuple):
            return tuple(map(tensors, observations))
        return torch.tensor(observations).to(like)

    def act_on_arrays(observations: Any) -> Any:
        with torch.no_grad():
            return _array(act(tensors(observations)))

    return act_on_arrays


def of_arrays(act: Act, method: str) -> Act:
    """Return the function of NumPy arrays that calls `predict` or `act` of a module."""

    def act_on_arrays(observations: Any) -> Any:
        with torch.no_grad():
            try:
                return _array(act(observations))
            except (AttributeError, TypeError) as error:
                raise ValueError(
                    f"policy.{method} must take NumPy arrays, got {type(error).__name__}: "
                    f"{error}; for tensors, write "
                    f"lambda o: agent.{method}(torch.as_tensor(o)).numpy()"
                ) from error

    return act_on_arrays


def _array(actions: Any) -> Any:
    """Return a tensor of any type and on any device as an array; all else as it is."""
    return np.array(actions.tolist()) if isinstance(actions, torch.Tensor) else actions


@contextmanager
def evaluation_mode(module: torch.nn.Module) -> Iterator[None]:
    """Keep a module in evaluation mode, and put the flags of all its parts back afterwards.

    Several threads may evaluate a module at once: the last one puts the flags back.
    """
    parts = [*module.modules()]
    with _LOCK:
        for part in parts:
            unused = _Use(0, getattr(part, "training", None))
            use = _USES.get(part, unused)
            _USES[part] = _Use(use.evaluations + 1, use.was_training)
        _set_mode(module, training=False)
    try:
        yield
    finally:
        with _LOCK:
            _put_back(module, parts)


def _put_back(module: torch.nn.Module, parts: list[torch.nn.Module]) -> None:
    """End one evaluation of a module, and put back the flags of parts that had no other."""
    uses = {part: _USES.pop(part) for part in parts}
    was_training = uses[module].was_training
    if was_training is not None and all(use.evaluations == 1 for use in uses.values()):
        _set_mode(module, training=was_training)  # for what a `train` of its own has set
    for part, use in uses.items():
        if use.evaluations > 1:
            _USES[part] = _Use(use.evaluations - 1, use.was_training)
        elif use.was_training is not None:
            part.training = use.was_training


def _set_mode(module: torch.nn.Module, *, training: bool) -> None:
    """Set the mode of a module and of its parts, each by its own `train` if it has one."""
    if _has_own_train(module):
        module.train(training)
        return
    module.training = training
    for part in module.children():
        _set_mode(part, training=training)


def _has_own_train(module: torch.nn.Module) -> bool:
    """Whether a module replaces `train(mode=True)`, rather than names a training `train`."""
    if getattr(module.train, "__func__", None) is torch.nn.Module.train:
        return False
    parameters = inspect.signature(module.train).parameters.values()
    return next((parameter.default for parameter in parameters), None) is True
