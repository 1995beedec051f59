"""Take environments as they are given: see what is in them, freeze it, reset all by seeds."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager, suppress
from typing import Any, Final

import gymnasium
import numpy as np
from gymnasium.vector import (
    SyncVectorEnv,
    VectorActionWrapper,
    VectorEnv,
    VectorObservationWrapper,
)  # fmt: skip
from gymnasium.vector.utils import batch_space
from gymnasium.wrappers import NormalizeObservation, NormalizeReward, vector

from mptc_gym.checks import reject, shorten
from mptc_gym.env import MiddlePointEnv
from mptc_gym.plant import action_from_command
from mptc_gym.policies import Step, loaded
from mptc_gym.vector_env import MiddlePointVectorEnv
from mptc_gym.wrappers import IncrementalAction
from mptc_gym.wrappers.vector import IncrementalAction as VectorIncrementalAction

PLANTS: Final = MiddlePointEnv, MiddlePointVectorEnv
_INCREMENTS: Final = IncrementalAction, VectorIncrementalAction
_INSIDE: Final = "venv", "env", "envs", "batches"  # attributes that hold the next layers
_NORMALISERS: Final = (
    NormalizeObservation, NormalizeReward, vector.NormalizeObservation, vector.NormalizeReward,
)  # fmt: skip
_ACTING: Final = (
    gymnasium.ActionWrapper, gymnasium.ObservationWrapper,
    VectorActionWrapper, VectorObservationWrapper,
)  # fmt: skip
_SB3: Final = "stable_baselines3.common.vec_env"
_TOLERANCE: Final = 1e-6  # of infos, degC or t/h


def is_vec_env(env: Any) -> bool:
    """Whether environments are a `VecEnv` of Stable-Baselines3."""
    return isinstance(env, loaded(_SB3, "VecEnv"))


def layers(env: Any) -> Iterator[Any]:
    """Yield environments and all that is in them, in this process, the outermost first."""
    yield env
    for name in _INSIDE:
        inside = vars(env).get(name, ())
        for each in inside if isinstance(inside, list | tuple) else (inside,):
            if isinstance(each, gymnasium.Env | VectorEnv) or is_vec_env(each):
                yield from layers(each)


def plants_of(env: Any) -> list[Any]:
    """Return the plants at the heart of environments; copies of those in other processes."""
    found = [each for each in layers(env) if isinstance(each, PLANTS)]
    if not found:
        with suppress(Exception):  # whatever a closed or a foreign one raises
            found = list(env.unwrapped.get_attr("unwrapped"))
    number = sum(getattr(each, "num_envs", 1) for each in found if isinstance(each, PLANTS))
    if number != getattr(env, "num_envs", 1):
        reject("env", env, "an open environment of MiddlePointEnv in NumPy, wrapped or not")
    return found


def increments(env: Any) -> set[Any]:
    """Return the arguments of `IncrementalAction` around plants; none if there is none."""
    if any(isinstance(each, PLANTS) for each in layers(env)):
        return {each._arguments for each in layers(env) if isinstance(each, _INCREMENTS)}
    specs = [spec for spec in env.get_attr("spec") if spec]  # from other processes
    wrappers = [each for spec in specs for each in spec.additional_wrappers]
    return {tuple(w.kwargs.values()) for w in wrappers if w.name == "IncrementalAction"}


def stacks_and_normalisers(env: Any) -> set[str]:
    """Return the wrappers of Stable-Baselines3 around plants that change observations."""
    return {
        name
        for name in ("VecNormalize", "VecFrameStack")
        for each in layers(env)
        if isinstance(each, loaded(_SB3, name)) and getattr(each, "norm_obs", True)
    }


def acting(env: Any) -> str:
    """Return the names of wrappers that change observations or actions."""
    found = {type(each).__name__ for each in layers(env) if isinstance(each, _ACTING)}
    return ", ".join(sorted(found | stacks_and_normalisers(env)))


class Given:
    """Environments as one batch: each gets a seed of its own, and infos are arrays."""

    def __init__(self, env: Any) -> None:
        self.env, self.num_envs, self._vec_env = env, env.num_envs, is_vec_env(env)
        self.inner = plants_of(env)
        of_one = "" if self._vec_env else "single_"
        self.single_observation_space = getattr(env, f"{of_one}observation_space")
        self.single_action_space = getattr(env, f"{of_one}action_space")
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(self, *, seed: Any = None) -> tuple[Any, Mapping[str, Any]]:
        """Reset all with a seed each."""
        try:
            if not self._vec_env:
                observations, infos = self.env.reset(seed=seed)
                return observations, _columns(infos)
            inner = self.env.unwrapped
            self.env.seed(seed[0])
            inner._seeds = list(seed)  # a batch may repeat seeds by its own `seed`
            return self.env.reset(), _columns(inner.reset_infos)
        except RuntimeError as error:
            if "before done" not in str(error):
                raise
            raise ValueError(
                "env is in the middle of an episode that its Monitor does not let it leave: "
                "wrap it in Monitor(env, allow_early_resets=True)"
            ) from error

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, Mapping[str, Any]]:
        """Step all."""
        if not self._vec_env:
            *others, infos = self.env.step(actions)
            return (*others, _columns(infos))
        observations, rewards, ended, infos = self.env.step(actions)
        batch = isinstance(
            self.env.unwrapped, loaded("mptc_gym.sb3_vec_env", "GymnasiumVecEnv")
        )
        if batch and not ended.any():  # then its list is empty
            infos = self.env.unwrapped.infos
        return observations, rewards, ended, np.zeros_like(ended), _columns(infos)

    def restart(self) -> None:
        """Reset all with fresh seeds, so that training never meets the episodes of a score."""
        seed = int(np.random.SeedSequence().generate_state(1)[0])
        with suppress(Exception):  # a Monitor may not allow it; what is broken raised its own
            if self._vec_env:
                self.env.seed(seed)
                self.env.reset()
            else:
                self.env.reset(seed=seed)


def _columns(infos: Any) -> Mapping[str, Any]:
    """Return infos as arrays; a list has a dict for each environment."""
    if isinstance(infos, Mapping):
        return infos
    names = [name for name, value in infos[0].items() if isinstance(value, int | float)]
    return {name: np.array([each.get(name, np.nan) for each in infos]) for name in names}


@contextmanager
def opened(env: Any, n: int, policy: Any = None) -> Iterator[Given]:
    """Yield given environments, or n that a function makes, frozen and ready for episodes.

    Those of a function are closed afterwards. Others are as before, but for a new episode; if
    they are those of `policy`, its training begins anew.
    """
    with ExitStack() as stack:
        if isinstance(env, gymnasium.Env):
            one = env
            env = SyncVectorEnv([lambda: one])
            env.closed = True  # it is not ours to close
        elif not (isinstance(env, VectorEnv) or is_vec_env(env)):
            env = stack.enter_context(closing(_made(env, n)))
        given = Given(env)
        stack.enter_context(_frozen(env))
        stack.callback(given.restart)
        stack.callback(_forget, policy, env)
        yield given


def _made(make: Any, n: int) -> VectorEnv[Any, Any, Any]:
    """Return n environments of a function, to be stepped one after the other."""
    if not callable(make):
        reject("env", make, "an id, an EnvSpec, environments, or a function that makes one")
    envs = [make()]
    if not isinstance(envs[0], gymnasium.Env):
        allowed = "a function that makes one environment; where it makes many, call it"
        reject("env", envs[0], allowed)
    envs += [make() for _ in range(n - 1)]
    if len({id(each.unwrapped) for each in envs}) < n:
        raise ValueError("env must be a function that makes a new environment at each call")
    following = iter(envs)
    return SyncVectorEnv([lambda: next(following)] * n)


@contextmanager
def _frozen(env: Any) -> Iterator[None]:
    """Stop the statistics of all that normalises; refuse what cannot be, or has none."""
    flags = []
    try:
        for layer in layers(env):
            ask: Any = getattr(layer, "env_method", getattr(layer, "call", None))
            question = "has_wrapper_attr", "update_running_mean"
            if hasattr(layer, "processes") and any(ask(*question)):
                raise ValueError(
                    "env must not normalise in other processes, where its statistics cannot be "
                    "frozen: make it in this one, by DummyVecEnv or SyncVectorEnv"
                )
            normalises = isinstance(layer, loaded(_SB3, "VecNormalize"))
            if normalises or isinstance(layer, _NORMALISERS):
                name = "training" if normalises else "update_running_mean"
                flags.append((layer, name, getattr(layer, name)))
                setattr(layer, name, False)
                _check_statistics(getattr(layer, "obs_rms", None), type(layer).__name__)
        yield
    finally:
        for layer, name, flag in flags:
            setattr(layer, name, flag)


def _check_statistics(found: Any, name: str) -> None:
    """Refuse statistics of observations that are still those of the beginning."""
    for each in found.values() if isinstance(found, dict) else (found,):
        if each and each.count < 1 and not each.mean.any() and (each.var == 1).all():
            raise ValueError(
                f"env must have the statistics of the training in its {name}, which has seen "
                "nothing: load or copy them"
            )


def _forget(policy: Any, env: Any) -> None:
    """Let a model's training begin anew if its environments were used."""
    if isinstance(policy, loaded("stable_baselines3.common.base_class", "BaseAlgorithm")):
        own = policy.get_env()
        if own is not None and shared(own, env):
            policy._last_obs = None


