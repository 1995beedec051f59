"""Refuse environments that a policy was not trained or made for, as far as is known.

A model of Stable-Baselines3 and a controller in `agents` know something of their environments;
a function knows nothing.
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

# The classes of the models of Stable-Baselines3, which know the spaces of their training.
_MODELS: Final = (
    "stable_baselines3.common.base_class.BaseAlgorithm",
    "stable_baselines3.common.policies.BaseModel",
)


def check_fit(policy: Any, plants: Plants) -> None:
    """Raise a ValueError if a policy cannot be scored in these plants.

    Wrappers that normalise observations must have the statistics of a training, and must not
    run in other processes. A policy with a method `check_environment`, such as a controller in
    `agents`, checks the plants by this method. For a model of Stable-Baselines3, the plants
    must have the observation and action spaces of the model's training. If the model still has
    the environments of the training, the plants must also have the windows and wrappers of
    these environments.

    Parameters
    ----------
    policy
        A policy, as in `mptc_gym.evaluate`.
    plants
        A vector environment of Gymnasium in which the policy is to act.
    """
    for layer in layers(plants):
        if runs_processes(layer):
            _check_processes(layer)
        elif normaliser_flag(layer):
            _check_statistics(layer)
    model: Any = form_of(policy).target
    groups = plant_groups(plants)
    wrappers = {group.wrappers for group in groups}
    if hasattr(model, "check_environment"):
        names = ", ".join(sorted({name for chain in wrappers for name in chain}))
        model.check_environment(groups[0].parameters, names, plants.num_envs)
    is_model = isinstance(model, tuple(map(loaded, _MODELS)))
    if not is_model:
        return
    training = getattr(model, "env", None)
    groups_of_training = plant_groups(training) if is_environment(training) else []
    if groups_of_training:  # the list is empty if the training's processes are closed
        _compare(
            "windows (set points, errors, outputs, actions)",
            {group.parameters.windows for group in groups_of_training},
            {group.parameters.windows for group in groups},
        )
        _compare(
            "wrappers",
            {" of ".join(group.wrappers) or "none" for group in groups_of_training},
            {" of ".join(chain) or "none" for chain in wrappers},
        )
    observation_space = plants.single_observation_space
    _compare("observation space", [model.observation_space], [observation_space])
    _compare("action space", [model.action_space], [plants.single_action_space])


def _check_processes(layer: Any) -> None:
    """Raise a ValueError if a wrapper of Gymnasium normalises in other processes.

    `layer` is a vector environment that runs its environments in other processes.
    """
    if any(ask_processes(layer, "has_wrapper_attr", "update_running_mean")):
        raise ValueError(
            "env must not normalise in other processes, where statistics cannot be kept from "
            "changing: use DummyVecEnv or SyncVectorEnv"
        )


def _check_statistics(layer: Any) -> None:
    """Raise a ValueError if a wrapper normalises observations by initial statistics.

    `layer` is a wrapper that normalises. Statistics with mean 0 and variance 1 count as
    initial: no training has updated these statistics.
    """
    statistics = vars(layer).get("obs_rms", {})
    parts = statistics.values() if isinstance(statistics, dict) else [statistics]
    for part in parts:
        if not part.mean.any() and (part.var == 1.0).all():
            raise ValueError(
                f"env must have the statistics of the training in {type(layer).__name__}, got "
                "initial statistics: load or copy the statistics of the training"
            )


def _compare(what: str, of_training: Collection[Any], of_env: Collection[Any]) -> None:
    """Raise a ValueError if environments differ from those of a model's training.

    Parameters
    ----------
    what
        What is compared, for the message.
    of_training, of_env
        What the training has, and what the environments have: both a set of windows, both a set
        of wrapper names, or both a list with one space.
    """
    if of_training == of_env:
        return
    expected = " and ".join(sorted(map(_in_words, of_training)))
    received = " and ".join(sorted(map(_in_words, of_env)))
    raise ValueError(
        f"env must have the {what} of policy's training, {expected}, got {received}: use "
        "evaluate(model, model.get_env()), or spec_of(model, id) of mptc_gym.sb3, in the same "
        "VecNormalize and VecFrameStack"
    )


def _in_words(value: Any) -> str:
    """Return a value as text for a message: of a `Box`, the shape and the extreme bounds."""
    if not isinstance(value, Box):
        return str(value)
    return f"shape {value.shape} within {value.low.min():g} to {value.high.max():g}"
