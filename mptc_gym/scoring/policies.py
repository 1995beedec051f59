"""Call a policy in any of its four forms as a function of observations.

A policy is an object with `predict`, as in Stable-Baselines3; an object with `act`; a
`torch.nn.Module`; or a function of NumPy arrays. A bound method `predict` or `act` stands for
the object of the method, and a `functools.partial` for the function within the partial.
"""

from __future__ import annotations

import inspect
import sys
import threading
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np

from mptc_gym.environments.layers import is_environment, loaded
from mptc_gym.plant.checks import reject

# A function of observations, one row for each plant, that returns actions, one row for each
# plant.
Act = Callable[[Any], Any]
# Methods that make an object a policy. If an object has both methods, the first one is called.
_METHODS: Final = ("predict", "act")
# Held while a PyTorch module is called: several threads may call the module and change whether
# the module is in evaluation mode.
_LOCK: Final = threading.RLock()


class Form(NamedTuple):
    """How a policy is called, and on which object."""

    function: Callable[..., Any]  # the function to call with observations
    method: str  # "predict", "act", or "" if the policy itself is the function
    target: Any  # the object that the policy is, or whose `predict` or `act` the policy is
    # The torch.nn.Module that the policy is, or whose method the policy is; otherwise None.
    module: Any


def form_of(policy: Any) -> Form:
    """Return how a policy is called, and on which object.

    A ValueError is raised if the policy has none of the four forms: an object with `predict`,
    an object with `act`, a `torch.nn.Module`, or a function.
    """
    if is_environment(policy):
        reject("policy", policy, "a policy, which comes first: evaluate(policy, env)")
    if isinstance(policy, type):
        reject("policy", policy, "an object with predict or act, not a class")
    target = policy
    while isinstance(target, partial):
        target = target.func
    owner = getattr(target, "__self__", target)  # the object of a bound method
    module = owner if isinstance(owner, loaded("torch.nn.Module")) else None
    for method in _METHODS:
        if callable(getattr(policy, method, None)):
            return Form(getattr(policy, method), method, policy, module)
    method = getattr(target, "__name__", "")
    if method in _METHODS and owner is not target:
        return Form(policy, method, owner, module)
    if not callable(policy):
        allowed = "a function, a torch.nn.Module, or an object with predict or act"
        reject("policy", policy, allowed)
    return Form(policy, "", target, module)


def start(policy: Any, n: int) -> Act:
    """Reset a policy for n episodes, and return its function of observations.

    Parameters
    ----------
    policy
        A policy in one of the four forms. If the policy is an object with a method `reset`, or
        the bound method `predict` or `act` of an object with `reset`, `reset()` is called. If
        the policy is a bound method of another name, `reset()` of the object is not called.
    n
        Number of plants.

    Returns
    -------
    function
        Function of observations in NumPy arrays, one row for each plant. The function returns
        the actions of the policy, one row for each plant.

    Raises
    ------
    ValueError
        If the policy has none of the four forms.
    """
    form = form_of(policy)
    reset = getattr(form.target, "reset", None)
    if callable(reset):
        reset()
    act = _predicting(form.function, n) if form.method == "predict" else form.function
    if form.module is None:
        return act
    if not form.method:
        act = _taking_tensors(act, form.module)
    return _in_evaluation_mode(act, form.module)


def _predicting(predict: Callable[..., Any], n: int) -> Act:
    """Return a `predict` in the form of Stable-Baselines3 as a function of observations.

    The function is for one round of n episodes, and keeps the state of a recurrent policy from
    call to call. The function passes the keywords `state`, `episode_start` and
    `deterministic=True` to `predict`, except keywords that `predict` does not take, and
    keywords that a `functools.partial` has set.
    """
    parameters = inspect.signature(predict).parameters
    kinds = {parameter.kind for parameter in parameters.values()}
    takes_all = inspect.Parameter.VAR_KEYWORD in kinds
    set_by_partial = predict.keywords if isinstance(predict, partial) else {}
    keywords = {"state": None, "episode_start": np.ones(n, np.bool_), "deterministic": True}
    for name in [*keywords]:
        if name in set_by_partial or not (takes_all or name in parameters):
            del keywords[name]

    def act(observations: Any) -> Any:
        """Return the actions that `predict` returns, and keep the state that follows."""
        returned = predict(observations, **keywords)
        if "episode_start" in keywords:
            keywords["episode_start"] = np.zeros(n, np.bool_)
        if not isinstance(returned, tuple):
            return returned
        actions, state = returned
        if "state" in keywords:
            keywords["state"] = state
        return actions

    return act


def _taking_tensors(act: Act, module: Any) -> Act:
    """Return a function of NumPy arrays that calls a PyTorch module with tensors.

    `act` is the module or a method of the module. The tensors have the type and the device of
    the module's weights. If the module has no weights, the tensors are of float32 on the CPU.
    """
    torch: Any = sys.modules["torch"]  # as this package does not depend on PyTorch
    weights = next(module.parameters(), torch.empty(0))

    def in_tensors(observations: Any) -> Any:
        """Return observations as tensors: an array, or arrays in a dict or a tuple."""
        if isinstance(observations, Mapping):
            return {name: in_tensors(part) for name, part in observations.items()}
        if isinstance(observations, tuple):
            return tuple(map(in_tensors, observations))
        return torch.tensor(observations).to(weights)

    return lambda observations: act(in_tensors(observations))


def _in_evaluation_mode(act: Act, module: Any) -> Act:
    """Return a function that calls a PyTorch module in evaluation mode, without gradients.

    `act` is what is called: the module or a function that calls the module. The training flags
    of the module's parts are put back after each call. Actions in a tensor are returned as a
    NumPy array.
    """
    torch: Any = sys.modules["torch"]
    parts = [part for part in module.modules() if hasattr(part, "training")]
    set_mode = module.train
    arguments = inspect.signature(set_mode).parameters.values()
    if next((argument.default for argument in arguments), None) is not True:
        # This `train` is a training, where that of PyTorch is `train(mode=True)`.
        set_mode = partial(torch.nn.Module.train, module)

    def evaluating(observations: Any) -> Any:
        """Return the actions of the module, called in evaluation mode without gradients."""
        with _LOCK, torch.no_grad():
            is_training = getattr(module, "training", False)  # a frozen script has no flag
            flags = [part.training for part in parts]
            set_mode(False)
            try:
                actions = act(observations)
            finally:
                set_mode(is_training)  # for other attributes that a `train` may set
                for part, flag in zip(parts, flags, strict=True):
                    if part.training != flag:  # as PyTorch takes long to set an attribute
                        part.training = flag
        if isinstance(actions, torch.Tensor):  # of any type, on any device
            return np.array(actions.tolist())
        return actions

    return evaluating