def shared(one: Any, other: Any) -> bool:
    """Whether environments have a layer in common."""
    return not set(map(id, layers(one))).isdisjoint(map(id, layers(other)))


def check_model(model: Any, given: Any, env: Any) -> None:
    """Refuse environments that a model of Stable-Baselines3 was not trained for."""
    way_out = (
        "act in the environments of the training by evaluate(model, model.get_env()), or in "
        "others like them, such as mptc_gym.sb3.spec_of(model, id)"
    )
    compared: dict[str, tuple[Any, Any]] = {
        "observation space": (model.observation_space, given.single_observation_space),
        "action space": (model.action_space, given.single_action_space),
    }
    own = model.get_env() if hasattr(model, "get_env") else None
    if own is not None and not is_vec_env(env):
        here = given.env if isinstance(given, Given) else given
        compared["wrappers"] = stacks_and_normalisers(own), set()
        with suppress(ValueError):  # they are closed
            theirs, ours = (
                {each.parameters.windows for each in plants_of(each)} for each in (own, here)
            )
            compared["windows"] = theirs, ours
            compared["IncrementalAction"] = increments(own), increments(here)
    for name, (trained, found) in compared.items():
        if trained != found:
            raise ValueError(
                f"env must have the {name} of policy's training, {trained or 'none'}, got "
                f"{found or 'none'}: {way_out}"
            )


