"""Find out how a policy acts, and whether it fits an environment."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Mapping
from inspect import Parameter
from typing import Any, cast

import gymnasium
import numpy as np
from numpy.typing import NDArray

from mptc_gym.checks import reject
from mptc_gym.parameters import Parameters
from mptc_gym.training import Training, wrappers_of

Act = Callable[[NDArray[np.float32]], Any]  # observations, shape (n, size), to actions


def is_model(policy: Any) -> bool:
    """Whether a policy is a model of Stable-Baselines3, or the policy inside one."""
    return _is_instance(policy, "stable_baselines3.common.base_class", "BaseAlgorithm") or (
        _is_instance(policy, "stable_baselines3.common.policies", "BaseModel")
    )


def _is_instance(policy: Any, module: str, name: str) -> bool:
    """Whether an object is of a class of a package that is only imported where it is used."""
    return module in sys.modules and isinstance(policy, getattr(sys.modules[module], name))


def training_of(policy: Any) -> Training | None:
    """Return how a model of Stable-Baselines3 was trained; None for any other policy.

    A model that does not say it is refused with a ValueError.
    """
    if not is_model(policy):
        return None
    from mptc_gym import sb3_training  # here: it needs Stable-Baselines3

    return sb3_training.training_of(policy)


def start(policy: Any, n: int) -> Act:
    """Reset a policy for a batch of n episodes, and return its function of observations."""
    predicts, acts = (callable(getattr(policy, name, None)) for name in ("predict", "act"))
    if isinstance(policy, type) or not (predicts or acts or callable(policy)):
        reject(
            "policy", policy, "a function, or an object with predict or with act, not a class"
        )
    # Of a bound method, such as controller.act, the object is reset.
    reset = getattr(getattr(policy, "__self__", policy), "reset", None)
    if callable(reset):
        _check_call(reset, "policy.reset", "no argument")
        reset()
    if predicts:
        return _predicting(policy, n)
    if acts:
        return cast("Act", policy.act)
    if _is_instance(policy, "torch.nn", "Module"):
        return _evaluating(policy)
    return cast("Act", policy)


def _predicting(policy: Any, n: int) -> Act:
    """Return the function of observations of a policy in the form of Stable-Baselines3."""
    accepted = _accepted(policy.predict)
    prepare: Act = lambda seen: seen  # noqa: E731
    if is_model(policy):
        from mptc_gym import sb3_training

        prepare = sb3_training.preparation(policy, n)
    state, begins = None, True

    def act(observations: NDArray[np.float32]) -> Any:
        nonlocal state, begins
        starts = np.full(n, begins)
        begins = False
        offered = {"state": state, "episode_start": starts, "deterministic": True}
        chosen = {name: value for name, value in offered.items() if name in accepted}
        actions = policy.predict(prepare(observations), **chosen)
        if isinstance(actions, tuple):
            actions, state = actions
        if state is not None and "state" not in accepted:
            raise ValueError("policy.predict must take the state that it returns: state=None")
        return actions

    return act


def _accepted(predict: Callable[..., Any]) -> set[str]:
    """Return which keywords `predict` takes; refuse one that hides what it reads."""
    offered = {"state", "episode_start", "deterministic"}
    try:
        parameters = inspect.signature(predict).parameters.values()
    except (TypeError, ValueError):
        reject("policy.predict", predict, "a method whose arguments can be inspected")
    kinds = [each.kind for each in parameters]
    if Parameter.VAR_KEYWORD in kinds:
        return offered
    if Parameter.VAR_POSITIONAL in kinds or Parameter.POSITIONAL_ONLY in kinds[1:]:
        raise ValueError(
            "policy.predict must name its arguments, such as state, episode_start and "
            f"deterministic, or take **kwargs, got {inspect.signature(predict)}"
        )
    accepted = offered.intersection(each.name for each in parameters)
    _check_call(predict, "policy.predict", "the observations", 0, **dict.fromkeys(accepted))
    return accepted


def _check_call(
    method: Callable[..., Any], name: str, what: str, *given: Any, **named: Any
) -> None:
    """Refuse a method that needs more arguments than it gets."""
    try:
        inspect.signature(method).bind(*given, **named)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be a method that needs {what} alone: {error}") from error


def _evaluating(module: Any) -> Act:
    """Return the function of observations of a `torch.nn.Module`, in evaluation mode."""
    torch: Any = sys.modules["torch"]
    weights = next(module.parameters(), torch.empty(0))

    def act(observations: NDArray[np.float32]) -> Any:
        trains = module.training
        module.eval()
        try:
            with torch.no_grad():
                actions = module(torch.as_tensor(observations).to(weights))
        finally:
            module.train(trains)
        return actions.cpu().numpy() if isinstance(actions, torch.Tensor) else actions

    return act


def check_fit(
    policy: Any, env: gymnasium.Env[Any, Any], parameters: Parameters, episodes: int
) -> None:
    """Refuse an environment that a policy was not trained or set up for.

    Raises
    ------
    ValueError
        If they differ, or if a model does not say how it was trained.
    """
    training = training_of(policy)
    if training is not None:
        training.check(env)
        return
    owner = getattr(policy, "__self__", policy)
    seen = getattr(getattr(owner, "observation_space", None), "shape", None)
    if seen not in (None, env.observation_space.shape):
        raise ValueError(
            f"env must have observations of shape {seen}, as policy reads them, got "
            f"{env.observation_space.shape}: give it the windows of the training"
        )
    place, wanted = getattr(owner, "error_index", None), getattr(owner, "observation", {})
    if place is not None and (place != parameters.heads[0] or not parameters.error_window):
        raise ValueError(
            f"env must show its newest error as element {place} of the observation, where "
            f"policy reads it, got windows {parameters.windows}"
        )
    if isinstance(wanted, Mapping) and any(
        getattr(parameters, name) != value for name, value in wanted.items()
    ):
        asked = ", ".join(f"{name}={value}" for name, value in wanted.items())
        raise ValueError(
            f"env must have the windows that policy wants, {asked}, got {parameters.windows}"
        )
    loops = getattr(owner, "num_envs", episodes)
    if loops != episodes:
        raise ValueError(
            f"policy must be made with num_envs={episodes}, one loop per episode, got "
            f"{loops or 1}"
        )
    limits = getattr(owner, "u_min", None), getattr(owner, "u_max", None)
    actuator = parameters.range_of("u_min")[0], parameters.range_of("u_max")[1]
    if None not in limits and limits != actuator:
        raise ValueError(
            f"policy must be made with the limits of env, u_min={actuator[0]}, "
            f"u_max={actuator[1]}, got {limits[0]}, {limits[1]}"
        )
    if None not in limits and wrappers_of(env):
        raise ValueError(
            "env must not be wrapped, as policy commands the flow of the plant itself, got "
            f"{', '.join(each.name for each in wrappers_of(env))}"
        )
