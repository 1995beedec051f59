"""Refuse environments that a policy was not trained or made for, as far as this is known.

A model of Stable-Baselines3 stores the spaces of its training, and a controller in `agents`
stores the actuator that it was made for. A function stores neither.
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

# The classes of Stable-Baselines3 whose objects know the spaces of their training: models, and
# policies of models.
_MODELS: Final = (
    "stable_baselines3.common.base_class.BaseAlgorithm",
    "stable_baselines3.common.policies.BaseModel",
)


def check_fit(policy: Any, plants: Plants) -> None:
    """Raise a ValueError if a policy cannot be scored in these plants.

    Wrappers that normalise observations must have the statistics of a training, and must not
    run in other processes. A controller with a method `check_environment` checks the plants by
    this method. For a model of Stable-Baselines3, the plants must have the spaces, the windows
    and the wrappers of the model's training.
    """
    for layer in layers(plants):
        if runs_processes(layer):
            _check_processes(layer)
        elif normaliser_flag(layer):
            _check_statistics(layer)
    target = form_of(policy).target
    if hasattr(target, "check_environment"):
        groups = plant_groups(plants)
        wrappers = {name for group in groups for name in group.wrappers}
        target.check_environment(
            groups[0].parameters, ", ".join(sorted(wrappers)), plants.num_envs
        )
    if isinstance(target, tuple(map(loaded, _MODELS))):
        _check_training(target, plants)


def _check_processes(vector_env: Any) -> None:
    """Raise a ValueError if a wrapper of Gymnasium normalises in other processes.

    `vector_env` is a vector environment that runs its environments in other processes.
    """
    if any(ask_processes(vector_env, "has_wrapper_attr", "update_running_mean")):
        raise ValueError(
            "env must not normalise in other processes, where statistics cannot be kept from "
            "changing: use DummyVecEnv or SyncVectorEnv"
        )


def _check_statistics(normaliser: Any) -> None:
    """Raise a ValueError if a wrapper normalises observations by initial statistics.

    Statistics with mean 0 and variance 1 are initial statistics: no training has updated them.
    """
    # A wrapper of rewards alone has no statistics of observations.
    statistics = vars(normaliser).get("obs_rms", {})
    # Of dict observations, a VecNormalize has statistics for each part.
    parts = statistics.values() if isinstance(statistics, dict) else [statistics]
    for part in parts:
        if not part.mean.any() and (part.var == 1.0).all():
            raise ValueError(
                f"env must have the statistics of the training in {type(normaliser).__name__}, "
                "got initial statistics: load or copy the statistics of the training"
            )


def _check_training(model: Any, plants: Plants) -> None:
    """Raise a ValueError if plants differ from those with which a model was trained.

    `model` is a model of Stable-Baselines3, or the attribute `policy` of a model. Windows and
    wrappers are compared only if the model still has the environments of its training.
    """
    training = getattr(model, "env", None)
    # The list is empty if the environments of the training are in processes that are closed.
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
    # Spaces are in lists, as sets cannot hold them.
    _compare("observation space", [model.observation_space], [plants.single_observation_space])
    _compare("action space", [model.action_space], [plants.single_action_space])


def _compare(name: str, of_training: Collection[Any], of_env: Collection[Any]) -> None:
    """Raise a ValueError if a property of a model's training and of `env` has other values.

    `name` is the name of the property, such as "action space".
    """
    if of_training == of_env:
        return
    expected = " and ".join(sorted(map(_in_words, of_training)))
    received = " and ".join(sorted(map(_in_words, of_env)))
    raise ValueError(
        f"env must have the {name} of policy's training, {expected}, got {received}: use "
        "evaluate(model, model.get_env()), or spec_of(model, id) of mptc_gym.sb3, in the same "
        "VecNormalize and VecFrameStack"
    )


def _in_words(value: Any) -> str:
    """Return a value as text for a message: of a `Box`, the shape and the extreme bounds."""
    if not isinstance(value, Box):
        return str(value)
    return f"shape {value.shape} within {value.low.min():g} to {value.high.max():g}"