def replayed(steps: Iterable[Step], plants: Any, seeds: list[int]) -> Iterator[Step]:
    """Yield steps, as long as `plants`, given the same seeds and commands, show the same."""
    expected = plants.reset(seed=seeds)[1]
    limits = [
        expected.get(each, getattr(plants.parameters, each)) for each in ("u_min", "u_max")
    ]
    for k, step in enumerate(steps):
        if k == 0:
            step = step._replace(before=step.before or expected)
            _check_infos(step.before, expected, k)
        flows = np.asarray(step.after.get("command", np.zeros(plants.num_envs)))
        expected = plants.step(action_from_command(flows, *limits)[:, np.newaxis])[-1]
        _check_infos(step.after, expected, k + 1)
        yield step


def _check_infos(infos: Mapping[str, Any], expected: Mapping[str, Any], k: int) -> None:
    """Refuse infos at sample k that are not those expected, but for rounding."""
    names = [name for name in expected if not name.startswith("_")]
    values = np.array([expected[name] for name in names])
    found = np.array([infos.get(name, np.full_like(values[0], np.nan)) for name in names])
    right = np.isclose(found, values, _TOLERANCE, _TOLERANCE, equal_nan=True).all(axis=1)
    follow = "output", "error", "command", "applied"  # from the others, which tell more
    for name in sorted(np.array(names)[~right], key=lambda name: name in follow):
        raise ValueError(
            f"env must run the episodes of its seeds, whose {name} by sample {k} is "
            f"{shorten(expected[name])}, got {shorten(infos.get(name))}: it must not reset "
            "with another seed, skip or repeat samples, or change the plant or info"
        )
