"""Run any policy: find out whether it fits an environment and how it acts, and let it act."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from inspect import Parameter
from typing import Any, NamedTuple, cast

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from mptc_gym.checks import reject, shorten
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
            "policy",
            policy,
            "a function, or an object with predict, such as mptc_gym.sb3.load(path), or with "
            "act, not a class",
        )
    owner = _owner(policy)
    reset = getattr(owner, "reset", None)
    if callable(reset) and not isinstance(owner, type):
        _check_call(reset, "policy.reset", "no argument")
        reset()
    act = _predicting(policy, n) if predicts else _deterministic(policy.act if acts else policy)
    if _is_instance(owner, "torch.nn", "Module"):
        return _evaluating(owner, act, tensors=not (predicts or acts or owner is not policy))
    return act


def _owner(policy: Any) -> Any:
    """Return a policy; of a method, such as `controller.act`, its object."""
    while isinstance(policy, partial):
        policy = policy.func
    return getattr(policy, "__self__", policy)


def _deterministic(act: Any) -> Act:
    """Return a function that explores only on request as one that does not explore."""
    explores = "deterministic" in _keywords(getattr(act, "forward", act))
    return partial(act, deterministic=True) if explores else cast("Act", act)


def _predicting(policy: Any, n: int) -> Act:
    """Return the function of observations of a policy in the form of Stable-Baselines3."""
    offered: dict[str, Any] = {"state": None, "episode_start": None, "deterministic": True}
    keywords = _keywords(policy.predict)
    if "*" in keywords and "**" not in keywords:
        raise ValueError(
            "policy.predict must name its arguments, such as state, episode_start and "
            f"deterministic, or take **kwargs, got {inspect.signature(policy.predict)}"
        )
    accepted = [name for name in offered if name in keywords or "**" in keywords]
    _check_call(
        policy.predict, "policy.predict", "the observations", 0, **dict.fromkeys(accepted)
    )
    prepare: Act = lambda seen: seen  # noqa: E731
    if is_model(policy):
        from mptc_gym import sb3_training

        prepare = sb3_training.preparation(policy, n)
    offered["episode_start"] = np.ones(n, np.bool_)

    def act(observations: NDArray[np.float32]) -> Any:
        given = {name: offered[name] for name in accepted}
        actions = policy.predict(prepare(observations), **given)
        offered["episode_start"] = np.zeros(n, np.bool_)
        if isinstance(actions, tuple):
            actions, offered["state"] = actions
        if offered["state"] is not None and "state" not in accepted:
            raise ValueError("policy.predict must take the state that it returns: state=None")
        return actions

    return act


def _keywords(function: Any) -> set[str]:
    """Return the names of a function's arguments, as far as they can be known.

    "*" stands for arguments that have no names, and "**" for any further names.
    """
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return set()
    marks: dict[Any, str] = {Parameter.VAR_POSITIONAL: "*", Parameter.VAR_KEYWORD: "**"}
    return {marks.get(each.kind, each.name) for each in parameters}


def _check_call(
    method: Callable[..., Any], name: str, what: str, *given: Any, **named: Any
) -> None:
    """Refuse a method that needs more arguments than it gets."""
    try:
        inspect.signature(method).bind(*given, **named)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be a method that needs {what} alone: {error}") from error


def _evaluating(module: Any, act: Act, tensors: bool) -> Act:
    """Return the function of a `torch.nn.Module`, in evaluation mode and without gradients."""
    torch: Any = sys.modules["torch"]
    numbers = (*module.parameters(), *module.buffers())
    like = next(filter(torch.is_floating_point, numbers), torch.empty(0))

    def evaluating(observations: NDArray[np.float32]) -> Any:
        in_training = [part for part in module.modules() if part.training]
        module.eval()
        try:
            with torch.no_grad():
                actions = act(torch.tensor(observations).to(like) if tensors else observations)
        finally:
            for part in in_training:
                part.training = True
        return np.array(actions.tolist()) if isinstance(actions, torch.Tensor) else actions

    return evaluating


def check_fit(
    policy: Any, env: gymnasium.Env[Any, Any], parameters: Parameters, episodes: int
) -> None:
    """Refuse an environment that a policy was not trained or set up for.

    Raises
    ------
    ValueError
        If they differ, or if a model does not say how it was trained.
    """
    predict = getattr(policy, "predict", None)
    if env.has_wrapper_attr("action_masks") and "action_masks" in _keywords(predict):
        raise ValueError(
            "policy.predict takes the action_masks of env, which are not handed to it: give a "
            "function that finds the masks from the observations"
        )
    training = training_of(policy)
    if training is not None:
        training.check(env)
        return
    owner = _owner(policy)
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


class Step(NamedTuple):
    """What a step of a batch showed; the arrays have one element per plant."""

    before: dict[str, Any]
    """The infos at sample k."""
    after: dict[str, Any]
    """The infos at sample k + 1."""
    ended: NDArray[np.bool_]
    """Whether the episodes have ended."""


def rollout(
    plants: VectorEnv[Any, Any, Any],
    act: Callable[[Any], Any],
    samples: int,
    seed: int | list[int],
) -> Iterator[Step]:
    """Reset a batch with seeds from `seed` on, and step it through samples k = 0, 1, ...

    In place of a first seed, a list has that of each plant. This is the one loop, for scores,
    benchmarks and tests.

    `act` is called with the observations, shape (n, size), and returns the actions.

    Raises
    ------
    ValueError
        If actions have the wrong shape or are not finite.
    """
    # It takes a list as well, despite its annotation.
    observations, infos = plants.reset(seed=cast("int", seed))
    for k in range(samples):
        actions = _checked(act(observations), plants.action_space.shape, k)
        before = infos
        observations, _, terminated, truncated, infos = plants.step(actions)
        yield Step(before, infos, terminated | truncated)


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
