"""Turn a policy of any form into a function from observations to actions.

A policy is an object with a method `predict` (as in Stable-Baselines3) or `act`, a
`torch.nn.Module`, or a function of NumPy arrays. A bound method `model.predict` or
`controller.act` is treated as the object `model` or `controller`, and a `functools.partial` is
treated as the function within the partial.
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

# A function that takes observations and returns actions, both with a row for each plant.
Act = Callable[[Any], Any]
# Methods that make an object a policy. If an object has both methods, `predict` is called.
_METHODS: Final = ("predict", "act")
# Held during each call of a PyTorch module. A call sets the module to evaluation mode and back,
# so two threads must not call a module at the same time.
_MODULE_LOCK: Final = threading.RLock()


class Form(NamedTuple):
    """How to call a policy: the function to call, and the object whose method it may be."""

    function: Callable[..., Any]  # the function to call with observations
    method: str  # "predict" or "act" if `function` is this method; otherwise ""
    # The object whose method `predict` or `act` is called, or else the function that is called,
    # without any `functools.partial` around the function.
    target: Any
    # The torch.nn.Module that the policy is, or whose method the policy is; otherwise None.
    module: Any


def form_of(policy: Any) -> Form:
    """Return how to call a policy: a function, and the object whose method it may be.

    A ValueError is raised if `policy` is an environment, a class, or neither a function nor an
    object with a method `predict` or `act`.
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
    """Reset a policy, and return a function that acts in one episode of n plants.

    The returned function takes observations in NumPy arrays and returns actions, both with a
    row for each plant. If the policy, or the object of a bound method `predict` or `act`, has a
    method `reset`, `start` calls `reset`.
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
    """Return a function from observations to actions that calls the method `predict`.

    The returned function can be used for one episode of n plants. The state that `predict`
    returns, such as the state of a recurrent network, is passed to the next call of `predict`.
    Of the keywords `state`, `episode_start` and `deterministic=True`, `predict` receives those
    that `predict` takes and that no `functools.partial` has set.
    """
    parameters = inspect.signature(predict).parameters
    takes_any_keyword = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
    set_by_partial = predict.keywords if isinstance(predict, partial) else {}
    keywords = {"state": None, "episode_start": np.ones(n, np.bool_), "deterministic": True}
    for name in [*keywords]:
        if name in set_by_partial or not (takes_any_keyword or name in parameters):
            del keywords[name]

    def act(observations: Any) -> Any:
        """Return the actions from `predict`, and keep the returned state for the next call."""
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
    """Return a function that converts NumPy arrays to tensors and calls a PyTorch module.

    The tensors have the type and the device of the module's weights. If the module has no
    weights of a floating-point type, the tensors are of float32 on the CPU.
    """
    torch: Any = sys.modules["torch"]  # not imported, as this package does not depend on it
    float_weights = (tensor for tensor in module.parameters() if tensor.is_floating_point())
    weights = next(float_weights, torch.empty(0))

    def to_tensors(observations: Any) -> Any:
        """Return an array, or the arrays in a dict or a tuple, as tensors."""
        if isinstance(observations, Mapping):
            return {name: to_tensors(part) for name, part in observations.items()}
        if isinstance(observations, tuple):
            return tuple(map(to_tensors, observations))
        return torch.tensor(observations).to(weights)

    return lambda observations: call(to_tensors(observations))


def _act_in_evaluation_mode(act: Act, module: Any) -> Act:
    """Return a function that calls `act` while a PyTorch module is in evaluation mode.

    PyTorch computes no gradients during a call of `act`. After each call of `act`, each part of
    the module returns to the part's previous mode. If `act` returns a tensor, the returned
    function returns a NumPy array.
    """
    torch: Any = sys.modules["torch"]
    parts = [part for part in module.modules() if hasattr(part, "training")]
    set_mode = module.train
    arguments = inspect.signature(set_mode).parameters.values()
    default_mode = next((argument.default for argument in arguments), None)
    if default_mode is not True:  # the module has a `train` method of another meaning
        set_mode = partial(torch.nn.Module.train, module)

    def evaluating_act(observations: Any) -> Any:
        """Return the actions of `act` with the module in evaluation mode, without gradients."""
        with _MODULE_LOCK, torch.no_grad():
            # A frozen TorchScript module has no attribute `training`.
            is_training = getattr(module, "training", False)
            flags = [part.training for part in parts]
            set_mode(False)
            try:
                actions = act(observations)
            finally:
                set_mode(is_training)  # undoes what the module's own `train` has changed
                for part, flag in zip(parts, flags, strict=True):
                    # Setting an attribute of a PyTorch module is slow.
                    if part.training != flag:
                        part.training = flag
        if isinstance(actions, torch.Tensor):
            return np.array(actions.tolist())  # for tensors of any type, on any device
        return actions

    return evaluating_act
