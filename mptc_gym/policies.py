"""Call a policy in any of its four forms as a function of observations.

A policy is an object with `predict`, as in Stable-Baselines3; an object with `act`; a
`torch.nn.Module`; or a function of NumPy arrays. A bound `predict` or `act` stands for its
object, and a `functools.partial` for its function.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any, Final

import numpy as np

from mptc_gym.checks import reject
from mptc_gym.layers import is_environment, loaded

Act = Callable[[Any], Any]  # observations, one row per plant, to actions
_METHODS: Final = ("predict", "act")  # of objects that are policies; the first one counts


def object_of(policy: Any) -> Any:
    """Return the object that a policy is, or that its bound `predict` or `act` stands for."""
    function = _without_partials(policy)
    if getattr(function, "__name__", None) in _METHODS:
        return getattr(function, "__self__", function)
    return function


def module_of(policy: Any) -> Any:
    """Return the `torch.nn.Module` that a policy is or whose method it is; otherwise None."""
    function = _without_partials(policy)
    owner = getattr(function, "__self__", function)
    return owner if isinstance(owner, loaded("torch.nn.Module")) else None


def evaluation_mode(policy: Any) -> AbstractContextManager[None]:
    """Return a context in which the module that acts, if any, is in evaluation mode."""
    module = module_of(policy)
    if module is None:
        return nullcontext()
    from mptc_gym import torch_policy  # which needs PyTorch

    return torch_policy.evaluation_mode(module)


def check_policy(policy: Any) -> None:
    """Raise a ValueError if this is not a policy of one of the four forms."""
    if is_environment(policy):
        reject("policy", policy, "a policy, which comes first: evaluate(policy, env)")
    if isinstance(policy, type):
        reject("policy", policy, "an object with predict or act, not a class")
    if _method_of(policy) is None and not callable(policy):
        allowed = "a function, a torch.nn.Module, or an object with predict or act"
        reject("policy", policy, allowed)


def start(policy: Any, n: int) -> Act:
    """Reset a policy for n episodes, and return its function of observations.

    `reset()` is called on the object that was handed over, if it has this method, but not on
    the owner of a method other than `predict` and `act`. A ValueError says what is wrong with
    a policy.
    """
    check_policy(policy)
    _reset(object_of(policy))
    method = _method_of(policy)
    module = module_of(policy)
    if method == "predict":
        act: Act = _Predict(getattr(policy, "predict", policy), n)
    elif method == "act":
        act = getattr(policy, "act", policy)
    else:
        act = policy
    if module is None:
        return act
    from mptc_gym import torch_policy  # which needs PyTorch

    if method is None:
        return torch_policy.of_tensors(act, module)
    return torch_policy.of_arrays(act, method)


def _without_partials(policy: Any) -> Any:
    """Return the function of a `functools.partial`; all else as it is."""
    while isinstance(policy, partial):
        policy = policy.func
    return policy


def _method_of(policy: Any) -> str | None:
    """Return which of `_METHODS` a policy has or is; None if it is called itself."""
    for method in _METHODS:
        if callable(getattr(policy, method, None)):
            return method
    function = _without_partials(policy)
    name = getattr(function, "__name__", None)
    return name if name in _METHODS and hasattr(function, "__self__") else None


def _reset(policy: Any) -> None:
    """Call the method `reset` of a policy, if it has one."""
    method = getattr(policy, "reset", None)
    if not callable(method):
        return
    try:
        inspect.signature(method).bind()
    except TypeError:
        allowed = (
            "callable without arguments, as it is called before each round of episodes; to "
            "leave it out, write a function, such as lambda o: agent.act(o)"
        )
        reject("policy.reset", method, allowed)
    except ValueError:  # of what is not written in Python
        pass
    method()


class _Predict:
    """The method `predict` of a policy in the form of Stable-Baselines3, for n episodes.

    It gets `state`, `episode_start` and `deterministic=True`, except those that it does not
    take or that a `functools.partial` has set.
    """

    def __init__(self, predict: Any, n: int) -> None:
        self._predict = predict
        self._n = n
        accepted = _keywords_of(predict)
        keywords = {"state": None, "episode_start": np.ones(n, np.bool_), "deterministic": True}
        self._keywords = {
            name: value
            for name, value in keywords.items()
            if accepted is None or name in accepted
        }

    def __call__(self, observations: Any) -> Any:
        returned = self._predict(observations, **self._keywords)
        if "episode_start" in self._keywords:
            self._keywords["episode_start"] = np.zeros(self._n, np.bool_)
        if not isinstance(returned, tuple):
            return returned
        if len(returned) != 2:
            allowed = "a method that returns actions, or actions and a state"
            reject("policy.predict", returned, allowed)
        actions, state = returned
        if "state" in self._keywords:
            self._keywords["state"] = state
        return actions


def _keywords_of(predict: Any) -> set[str] | None:
    """Return the names of the keywords that `predict` takes and has not got; None for any."""
    try:
        parameters = inspect.signature(predict).parameters
    except (TypeError, ValueError):  # of what is not written in Python
        return set()
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values()):
        return None
    fixed = predict.keywords if isinstance(predict, partial) else {}
    return {*parameters} - {*fixed}
