"""Refuse environments that a policy was not made for, as far as the policy can tell."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final

from gymnasium.spaces import Box, Space

from mptc_gym.adapters import Plants
from mptc_gym.layers import (
    Chain,
    PlantGroup,
    is_environment,
    loaded,
    plant_groups,
    wrapper_chains,
)
from mptc_gym.policies import object_of

_MODELS: Final = (
    "stable_baselines3.common.base_class.BaseAlgorithm",
    "stable_baselines3.common.policies.BaseModel",
)
_REMEDY: Final = (
    "use evaluate(model, model.get_env()), or spec_of(model, id) of mptc_gym.sb3, in the same "
    "VecNormalize and VecFrameStack"
)


def check_fit(policy: Any, plants: Plants) -> None:
    """Raise a ValueError if a policy was not made for these plants.

    A policy with a method `check_environment`, as those in `agents`, judges for itself. A model
    of Stable-Baselines3 knows its spaces and, as long as it has them, its environments, whose
    windows and wrappers must be the same.
    """
    target: Any = object_of(policy)
    chains = _chains(plants.environments)
    if hasattr(target, "check_environment"):
        wrappers = ", ".join(sorted({wrapper for chain in chains for wrapper in chain}))
        target.check_environment(plants.groups[0].parameters, wrappers, plants.num_envs)
    is_model = isinstance(target, tuple(map(loaded, _MODELS)))
    if not is_model:
        return
    training = getattr(target, "env", None)
    if is_environment(training) and plant_groups(training):  # they are not when closed
        _compare_windows(plant_groups(training), plants.groups)
        _compare_wrappers(wrapper_chains(training), chains)
    _compare_spaces("observation", target.observation_space, plants.observation_space)
    _compare_spaces("action", target.action_space, plants.action_space)


def _compare_windows(of_training: list[PlantGroup], of_env: list[PlantGroup]) -> None:
    """Refuse other windows than those of the training."""
    expected = {group.parameters.windows for group in of_training}
    windows = {group.parameters.windows for group in of_env}
    if windows != expected:
        raise ValueError(
            "env must have the windows of policy's training, in the order set points, errors, "
            f"outputs, actions: {_listed(expected)}, got {_listed(windows)}: {_REMEDY}"
        )


def _compare_wrappers(of_training: set[Chain], of_env: set[Chain]) -> None:
    """Refuse other wrappers than those of the training."""
    if of_env != of_training:
        expected = _listed(map(_in_words, of_training))
        wrappers = _listed(map(_in_words, of_env))
        raise ValueError(
            f"env must have the wrappers of policy's training, {expected}, got {wrappers}: "
            f"{_REMEDY}"
        )


def _chains(environments: list[Any]) -> set[Chain]:
    """Return the wrappers of the plants in environments: see `wrapper_chains`."""
    chains: set[Chain] = set()
    for env in environments:
        chains |= wrapper_chains(env)
    return chains


def _compare_spaces(kind: str, of_training: Space[Any], of_env: Space[Any]) -> None:
    """Refuse another space than that of the training."""
    if of_training != of_env:
        raise ValueError(
            f"env must have the same {kind} space as in the training of policy, "
            f"{_shape(of_training)}, got {_shape(of_env)}: {_REMEDY}"
        )


def _shape(space: Space[Any]) -> str:
    """Return what tells a space from others, in a few words."""
    if not isinstance(space, Box):
        return str(space)
    return f"shape {space.shape} within {space.low.min():g} to {space.high.max():g}"


def _in_words(chain: Chain) -> str:
    return " of ".join(chain) or "none"


def _listed(values: Iterable[Any]) -> str:
    return " and ".join(sorted(map(str, values)))
