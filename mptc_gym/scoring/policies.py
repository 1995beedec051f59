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

# A function of observations, with a row for each plant, that returns actions, with a row for
# each plant.
Act = Callable[[Any], Any]
# Methods that make an object a policy. If an object has both methods, the first one is called.
_METHODS: Final = ("predict", "act")
# Held while a PyTorch module is called: several threads may call the module, and each call
# changes whether the module is in evaluation mode.
_MODULE_LOCK: Final = threading.RLock()


class Form(NamedTuple):
    """How a policy is called, and on which object."""

    function: Callable[..., Any]  # the function to call with observations
    method: str  # "predict" or "act" if `function` is this method; otherwise ""
    # The object with the method `predict` or `act`, or else the function within all partials.
    target: Any
    # The torch.nn.Module that the policy is, or whose method the policy is; otherwise None.
    module: Any


def form_of(policy: Any) -> Form:
    """Return how a policy of any form that `evaluate` takes is called, and on which object.

    A ValueError is raised if the policy has none of these forms.
    """
    if is_environment(policy):
        reject("policy", policy, "a policy, which comes first: evaluate(policy, env)")
    if isinstance(policy, type):
        reject("policy", policy, "an object with predict or act, not a class")
    function = policy
    while isinstance(function, partial):
        function = function.func  # the function within the partial
    owner = getattr(function, "__self__", function)  # the object of a bound method
    module = owner if isinstance(owner, loaded("torch.nn.Module")) else None
    for method in _METHODS:
        if callable(getattr(policy, method, None)):
            return Form(getattr(policy, method), method, policy, module)
    name = getattr(function, "__name__", "")
    if name in _METHODS and owner is not function:  # a bound method `predict` or `act`
        return Form(policy, name, owner, module)
    if not callable(policy):
        allowed = "a function, a torch.nn.Module, or an object with predict or act"
        reject("policy", policy, allowed)
    return Form(policy, "", function, module)


def start(policy: Any, n: int) -> Act:
    """Reset a policy, and return it as a function for one episode of n plants.

    The function takes observations in NumPy arrays, and returns the actions of the policy, both
    with a row for each plant. The method `reset()` is called if the policy is an object with
    this method, or the bound method `predict` or `act` of an object with this method.
    """
    form = form_of(policy)
    reset = getattr(form.target, "reset", None)
    if callable(reset):
        reset()
    act = form.function
    if form.method == "predict":
        act = _act_by_predict(form.function, n)
    if form.module is None:
        return act
    if not form.method:
        act = _act_on_tensors(act, form.module)
    return _act_in_evaluation_mode(act, form.module)


def _act_by_predict(predict: Callable[..., Any], n: int) -> Act:
    """Return a function of observations that calls `predict` as Stable-Baselines3 does.

    The function serves for one episode of n plants. The state that `predict` returns, such as
    the state of a recurrent network, is passed to the next call of `predict`. `predict` gets
    the keywords `state`, `episode_start` and `deterministic=True`, without keywords that it
    does not take, and without keywords that a `functools.partial` has set.
    """
    parameters = inspect.signature(predict).parameters
    takes_any_keyword = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
    set_by_partial = predict.keywords if isinstance(predict, partial) else {}
    keywords = {"state": None, "episode_start": np.ones(n, np.bool_), "deterministic": True}
    for name in [*keywords]:
        if name in set_by_partial or not (takes_any_keyword or name in parameters):
            del keywords[name]

    def act(observations: Any) -> Any:
        """Return the actions that `predict` returns, and keep the state for the next call."""
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


def _act_on_tensors(call: Callable[[Any], Any], module: Any) -> Act:
    """Return a function of NumPy arrays that calls a PyTorch module with tensors.

    `call` is the module or a method of the module. The tensors have the type and the device of
    the module's weights. If the module has no weights, the tensors are of float32 on the CPU.
    """
    torch: Any = sys.modules["torch"]  # not imported, as this package does not depend on it
    weights = next(module.parameters(), torch.empty(0))

    def to_tensors(observations: Any) -> Any:
        """Return observations as tensors: an array, or arrays in a dict or a tuple."""
        if isinstance(observations, Mapping):
            return {name: to_tensors(part) for name, part in observations.items()}
        if isinstance(observations, tuple):
            return tuple(map(to_tensors, observations))
        return torch.tensor(observations).to(weights)

    return lambda observations: call(to_tensors(observations))


def _act_in_evaluation_mode(act: Act, module: Any) -> Act:
    """Return a function that calls `act` with a PyTorch module in evaluation mode.

    `act` calls the module. PyTorch computes no gradients meanwhile, and each part of the module
    is put back into its mode after each call. The actions are returned as a NumPy array, even
    if `act` returns a tensor.
    """
    torch: Any = sys.modules["torch"]
    parts = [part for part in module.modules() if hasattr(part, "training")]
    set_mode = module.train
    arguments = inspect.signature(set_mode).parameters.values()
    default_mode = next((argument.default for argument in arguments), None)
    if default_mode is not True:  # this `train` trains, unlike `train(mode=True)` of PyTorch
        set_mode = partial(torch.nn.Module.train, module)

    def evaluating_act(observations: Any) -> Any:
        """Return the actions of `act`, called in evaluation mode and without gradients."""
        with _MODULE_LOCK, torch.no_grad():
            is_training = getattr(module, "training", False)  # a frozen script has no flag
            flags = [part.training for part in parts]
            set_mode(False)
            try:
                actions = act(observations)
            finally:
                set_mode(is_training)  # for what a `train` of the module's own may change
                for part, flag in zip(parts, flags, strict=True):
                    if part.training != flag:  # as PyTorch takes long to set an attribute
                        part.training = flag
        if isinstance(actions, torch.Tensor):
            return np.array(actions.tolist())  # for tensors of any type, on any device
        return actions

    return evaluating_act
