"""Find out how a policy acts and what it was trained on."""

from __future__ import annotations

import inspect
import json
import zipfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec, WrapperSpec
from numpy.typing import NDArray

from mptc_gym.checks import reject
from mptc_gym.parameters import Parameters

Act = Callable[[NDArray[np.float32]], Any]  # observations, shape (n, size), to actions


def acting(policy: Any) -> Act:
    """Reset a policy for a batch of episodes, and return its function of observations."""
    predicts, acts = (callable(getattr(policy, name, None)) for name in ("predict", "act"))
    if isinstance(policy, type) or not (predicts or acts or callable(policy)):
        reject(
            "policy", policy, "a function, or an object with predict or with act, not a class"
        )
    if predicts:
        return _predicting(policy)
    if not acts:
        return cast("Act", policy)
    getattr(policy, "reset", lambda: None)()
    return cast("Act", policy.act)


def _predicting(policy: Any) -> Act:
    """Return the function of observations of a policy in the form of Stable-Baselines3."""
    known = inspect.signature(policy.predict).parameters
    normalise = normaliser_of(policy)
    state, begins = None, True

    def act(observations: NDArray[np.float32]) -> Any:
        nonlocal state, begins
        starts = np.full(len(observations), begins)
        begins = False
        offered = {"state": state, "episode_start": starts, "deterministic": True}
        told = {name: value for name, value in offered.items() if name in known}
        actions = policy.predict(normalise(observations), **told)
        if isinstance(actions, tuple):
            actions, state = actions
        return actions

    return act


def normaliser_of(policy: Any) -> Callable[[NDArray[Any]], NDArray[Any]]:
    """Return the function that normalises a policy's observations as in its training.

    Raise ValueError if the statistics of its `VecNormalize` are lost.
    """
    live = getattr(policy, "get_vec_normalize_env", lambda: None)()
    if live is not None:
        return cast("Callable[[NDArray[Any]], NDArray[Any]]", live.normalize_obs)
    space = getattr(policy, "observation_space", None)
    kept = getattr(space, "normalised", None)
    if kept is not None:
        mean, most = np.array(kept["mean"]), kept["clip_obs"]
        deviation = np.sqrt(np.array(kept["var"]) + kept["epsilon"])
        return lambda seen: np.clip((seen - mean) / deviation, -most, most).astype(np.float32)
    # An on-policy model keeps original observations if and only if it is normalised.
    normalised = getattr(policy, "_last_original_obs", None) is not None
    if normalised and hasattr(policy, "rollout_buffer") and not hasattr(space, "trained_on"):
        raise ValueError(
            "policy must come with the statistics of the VecNormalize that it was trained in: "
            "save it by mptc_gym.sb3.save"
        )
    return lambda seen: seen


def trained_on(policy: Any) -> EnvSpec | None:
    """Return the spec of the environment that a policy was trained on, or None if unknown.

    `mptc_gym.sb3` stores it in the observation space; a Stable-Baselines3 model that was not
    loaded from a file still has its environments. A path is that of a saved model.
    """
    if isinstance(policy, str | Path):
        return _saved_spec(policy)
    text = getattr(getattr(policy, "observation_space", None), "trained_on", None)
    if text is not None:
        return EnvSpec.from_json(text)
    with suppress(AttributeError):  # not a model, no environments, or no spec
        return cast("EnvSpec | None", policy.get_env().get_attr("spec")[0])
    return None


def _saved_spec(path: str | Path) -> EnvSpec | None:
    """Return the training spec in a Stable-Baselines3 zip, without running code from it."""
    try:
        with zipfile.ZipFile(path) as archive:
            data = json.loads(archive.read("data"))
        text = data["observation_space"].get("trained_on")
        return None if text is None else EnvSpec.from_json(text)
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}") from error
    except (zipfile.BadZipFile, KeyError, ValueError, AttributeError, TypeError) as error:
        raise ValueError(f"{path} must be a model that Stable-Baselines3 saved") from error


def action_wrappers(spec: EnvSpec) -> list[WrapperSpec]:
    """Return the wrappers of a spec, except those that only observe."""
    watching = "Monitor", "RecordEpisodeStatistics", "RecordVideo"
    return [each for each in spec.additional_wrappers if each.name not in watching]


def check_fit(policy: Any, env: gymnasium.Env[Any, Any], parameters: Parameters) -> None:
    """Refuse an environment whose observations or wrappers do not fit a policy."""
    normaliser_of(policy)
    shape, own = env.observation_space.shape, getattr(policy, "observation_space", None)
    if own is not None and own.shape != shape:
        raise ValueError(
            f"env must have observations of shape {own.shape}, as policy reads them, got "
            f"{shape}: give it the windows of the training, such as action_window=20, or take "
            "mptc_gym.sb3.spec_of(policy)"
        )
    place, wanted = getattr(policy, "error_index", None), getattr(policy, "observation", {})
    if place is not None:
        if place != parameters.heads[0] or not parameters.error_window:
            raise ValueError(
                f"env must show its newest error as element {place} of the observation, where "
                f"policy reads it, got windows {parameters.windows}"
            )
    elif isinstance(wanted, Mapping) and any(
        getattr(parameters, name) != value for name, value in wanted.items()
    ):
        asked = ", ".join(f"{name}={value}" for name, value in wanted.items())
        raise ValueError(
            f"env must have the windows that policy wants, {asked}, got {parameters.windows}"
        )
    spec = trained_on(policy)
    if spec is not None and env.spec is not None:
        there = action_wrappers(env.spec)
        for each in action_wrappers(spec):
            if each not in there:
                raise ValueError(
                    f"env must have the wrapper that policy was trained with, {each.name}"
                    f"({each.kwargs}): give it as an EnvSpec, see mptc_gym.sb3.spec_of"
                )
