"""Raise an error if a policy was trained or made for other environments.

A model of Stable-Baselines3 stores the spaces of the training environments, and a controller in
`agents` stores the actuator's limits and the order of the observation. A policy that is a plain
function stores nothing that can be checked.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, Final

from gymnasium.spaces import Box

from mptc_gym.environments.layers import (
    ask_processes,
    is_environment,
    layers,
    loaded,
    normaliser_flag,
    plant_groups,
    runs_processes,
)
from mptc_gym.scoring.opening import Plants
from mptc_gym.scoring.policies import form_of

# Classes of Stable-Baselines3 whose objects store the spaces of the training environments:
# models (such as `PPO`), and the policy networks `model.policy`.
_MODELS: Final = (
    "stable_baselines3.common.base_class.BaseAlgorithm",
    "stable_baselines3.common.policies.BaseModel",
)


def check_fit(policy: Any, plants: Plants) -> None:
    """Raise a ValueError if a policy cannot be scored in the vector environment `plants`.

    The reason is one of four: a worker process of `plants` has a wrapper that normalises; a
    wrapper has untrained statistics; the policy's method `check_environment` refuses the
    plants; or the policy is a model of Stable-Baselines3 that was trained with other spaces,
    observation windows or wrappers.
    """
    for layer in layers(plants):
        if runs_processes(layer):
            _refuse_normalisers_in_processes(layer)
        elif normaliser_flag(layer):
            _refuse_untrained_statistics(layer)
    target = form_of(policy).target
    if hasattr(target, "check_environment"):
        groups = plant_groups(plants)
        wrappers = {name for group in groups for name in group.wrappers}
        target.check_environment(
            groups[0].parameters, ", ".join(sorted(wrappers)), plants.num_envs
        )
    if isinstance(target, tuple(map(loaded, _MODELS))):
        _check_training(target, plants)


def _refuse_normalisers_in_processes(vector_env: Any) -> None:
    """Raise a ValueError if a worker process of `vector_env` has a wrapper that normalises."""
    if any(ask_processes(vector_env, "has_wrapper_attr", "update_running_mean")):
        raise ValueError(
            "env must not normalise in other processes, where evaluate cannot stop the updates "
            "of the statistics: use DummyVecEnv or SyncVectorEnv"
        )


def _refuse_untrained_statistics(normaliser: Any) -> None:
    """Raise a ValueError if a wrapper normalises observations by untrained statistics."""
    # A wrapper that normalises only rewards has no attribute `obs_rms`.
    statistics = vars(normaliser).get("obs_rms", {})
    # For dict observations, a VecNormalize has a dict of statistics.
    parts = statistics.values() if isinstance(statistics, dict) else [statistics]
    for part in parts:
        if not part.mean.any() and (part.var == 1.0).all():
            raise ValueError(
                "env must have the normalisation statistics of the policy's training in "
                f"{type(normaliser).__name__}, got initial statistics (mean 0, variance 1): "
                "load or copy the statistics of the training"
            )


def _check_training(model: Any, plants: Plants) -> None:
    """Raise a ValueError if plants differ from the plants of a model's training.

    The observation windows and wrappers of the plants are compared with those of the training
    only if the model still has its training environments.
    """
    training = getattr(model, "env", None)
    # `training_groups` is empty, for example, if the training environments ran in processes
    # that are now closed.
    training_groups = plant_groups(training) if is_environment(training) else []
    if training_groups:
        groups = plant_groups(plants)
        _compare(
            "windows (set points, errors, outputs, actions)",
            {group.parameters.windows for group in training_groups},
            {group.parameters.windows for group in groups},
        )
        _compare(
            "wrappers",
            {" of ".join(group.wrappers) or "none" for group in training_groups},
            {" of ".join(group.wrappers) or "none" for group in groups},
        )
    # Spaces are passed in lists, because a space is not hashable.
    _compare("observation space", [model.observation_space], [plants.single_observation_space])
    _compare("action space", [model.action_space], [plants.single_action_space])


def _compare(name: str, of_training: Collection[Any], of_env: Collection[Any]) -> None:
    """Raise a ValueError if `env` and training environments differ in the property `name`."""
    if of_training == of_env:
        return
    expected = " and ".join(sorted(map(_in_words, of_training)))
    received = " and ".join(sorted(map(_in_words, of_env)))
    raise ValueError(
        f"env must have the {name} of policy's training, {expected}, got {received}: use "
        "evaluate(model, model.get_env()), or spec_of(model, id) of mptc_gym.sb3, and wrap env "
        "in each VecNormalize and VecFrameStack of the training"
    )


def _in_words(value: Any) -> str:
    """Return a value as text for an error message; for a `Box`, the shape and the bounds."""
    if not isinstance(value, Box):
        return str(value)
    return f"shape {value.shape} within {value.low.min():g} to {value.high.max():g}"
