"""Take environments as they are given: see what is in them, freeze it, reset all by seeds."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager, suppress
from typing import Any, Final

import gymnasium
import numpy as np
from gymnasium.vector import SyncVectorEnv, VectorEnv
from gymnasium.vector.utils import batch_space
from gymnasium.wrappers import NormalizeObservation, NormalizeReward, vector

from mptc_gym.checks import reject, shorten
from mptc_gym.env import MiddlePointEnv
from mptc_gym.parameters import Parameters
from mptc_gym.plant import action_from_command
from mptc_gym.policies import is_algorithm, loaded, unbound
from mptc_gym.vector_env import MiddlePointVectorEnv
from mptc_gym.wrappers import IncrementalAction
from mptc_gym.wrappers.vector import IncrementalAction as VectorIncrementalAction

PLANTS: Final = MiddlePointEnv, MiddlePointVectorEnv
_INCREMENTS: Final = IncrementalAction, VectorIncrementalAction
_NORMALISERS: Final = (
    *(NormalizeObservation, NormalizeReward),
    *(vector.NormalizeObservation, vector.NormalizeReward),
)
_SB3: Final = "stable_baselines3.common.vec_env"
_TOLERANCE: Final = 1e-6  # of infos, degC or t/h
Infos = Mapping[str, Any]  # arrays, one element per plant


def is_vec_env(env: Any) -> bool:
    """Whether environments are a `VecEnv` of Stable-Baselines3."""
    return isinstance(env, loaded(_SB3, "VecEnv"))


def layers(env: Any) -> Iterator[Any]:
    """Yield environments and all that is in them, in this process, the outermost first."""
    yield env
    for name in ("venv", "env", "envs", "batches"):
        inside = vars(env).get(name, ())
        for each in inside if isinstance(inside, list | tuple) else (inside,):
            if isinstance(each, gymnasium.Env | VectorEnv) or is_vec_env(each):
                yield from layers(each)


def shared(one: Any, other: Any) -> bool:
    """Whether environments have a layer in common."""
    return not set(map(id, layers(one))).isdisjoint(map(id, layers(other)))


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


def known_wrappers(env: Any) -> set[Any]:
    """Return those wrappers that change what a policy sees or does, as far as they are known.

    They are `IncrementalAction`, with its arguments, `VecNormalize` and `VecFrameStack`.
    """
    found = {
        name
        for name in ("VecNormalize", "VecFrameStack")
        for each in layers(env)
        if isinstance(each, loaded(_SB3, name)) and getattr(each, "norm_obs", True)
    }
    specs: list[Any] = []
    if not any(isinstance(each, PLANTS) for each in layers(env)):  # in other processes
        with suppress(OSError):  # which are closed
            specs = [spec for spec in env.get_attr("spec") if spec]
    wrappers = [each for spec in specs for each in spec.additional_wrappers]
    moves = [
        tuple(each.kwargs.values()) for each in wrappers if each.name == "IncrementalAction"
    ]
    moves += [each._arguments for each in layers(env) if isinstance(each, _INCREMENTS)]
    return found | {("IncrementalAction", *each) for each in moves}


class Given:
    """Environments as one batch: each gets a seed of its own, and infos are arrays."""

    def __init__(self, env: Any) -> None:
        self.env, self.num_envs, self._vec_env = env, env.num_envs, is_vec_env(env)
        self.inner = plants_of(env)
        of_one = "" if self._vec_env else "single_"
        self.single_observation_space = getattr(env, f"{of_one}observation_space")
        self.single_action_space = getattr(env, f"{of_one}action_space")
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(self, *, seed: Any = None) -> tuple[Any, Infos]:
        """Reset all with a seed each."""
        try:
            if not self._vec_env:
                observations, infos = self.env.reset(seed=seed)
                return observations, _columns(infos)
            self.env.seed(seed[0])
            self.env.unwrapped._seeds = [*seed]  # a batch may repeat seeds by its own `seed`
            return self.env.reset(), _columns(self.env.unwrapped.reset_infos)
        except RuntimeError as error:
            if "before done" not in str(error):
                raise
            raise ValueError(
                "env is in the middle of an episode that its Monitor does not let it leave: "
                "wrap it in Monitor(env, allow_early_resets=True)"
            ) from error

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, Infos]:
        """Step all."""
        if not self._vec_env:
            *others, infos = self.env.step(actions)
            return (*others, _columns(infos))
        observations, rewards, ended, infos = self.env.step(actions)
        inner, ours = self.env.unwrapped, loaded("mptc_gym.sb3_vec_env", "GymnasiumVecEnv")
        if isinstance(inner, ours) and not ended.any():  # then its list is empty
            infos = inner.infos
        return observations, rewards, ended, np.zeros_like(ended), _columns(infos)

    def restart(self, policy: Any) -> None:
        """Reset all with fresh seeds, so that training never meets the episodes of a score."""
        seed = int(np.random.SeedSequence().generate_state(1)[0])
        with suppress(Exception):  # a Monitor may not allow it; what is broken raised its own
            if self._vec_env:
                self.env.seed(seed)
                self.env.reset()
            else:
                self.env.reset(seed=seed)
        if is_algorithm(policy) and policy.env is not None and shared(policy.env, self.env):
            policy._last_obs = None  # its training begins anew


def _columns(infos: Any) -> Infos:
    """Return infos as arrays; a list has a dict for each environment."""
    if isinstance(infos, Mapping):
        return infos
    names = [name for name, value in infos[0].items() if isinstance(value, int | float)]
    return {name: np.array([each.get(name, np.nan) for each in infos]) for name in names}


@contextmanager
def opened(env: Any, n: int, policy: Any = None) -> Iterator[Given]:
    """Yield given environments, or n that a function makes, frozen and ready for episodes.

    Those of a function are closed afterwards. Others are as before, but for a new episode.
    """
    with ExitStack() as stack:
        if isinstance(env, gymnasium.Env):
            one = iter([env])
            env = SyncVectorEnv([lambda: next(one)])
            env.closed = True  # it is not ours to close
        elif not (isinstance(env, VectorEnv) or is_vec_env(env)):
            env = stack.enter_context(closing(_made(env, n)))
        given = Given(env)
        stack.enter_context(_frozen(env))
        stack.callback(given.restart, policy)
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
            of_sb3 = isinstance(layer, loaded(_SB3, "VecNormalize"))
            if not (of_sb3 or isinstance(layer, _NORMALISERS)):
                continue
            name = "training" if of_sb3 else "update_running_mean"
            flags.append((layer, name, getattr(layer, name)))
            setattr(layer, name, False)
            found = getattr(layer, "obs_rms", {})
            for each in found.values() if isinstance(found, dict) else (found,):
                if each.count < 1 and not each.mean.any() and (each.var == 1.0).all():
                    raise ValueError(
                        f"env must have the statistics of the training in its "
                        f"{type(layer).__name__}, which has seen nothing: load or copy them"
                    )
        yield
    finally:
        for layer, name, flag in flags:
            setattr(layer, name, flag)


def check_fit(policy: Any, parameters: Parameters, plants: Any) -> None:
    """Refuse environments that a policy was not made for, if it is one that can tell."""
    here = plants.env if isinstance(plants, Given) else plants
    owner = getattr(unbound(policy), "__self__", unbound(policy))
    if hasattr(owner, "check_environment") and not isinstance(owner, type):
        owner.check_environment(parameters, known_wrappers(here), plants.num_envs)
    inside = loaded("stable_baselines3.common.policies", "BaseModel")
    if is_algorithm(policy) or isinstance(policy, inside):
        _check_model(policy, plants, here)


def _check_model(model: Any, plants: Any, here: Any) -> None:
    """Refuse environments that a model of Stable-Baselines3 was not trained for."""
    compared: dict[str, tuple[Any, Any]] = {
        "observation space": (model.observation_space, plants.single_observation_space),
        "action space": (model.action_space, plants.single_action_space),
    }
    own = model.env if is_algorithm(model) else None
    if own is not None and not is_vec_env(here):
        trained, found = known_wrappers(own), known_wrappers(here)
        try:
            ours, theirs = ({p.parameters.windows for p in plants_of(e)} for e in (here, own))
            compared["windows"] = theirs, ours
        except ValueError:  # closed processes cannot be asked, what is around them can
            found = set()
        compared["wrappers"] = trained, found
    for name, (trained, found) in compared.items():
        if trained != found:
            raise ValueError(
                f"env must have the {name} of policy's training, {trained or 'none'}, got "
                f"{found or 'none'}: act where it was trained, by evaluate(model, "
                "model.get_env()), or in others like that, see mptc_gym.sb3.spec_of(model, id)"
            )


def replayed(steps: Iterable[tuple[Infos, Infos, Any]], plants: Any, seeds: list[int]) -> Any:
    """Yield steps, as long as `plants`, given the same seeds and commands, show the same."""
    expected = plants.reset(seed=seeds)[1]
    limits = [
        expected.get(each, getattr(plants.parameters, each)) for each in ("u_min", "u_max")
    ]
    for k, (before, after, ended) in enumerate(steps):
        if k == 0:
            before = before or expected  # where it does not keep the infos of a reset
            _check_infos(before, expected, k)
        flows = np.asarray(after.get("command", np.zeros(plants.num_envs)))
        expected = plants.step(action_from_command(flows, *limits)[:, np.newaxis])[-1]
        _check_infos(after, expected, k + 1)
        yield before, after, ended


def _check_infos(infos: Infos, expected: Infos, k: int) -> None:
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
