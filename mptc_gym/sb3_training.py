"""Train with Stable-Baselines3 on batches of environments, and read how a model was trained.

What a model was trained on is read from the environments that it still has.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import time
from collections.abc import Callable, Sequence
from typing import Any, Final, cast

import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
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
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn
from stable_baselines3.common.vec_env.stacked_observations import StackedObservations

from mptc_gym.training import (
    WAYS_OUT,
    Training,
    Wrappers,
    acting_wrappers,
    entry_point,
    wrappers_of,
)
from mptc_gym.vector_env import MiddlePointVectorEnv


class GymnasiumVecEnv(VecEnv):
    """Step whole batches at once, where `DummyVecEnv` steps one environment after another.

    Observations, rewards, episode ends and terminal observations are bit for bit those of
    `DummyVecEnv` with the same environments.

    Parameters
    ----------
    batches
        One or more vector environments of autoreset mode "SameStep" and with the same spaces;
        their environments are numbered one batch after another.
    spec
        Spec of one environment with its wrappers, if all are alike: a model trained on them
        records it.
    group
        Number of neighbouring environments that share a seed, and thus what is drawn.

    Attributes
    ----------
    infos : dict
        The latest infos in Gymnasium's form, as arrays; those that all batches have. The list
        that `step` returns holds only what Stable-Baselines3 itself reads at the end of an
        episode, as a dict for each environment and step would take longer than the step.

    Raises
    ------
    ValueError
        If a batch has another autoreset mode, or spaces differ.
    """

    def __init__(
        self, *batches: VectorEnv, spec: EnvSpec | None = None, group: int = 1
    ) -> None:
        spaces = batches[0].single_observation_space, batches[0].single_action_space
        for batch in batches:
            mode = batch.metadata.get("autoreset_mode")
            if mode is not AutoresetMode.SAME_STEP:
                raise ValueError(f"batches must have autoreset_mode 'SameStep', got {mode}")
            if (batch.single_observation_space, batch.single_action_space) != spaces:
                raise ValueError(f"batches must have the same spaces, got {batches}")
        self.batches, self.spec, self.group = batches, spec, group
        self.infos: dict[str, Any] = {}
        starts = np.cumsum([0, *(batch.num_envs for batch in batches)]).tolist()
        self._parts = list(zip(batches, map(slice, starts, starts[1:]), strict=True))
        super().__init__(starts[-1], *spaces)
        self._began = time.time()
        self._returns = np.zeros(self.num_envs)
        self._lengths = np.zeros(self.num_envs, np.int64)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Set the seeds of the next reset: environment i has `seed + i // group`."""
        first, *_ = super().seed(seed)
        self._seeds = [cast("int", first) + i // self.group for i in range(self.num_envs)]
        return self._seeds

    def reset(self) -> NDArray[Any]:
        """Reset all environments, with the seeds set by `seed`."""
        if any(self._options):
            raise ValueError(f"options must be empty, got {self._options!r}")
        resets = [
            # It takes one seed per environment, despite its annotation.
            batch.reset(seed=cast("int", list(self._seeds[part])))
            for batch, part in self._parts
        ]
        self._reset_seeds()
        self._returns[:], self._lengths[:] = 0.0, 0
        return self._joined(resets)[0]

    def step_async(self, actions: NDArray[Any]) -> None:
        """Store the actions, shape (num_envs, action size)."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step with the stored actions."""
        steps = [batch.step(self._actions[part]) for batch, part in self._parts]
        observations, rewards, terminated, truncated = self._joined(steps)
        ended = terminated | truncated
        self._returns += rewards
        self._lengths += 1
        infos: list[dict[str, Any]] = [{} for _ in ended]
        if ended.any():
            last = np.concatenate(
                [found.get("final_obs", [None] * len(flags)) for *_, flags, found in steps]
            )
            seconds = round(time.time() - self._began, 6)
            for i in np.flatnonzero(ended).tolist():
                episode = {"r": float(self._returns[i]), "l": int(self._lengths[i])}
                infos[i] = {
                    "terminal_observation": last[i],
                    "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
                    "episode": {**episode, "t": seconds},
                }
            self._returns[ended], self._lengths[ended] = 0.0, 0
        return observations, rewards.astype(np.float32), ended, infos

    def _joined(self, returned: list[tuple[Any, ...]]) -> list[NDArray[Any]]:
        """Concatenate what the batches returned, and store the infos in `infos`."""
        *arrays, infos = zip(*returned, strict=True)
        self.infos = {
            name: np.concatenate([each[name] for each in infos])
            for name in set.intersection(*map(set, infos))
            if isinstance(infos[0][name], np.ndarray)
        }
        return [np.concatenate(each) for each in arrays]

    def get_images(self) -> list[NDArray[np.uint8]]:
        """Return a picture of each environment, if the batch has the mode "rgb_array"."""
        return [image for batch in self.batches for image in cast("Any", batch.render() or ())]

    def close(self) -> None:
        """Close the batches."""
        for batch in self.batches:
            batch.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of each environment's batch."""
        if attr_name == "spec" and self.spec is not None:
            return [self.spec for _ in self._get_indices(indices)]
        of_each = [batch for batch in self.batches for _ in range(batch.num_envs)]
        return [getattr(of_each[i], attr_name) for i in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Refuse: an environment of a batch has no attributes of its own."""
        raise NotImplementedError(f"{attr_name} can be set on `batches` only, for all at once")

    def env_method(
        self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        """Refuse: an environment of a batch has no methods of its own."""
        raise NotImplementedError(
            f"{method_name} can be called on `batches` only, for all at once"
        )

    def env_is_wrapped(self, wrapper_class: Any, indices: VecEnvIndices = None) -> list[bool]:
        """Return False for each index: a batch holds no wrapped environments."""
        return [False for _ in self._get_indices(indices)]


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
