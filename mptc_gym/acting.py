"""Let any policy act in environments of any kind, both as they are given."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from typing import Any, Final, cast

import gymnasium
import numpy as np
from gymnasium.vector import SyncVectorEnv, VectorEnv
from numpy.typing import NDArray

from mptc_gym.checks import reject, shorten
from mptc_gym.env import MiddlePointEnv
from mptc_gym.parameters import Parameters
from mptc_gym.plant import action_from_command
from mptc_gym.vector_env import MiddlePointVectorEnv
from mptc_gym.wrappers import IncrementalAction
from mptc_gym.wrappers.vector import IncrementalAction as VectorIncrementalAction

_INCREMENTS: Final = IncrementalAction, VectorIncrementalAction
_SB3: Final = "stable_baselines3.common"
_TOLERANCE: Final = 1e-6  # of infos, degC or t/h
Act = Callable[[Any], Any]  # observations, one row a plant, to actions
Infos = Mapping[str, Any]  # arrays, one element per plant


def rollout(
    plants: Any, act: Act, samples: int, seed: int | list[int]
) -> Iterator[tuple[Infos, Infos, NDArray[np.bool_]]]:
    """Reset a batch of plants, and step it through samples k = 0, 1, ...

    Yield the infos at sample k, those at k + 1, and whether the episodes have ended.

    This is the one loop, for scores, benchmarks and tests. `plants` are a vector environment of
    Gymnasium, and `act` is a function of their observations. In place of the first seed, a list
    may give all. Actions of the wrong shape, or not finite, are a ValueError.
    """
    observations, infos = plants.reset(seed=seed)
    shape = plants.num_envs, *plants.single_action_space.shape
    for k in range(samples):
        actions = _checked(act(observations), shape, k)
        before = infos
        observations, _, terminated, truncated, infos = plants.step(actions)
        # Where the same step resets a plant, the last sample's infos are apart.
        yield before, infos.get("final_info", infos), terminated | truncated


def _checked(actions: Any, shape: tuple[int, ...], k: int) -> NDArray[Any]:
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


def loaded(module: str, name: str) -> Any:
    """Return a class if its package is imported; otherwise (), which has no instances."""
    return getattr(sys.modules.get(module), name, ())


def behind(policy: Any) -> tuple[Any, Any, Mapping[str, inspect.Parameter]]:
    """Return the function that a policy calls in the end, its object, and its arguments."""
    while isinstance(policy, partial):
        policy = policy.func
    owner = getattr(policy, "__self__", policy)
    owner = None if isinstance(owner, type) else owner
    try:
        return policy, owner, inspect.signature(getattr(policy, "forward", policy)).parameters
    except (TypeError, ValueError):  # of what is not written in Python
        return policy, owner, {}


def start(policy: Any, n: int) -> Act:
    """Reset a policy for n episodes, and return its function of observations."""
    forms = [name for name in ("predict", "act") if callable(getattr(policy, name, None))]
    act: Any = getattr(policy, forms[0]) if forms else policy
    if isinstance(policy, type) or not callable(act):
        reject("policy", policy, "a function, or an object with predict or act, not a class")
    function, owner, named = behind(act)
    owner = policy if forms else owner
    if callable(getattr(owner, "reset", None)):
        owner.reset()
    chosen = act.keywords if isinstance(act, partial) else {}
    if forms[:1] == ["predict"]:
        act = _predicting(act, named, n)
    elif "deterministic" in named and "deterministic" not in chosen:
        act = partial(act, deterministic=True)
    if isinstance(owner, loaded("torch.nn", "Module")):
        # Methods have a name, and modules none.
        forward = not forms and getattr(function, "__name__", "forward") == "forward"
        act = _evaluating(owner, act, tensors=forward)
    return cast("Act", act)


def _predicting(predict: Any, named: Mapping[str, inspect.Parameter], n: int) -> Act:
    """Return the function of observations of a policy in the form of Stable-Baselines3."""
    if "action_masks" in named:
        raise ValueError("policy.predict must need no action_masks: give a function")
    offered: dict[str, Any] = {"state": None, "episode_start": None, "deterministic": True}
    takes_all = any(each.kind is each.VAR_KEYWORD for each in named.values())
    accepted = [name for name in offered if takes_all or name in named]
    offered["episode_start"] = np.ones(n, np.bool_)

    def act(observations: Any) -> Any:
        actions = predict(observations, **{name: offered[name] for name in accepted})
        offered["episode_start"] = np.zeros(n, np.bool_)
        if isinstance(actions, tuple):
            actions, offered["state"] = actions
        if offered["state"] is not None and "state" not in accepted:
            raise ValueError("policy.predict must take the state that it returns: state=None")
        return actions

    return act


def _evaluating(module: Any, act: Act, tensors: bool) -> Act:
    """Return the function of a `torch.nn.Module`, in evaluation mode and without gradients."""
    torch: Any = sys.modules["torch"]
    numbers = (*module.parameters(), *module.buffers())
    like = next(filter(torch.is_floating_point, numbers), torch.empty(0))

    def tensor(seen: Any) -> Any:
        if isinstance(seen, Mapping):
            return {name: tensor(each) for name, each in seen.items()}
        return torch.tensor(seen).to(like)

    def evaluating(observations: Any) -> Any:
        in_training = [part for part in module.modules() if part.training]
        module.eval()
        try:
            with torch.no_grad():
                actions = act(tensor(observations) if tensors else observations)
        finally:
            for part in in_training:
                part.training = True
        return np.array(actions.tolist()) if isinstance(actions, torch.Tensor) else actions

    return evaluating


def is_vec_env(env: Any) -> bool:
    """Whether environments are a `VecEnv` of Stable-Baselines3."""
    return isinstance(env, loaded(f"{_SB3}.vec_env", "VecEnv"))


def layers(env: Any) -> Iterator[Any]:
    """Yield environments and all that is in them, the outermost first.

    Those in other processes are not among them, but copies of their plants, while they run.
    """
    yield env
    for name in ("venv", "env", "envs", "batches"):
        inside = vars(env).get(name, ())
        for each in inside if isinstance(inside, list | tuple) else (inside,):
            if isinstance(each, gymnasium.Env | VectorEnv) or is_vec_env(each):
                yield from layers(each)
    with suppress(Exception):  # whatever closed or foreign ones raise
        yield from _asked(env, "unwrapped")


def _asked(env: Any, name: str) -> list[Any]:
    """Return an attribute of environments in other processes, if they have it."""
    if "processes" not in vars(env):
        return []
    ask = getattr(env, "env_method", None) or env.call
    return [*env.get_attr(name)] if any(ask("has_wrapper_attr", name)) else []


def shared(one: Any, other: Any) -> bool:
    """Whether environments have a layer in common."""
    return not set(map(id, layers(one))).isdisjoint([id(each) for each in layers(other)])


def plants_of(env: Any) -> list[Any]:
    """Return the plants at the heart of environments."""
    kinds = MiddlePointEnv, MiddlePointVectorEnv
    found = [each for each in layers(env) if isinstance(each, kinds)]
    number = sum(getattr(each, "num_envs", 1) for each in found)
    if number != getattr(env, "num_envs", 1):
        reject("env", env, "an open environment of MiddlePointEnv in NumPy, wrapped or not")
    return found


def described(env: Any) -> dict[str, Any]:
    """Return what changes observations and actions, as far as it can be known, by kind."""
    inside = [*layers(env)]
    found: dict[str, Any] = {
        "wrappers": {
            name
            for name in ("VecNormalize", "VecFrameStack")
            for each in inside
            if isinstance(each, loaded(f"{_SB3}.vec_env", name))
            if getattr(each, "norm_obs", True)
        }
    }
    with suppress(Exception):  # closed processes cannot be asked, what is around them can
        found["windows"] = {plant.parameters.windows for plant in plants_of(env)}
        moves = [each._arguments for each in inside if isinstance(each, _INCREMENTS)]
        moves += [each for layer in inside for each in _asked(layer, "_arguments")]
        found["action_wrappers"] = {f"IncrementalAction{each}" for each in moves}
    return found


class Given:
    """Environments as one batch: each gets a seed of its own, and infos are arrays."""

    def __init__(self, env: Any) -> None:
        self.env, self.num_envs, self._vec_env = env, env.num_envs, is_vec_env(env)
        self.inner = plants_of(env)
        of_one = "" if self._vec_env else "single_"
        self.single_observation_space = getattr(env, f"{of_one}observation_space")
        self.single_action_space = getattr(env, f"{of_one}action_space")

    def reset(self, *, seed: int | list[int]) -> tuple[Any, Infos]:
        """Reset all, with a seed each or with those that they draw from one."""
        try:
            if not self._vec_env:
                observations, infos = self.env.reset(seed=seed)
                return observations, _columns(infos)
            self.env.seed(seed if isinstance(seed, int) else seed[0])
            if isinstance(seed, list):  # a batch may repeat seeds by its own `seed`
                self.env.unwrapped._seeds = [*seed]
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
        inner, ours = self.env.unwrapped, loaded("mptc_gym.sb3", "GymnasiumVecEnv")
        if isinstance(inner, ours) and not ended.any():  # then its list is empty
            infos = inner.infos
        return observations, rewards, ended, np.zeros_like(ended), _columns(infos)

    def restart(self, policy: Any) -> None:
        """Reset all with fresh seeds, so that training never meets the episodes of a score."""
        with suppress(Exception):  # a Monitor may not allow it; what is broken raised its own
            self.reset(seed=int(np.random.SeedSequence().generate_state(1)[0]))
        algorithm = loaded(f"{_SB3}.base_class", "BaseAlgorithm")
        if isinstance(policy, algorithm) and policy.env and shared(policy.env, self.env):
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
        batch = _batch(env, n)
        if batch is not env:
            stack.callback(batch.close)
        given = Given(batch)
        for layer, flag in _normalisers(batch):
            stack.callback(setattr, layer, flag, getattr(layer, flag))
            setattr(layer, flag, False)
        stack.callback(given.restart, policy)
        yield given


def _batch(env: Any, n: int) -> Any:
    """Return environments that exist, or n of a function, to be stepped together."""
    if isinstance(env, VectorEnv) or is_vec_env(env):
        return env
    exists = isinstance(env, gymnasium.Env)
    if not (exists or callable(env)):
        reject("env", env, "an id, an EnvSpec, environments, or a function that makes one")
    envs = [env] if exists else []
    while len(envs) < (1 if exists else n):
        envs.append(env())
        if not isinstance(envs[-1], gymnasium.Env):
            allowed = "a function that makes one environment; where it makes many, call it"
            reject("env", envs[-1], allowed)
    following = iter(envs)
    batch = SyncVectorEnv([lambda: next(following)] * len(envs))
    batch.closed = exists  # then it is not ours to close
    return batch


def _normalisers(env: Any) -> Iterator[tuple[Any, str]]:
    """Yield all that normalises, with the name of the flag that lets its statistics change."""
    for layer in layers(env):
        if _asked(layer, "update_running_mean"):
            raise ValueError(
                "env must not normalise in other processes, where its statistics cannot be "
                "frozen: make it in this one, by DummyVecEnv or SyncVectorEnv"
            )
        of_sb3 = isinstance(layer, loaded(f"{_SB3}.vec_env", "VecNormalize"))
        flag = "training" if of_sb3 else "update_running_mean"
        if not (of_sb3 or hasattr(type(layer), flag)):
            continue
        yield layer, flag
        found = getattr(layer, "obs_rms", {})
        for each in found.values() if isinstance(found, dict) else [found]:
            if not each.mean.any() and (each.var == 1.0).all():
                raise ValueError(
                    f"env must have the statistics of the training in its "
                    f"{type(layer).__name__}, which has seen nothing: load or copy them"
                )


def check_fit(policy: Any, parameters: Parameters, plants: Any) -> None:
    """Refuse environments that a policy was not made for, if it is one that can tell."""
    env = plants.env if isinstance(plants, Given) else plants
    here, (_, owner, _) = described(env), behind(policy)
    if hasattr(owner, "check_environment"):
        wrapped = ", ".join(here["wrappers"] | here["action_wrappers"])
        owner.check_environment(parameters, wrapped, plants.num_envs)
    kinds = ("base_class", "BaseAlgorithm"), ("policies", "BaseModel")
    if not any(isinstance(policy, loaded(f"{_SB3}.{file}", kind)) for file, kind in kinds):
        return
    names = "observation_space", "action_space"
    trained = {name: getattr(policy, name) for name in names}
    here |= {name: getattr(plants, f"single_{name}") for name in names}
    if getattr(policy, "env", None) is not None and not is_vec_env(env):
        trained |= described(policy.env)
    for name, its in trained.items():
        if its != here.get(name):
            raise ValueError(
                f"env must have the {name.replace('_', ' ')} of policy's training, "
                f"{its or 'none'}, got {here[name] or 'none'}: act where it was trained, by "
                "evaluate(model, model.get_env()), or in others like that, see "
                "mptc_gym.sb3.spec_of(model, id)"
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
    # The last names first: what is drawn tells more than what follows from it.
    names = [name for name in reversed([*expected]) if not name.startswith("_")]
    values = np.array([expected[name] for name in names])
    found = np.array([infos.get(name, np.full_like(values[0], np.nan)) for name in names])
    right = np.isclose(found, values, _TOLERANCE, _TOLERANCE, equal_nan=True).all(axis=1)
    for name in np.array(names)[~right]:
        raise ValueError(
            f"env must run the episodes of its seeds, whose {name} by sample {k} is "
            f"{shorten(expected[name])}, got {shorten(infos.get(name))}: it must not reset "
            "with another seed, skip or repeat samples, or change the plant or info"
        )
