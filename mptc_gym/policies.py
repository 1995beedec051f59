"""Let any policy act: find out how it is called, and step a batch of plants with it."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from inspect import Parameter
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from mptc_gym.checks import reject, shorten

Act = Callable[[Any], Any]  # observations, one row a plant, to actions


def rollout(
    plants: Any, act: Act, samples: int, seed: int | list[int]
) -> Iterator[tuple[Mapping[str, Any], Mapping[str, Any], NDArray[np.bool_]]]:
    """Reset a batch of plants, and step it through samples k = 0, 1, ...

    Yield the infos at sample k, those at k + 1, and whether the episodes have ended.

    This is the one loop, for scores, benchmarks and tests. `plants` are a vector environment of
    Gymnasium, and `act` is a function of their observations. In place of the first seed, a list
    may give all. Actions of the wrong shape, or not finite, are a ValueError.
    """
    observations, infos = plants.reset(seed=seed)
    for k in range(samples):
        actions = _checked(act(observations), plants.action_space.shape, k)
        before = infos
        observations, _, terminated, truncated, infos = plants.step(actions)
        # Where the same step resets a plant, the last sample's infos are apart.
        yield before, infos.get("final_info", infos), terminated | truncated


def _checked(actions: Any, shape: Any, k: int) -> NDArray[Any]:
    """Return a policy's actions at sample k as an array, if the environments can take them."""
    try:
        checked = np.asarray(actions)
        finite = np.isfinite(checked)
    except (TypeError, ValueError, RuntimeError) as error:  # the last: from tensors
        hint = "its first element" if isinstance(actions, tuple) else f"an array ({error})"
        raise ValueError(
            f"policy must return an array of numbers, got {shorten(actions)}: return {hint}"
        ) from error
    if checked.shape != shape:
        raise ValueError(f"policy must return actions of shape {shape}, got {checked.shape}")
    if not finite.all():
        wrong = checked[~finite][0]
        raise ValueError(f"policy must return finite actions, got {wrong} at sample {k}")
    return checked


def start(policy: Any, n: int) -> Act:
    """Reset a policy for n episodes, and return its function of observations."""
    predicts, acts = (callable(getattr(policy, name, None)) for name in ("predict", "act"))
    if isinstance(policy, type) or not (predicts or acts or callable(policy)):
        reject("policy", policy, "a function, or an object with predict or act, not a class")
    function = unbound(policy)
    owner = getattr(function, "__self__", function)  # of a method, its object
    if callable(getattr(owner, "reset", None)) and not isinstance(owner, type):
        owner.reset()
    plain = policy.act if acts else policy
    act = _predicting(policy, n) if predicts else _deterministic(plain)
    if not isinstance(owner, loaded("torch.nn", "Module")):
        return act
    forward = function is owner or getattr(function, "__name__", "") == "forward"
    return _evaluating(owner, act, tensors=forward and not (predicts or acts))


def loaded(module: str, name: str) -> Any:
    """Return a class if its package is imported; otherwise (), which has no instances."""
    return getattr(sys.modules.get(module), name, ())


def is_algorithm(policy: Any) -> bool:
    """Whether a policy is a model of Stable-Baselines3 with all its training."""
    return isinstance(policy, loaded("stable_baselines3.common.base_class", "BaseAlgorithm"))


def unbound(function: Any) -> Any:
    """Return what a `functools.partial`, or several, calls."""
    while isinstance(function, partial):
        function = function.func
    return function


def _deterministic(act: Any) -> Act:
    """Return a function that explores only on request as one that does not explore."""
    function = unbound(act)
    explores = "deterministic" in _keywords(getattr(function, "forward", function))
    chosen = isinstance(act, partial) and "deterministic" in act.keywords
    return partial(act, deterministic=True) if explores and not chosen else cast("Act", act)


def _predicting(policy: Any, n: int) -> Act:
    """Return the function of observations of a policy in the form of Stable-Baselines3."""
    keywords = _keywords(policy.predict)
    if ("*" in keywords and "**" not in keywords) or "action_masks" in keywords:
        raise ValueError(
            "policy.predict must name what it takes of state, episode_start and deterministic "
            f"and need no action_masks, got {inspect.signature(policy.predict)}: use a function"
        )
    offered: dict[str, Any] = {"state": None, "episode_start": None, "deterministic": True}
    accepted = [name for name in offered if name in keywords or "**" in keywords]
    offered["episode_start"] = np.ones(n, np.bool_)

    def act(observations: Any) -> Any:
        actions = policy.predict(observations, **{name: offered[name] for name in accepted})
        offered["episode_start"] = np.zeros(n, np.bool_)
        if isinstance(actions, tuple):
            actions, offered["state"] = actions
        if offered["state"] is not None and "state" not in accepted:
            raise ValueError("policy.predict must take the state that it returns: state=None")
        return actions

    return act


def _keywords(function: Any) -> set[str]:
    """Return the names of a function's arguments, with their stars if they are many."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # of a function that is not written in Python
        return set()
    stars: dict[Any, str] = {Parameter.VAR_POSITIONAL: "*", Parameter.VAR_KEYWORD: "**"}
    return {stars.get(each.kind, each.name) for each in parameters}


def _evaluating(module: Any, act: Act, tensors: bool) -> Act:
    """Return the function of a `torch.nn.Module`, in evaluation mode and without gradients."""
    torch: Any = sys.modules["torch"]
    numbers = (*module.parameters(), *module.buffers())
    like = next(filter(torch.is_floating_point, numbers), torch.empty(0))

    def tensor(seen: Any) -> Any:
        if isinstance(seen, Mapping):
            return {name: tensor(each) for name, each in seen.items()}
        return torch.tensor(seen).to(like)

    def evaluating(observations: Any) -> Any:
        in_training = [part for part in module.modules() if part.training]
        module.eval()
        try:
            with torch.no_grad():
                actions = act(tensor(observations) if tensors else observations)
        finally:
            for part in in_training:
                part.training = True
        return np.array(actions.tolist()) if isinstance(actions, torch.Tensor) else actions

    return evaluating
