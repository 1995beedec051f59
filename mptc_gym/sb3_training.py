"""Read how a model of Stable-Baselines3 was trained from the environments that it has."""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable
from typing import Any, Final, cast

import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecCheckNan,
    VecEnv,
    VecEnvWrapper,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
    VecVideoRecorder,
)
from stable_baselines3.common.vec_env.stacked_observations import StackedObservations

from mptc_gym.sb3_vec_env import GymnasiumVecEnv
from mptc_gym.training import (
    WAYS_OUT,
    Training,
    Wrappers,
    acting_wrappers,
    entry_point,
    wrappers_of,
)
from mptc_gym.vector_env import MiddlePointVectorEnv


def training_of(model: Any) -> Training:
    """Return how a model was trained, from the environments that it still has.

    Raises
    ------
    ValueError
        If the model has none, or if they hold anything that changes what the model sees or
        does in a way that is not known here.
    """
    plants, vec_wrappers = _chain(model)
    found = [Training.of(*each, plants) for each in _parts(plants)]
    if len({repr((each.plant, each.windows, each.wrappers)) for each in found}) > 1:
        raise ValueError("policy was trained on plants of different windows or wrappers")
    return dataclasses.replace(
        found[0],
        algorithm=entry_point(type(model)),
        vec_wrappers=tuple(map(_recorded, vec_wrappers)),
        n_envs=plants.num_envs,
    )


def _parts(plants: VecEnv) -> list[tuple[Any, EnvSpec | None, Wrappers]]:
    """Return the core, the spec and the wrappers of each environment, or of each batch."""
    if isinstance(plants, DummyVecEnv):
        return [(each.unwrapped, each.spec, wrappers_of(each)) for each in plants.envs]
    if isinstance(plants, GymnasiumVecEnv):
        spec, batches = plants.spec, plants.batches
        if spec is None and any(type(each) is not MiddlePointVectorEnv for each in batches):
            raise ValueError(
                "policy was trained on a batch whose wrappers are not known: make it by "
                "mptc_gym.sb3.make_vec_env"
            )
        wrappers = acting_wrappers(spec.additional_wrappers if spec else ())
        return [(each.unwrapped, spec, wrappers) for each in batches]
    try:
        cores, specs = plants.get_attr("unwrapped"), plants.get_attr("spec")
    except (OSError, EOFError) as error:  # from the pipes of a SubprocVecEnv
        raise ValueError(
            "the environments of policy's training are closed, or their processes cannot send "
            "them: evaluate and save policy before they are closed, and train on "
            f"mptc_gym.sb3.make_vec_env or a DummyVecEnv ({error!r})"
        ) from error
    wrapped = [acting_wrappers(each.additional_wrappers) for each in specs]
    return [*zip(cores, specs, wrapped, strict=True)]


def preparation(model: Any, n: int) -> Callable[[NDArray[Any]], NDArray[Any]]:
    """Return the function from n observations to what a model sees, as in its training.

    It belongs to one batch of episodes, whose observations it takes one after the other.
    """
    steps: list[Callable[[Any], Any]] = []
    for each in _chain(model)[1]:
        if isinstance(each, VecNormalize):
            if each.norm_obs:
                steps.append(each.normalize_obs)
        else:
            steps.append(_stack(cast("VecFrameStack", each), n))
    return lambda seen: functools.reduce(lambda x, step: step(x), steps, seen)


def _stack(wrapper: VecFrameStack, n: int) -> Callable[[NDArray[Any]], NDArray[Any]]:
    """Return the function that stacks the frames of n episodes."""
    space = cast("Box", wrapper.venv.observation_space)
    frames = StackedObservations[NDArray[Any]](n, observation_space=space, **_frames(wrapper))
    running = np.zeros(n, np.bool_)
    return lambda seen: frames.update(seen, running, [{}] * n)[0]


def _chain(model: Any) -> tuple[VecEnv, list[VecEnvWrapper]]:
    """Return a model's environments and the wrappers that act on them, the innermost first."""
    plants: Any = model.get_env() if isinstance(model, BaseAlgorithm) else None
    if plants is None:
        raise ValueError(f"policy does not say how it was trained: {WAYS_OUT}")
    wrappers: list[VecEnvWrapper] = []
    while type(plants) in (*_ACTING, *_WATCHING):
        if type(plants) in _ACTING:
            wrappers.insert(0, plants)
        plants = plants.venv
    if type(plants) not in (GymnasiumVecEnv, DummyVecEnv, SubprocVecEnv):
        raise ValueError(
            f"policy was trained in {type(plants).__name__}, and what that does is not known "
            "here: put it into a gymnasium.Wrapper, or vouch for it by a function of the "
            "observations"
        )
    # Off-policy algorithms keep the original observation in any case: nothing tells.
    normalised = isinstance(model, OnPolicyAlgorithm) and model._last_original_obs is not None
    if normalised and not any(isinstance(each, VecNormalize) for each in wrappers):
        raise ValueError(
            f"policy was trained in VecNormalize, and its environments now lack it: {WAYS_OUT}"
        )
    for each in wrappers:
        sees = isinstance(each, VecFrameStack) or cast("VecNormalize", each).norm_obs
        if sees and not isinstance(each.venv.observation_space, Box):
            raise ValueError(
                f"policy was trained in {type(each).__name__} on observations that are not a "
                "Box: train in gymnasium.wrappers.FlattenObservation"
            )
        if isinstance(each, VecNormalize) and each.norm_obs:
            seen = cast("RunningMeanStd", each.obs_rms).count
            if seen < (max(model.num_timesteps, 1) if each.training else 1):
                raise ValueError(
                    f"policy has learnt from {model.num_timesteps:,} samples and its "
                    f"VecNormalize has seen {seen:,.0f}, so these are not the statistics of "
                    "its training: load them by VecNormalize.load, or all of it by "
                    "mptc_gym.sb3.load"
                )
    return plants, wrappers


_ACTING: Final = VecNormalize, VecFrameStack
_WATCHING: Final = VecCheckNan, VecMonitor, VecVideoRecorder
_STATISTICS: Final = "obs_rms", "ret_rms"  # of VecNormalize


def _recorded(wrapper: VecEnvWrapper) -> dict[str, Any]:
    """Return a `VecFrameStack` or a `VecNormalize` by its arguments and statistics."""
    if isinstance(wrapper, VecFrameStack):
        return {"name": "VecFrameStack", **_frames(wrapper)}
    _, *arguments = inspect.signature(VecNormalize).parameters
    found = {name: getattr(wrapper, name) for name in arguments}
    found |= {
        name: vars(getattr(wrapper, name)) for name in _STATISTICS if hasattr(wrapper, name)
    }
    return {"name": "VecNormalize", **found}


def _frames(wrapper: VecFrameStack) -> dict[str, Any]:
    order = "first" if wrapper.stacked_obs.channels_first else "last"
    return {"n_stack": wrapper.stacked_obs.n_stack, "channels_order": order}


def restored(plants: VecEnv, name: str, **about: Any) -> VecEnvWrapper:
    """Return environments in a wrapper that `_recorded` wrote down."""
    if name == "VecFrameStack":
        return VecFrameStack(plants, **about)
    if name != "VecNormalize":
        raise ValueError(f"{name} is not known here")
    statistics = {each: about.pop(each) for each in _STATISTICS if each in about}
    wrapper = VecNormalize(plants, **about)
    for each, parts in statistics.items():
        vars(getattr(wrapper, each)).update(parts)
    return wrapper
