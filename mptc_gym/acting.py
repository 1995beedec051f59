"""Let any policy act in environments of any kind, both as they are given."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from typing import Any, Final, cast

import gymnasium
import numpy as np
from gymnasium.vector import SyncVectorEnv, VectorEnv
from numpy.typing import NDArray

from mptc_gym.checks import reject, shorten
from mptc_gym.env import MiddlePointEnv
from mptc_gym.plant import action_from_command
from mptc_gym.vector_env import MiddlePointVectorEnv

_NATIVE: Final = MiddlePointEnv, MiddlePointVectorEnv
_SB3: Final = "stable_baselines3.common"
_TOLERANCE: Final = 1e-6  # of infos, degC or t/h, and relative to them
Act = Callable[[Any], Any]  # observations, one row a plant, to actions
Infos = Mapping[str, Any]  # arrays, one element per plant
Steps = Iterator[tuple[Infos, Infos, NDArray[np.bool_]]]


def rollout(plants: Any, act: Act, samples: int, seeds: list[int]) -> Steps:
    """Reset a batch of plants, and step it through samples k = 0, 1, ...

    Yield the infos at sample k, those at k + 1, and whether the episodes have ended.

    This is the one loop, for scores, benchmarks and tests. `plants` are a vector environment of
    Gymnasium or a `FromVecEnv`.
    """
    try:
        observations, infos = plants.reset(seed=seeds)
    except RuntimeError as error:  # of a Monitor, in the middle of an episode
        raise ValueError(f"env must allow another episode: {error}") from error
    shape = plants.num_envs, *plants.single_action_space.shape
    for _ in range(samples):
        actions = _checked(act(observations), shape)
        before = infos
        observations, _, terminated, truncated, infos = plants.step(actions)
        # Where the same step resets a plant, the last sample's infos are apart.
        yield before, infos.get("final_info", infos), terminated | truncated


def _checked(actions: Any, shape: tuple[int, ...]) -> NDArray[Any]:
    """Return the actions of a policy as an array, if the environments can take them."""
    if isinstance(actions, tuple):
        reject("policy", actions, "what returns actions alone: a model, not its predict")
    try:
        checked = np.asarray(actions)
        if checked.shape == shape and np.isfinite(checked).all():
            return checked
        found = f"{shorten(checked)}, shape {checked.shape}"
    except (TypeError, ValueError, RuntimeError) as error:  # the last: from tensors
        found = f"{shorten(actions)} ({error})"
    raise ValueError(f"policy must return finite actions, shape {shape}, got {found}")


def loaded(name: str) -> Any:
    """Return a class by its full name if it is imported; otherwise (), without instances."""
    module, _, kind = name.rpartition(".")
    return getattr(sys.modules.get(module), kind, ())


def behind(policy: Any) -> tuple[Any, Any]:
    """Return the function that a policy is, out of its partials, and that function's object."""
    while isinstance(policy, partial):
        policy = policy.func
    owner = getattr(policy, "__self__", policy)
    return policy, None if isinstance(owner, type) else owner


def start(policy: Any, n: int) -> Act:
    """Reset a policy for n episodes, and return its function of observations."""
    forms = [name for name in ("predict", "act") if callable(getattr(policy, name, None))]
    act: Any = getattr(policy, forms[0]) if forms else policy
    if isinstance(policy, type) or not callable(act):
        reject("policy", policy, "a function, or an object with predict or act, not a class")
    function, owner = behind(act)
    owner = policy if forms else owner
    if callable(getattr(owner, "reset", None)):
        owner.reset()
    is_module = isinstance(owner, loaded("torch.nn.Module"))
    # Methods have a name, and modules none.
    forward = is_module and getattr(function, "__name__", "forward") == "forward"
    if forward and getattr(owner.forward, "__name__", "") == "_forward_unimplemented":
        allowed = "a module with forward: its part that acts, as agent.actor_mean"
        reject("policy", owner, allowed)
    named: Mapping[str, inspect.Parameter] = {}
    with suppress(TypeError, ValueError):  # of what is not written in Python
        named = inspect.signature(owner.forward if forward else function).parameters
    if forms[:1] == ["predict"]:
        act = _predicting(act, named, n)
    elif "deterministic" in {*named} - {*getattr(act, "keywords", ())}:
        act = partial(act, deterministic=True)
    return cast("Act", _evaluating(owner, act, forward) if is_module else act)


def _predicting(predict: Any, named: Mapping[str, inspect.Parameter], n: int) -> Act:
    """Return the function of observations of a policy in the form of Stable-Baselines3."""
    latest = {"state": None, "episode_start": np.ones(n, np.bool_), "deterministic": True}
    takes_all = any(each.kind is each.VAR_KEYWORD for each in named.values())
    accepted = [name for name in latest if takes_all or name in named]

    def act(observations: Any) -> Any:
        actions = predict(observations, **{name: latest[name] for name in accepted})
        latest["episode_start"] = np.zeros(n, np.bool_)
        if isinstance(actions, tuple):
            actions, latest["state"] = actions
        return actions

    return act


def _evaluating(module: Any, act: Act, tensors: bool) -> Act:
    """Return the function of a `torch.nn.Module`, in evaluation mode and without gradients."""
    torch: Any = sys.modules["torch"]
    like = next(module.parameters(), torch.empty(0))

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
    return isinstance(env, loaded(f"{_SB3}.vec_env.VecEnv"))


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
    yield from _asked(env, "unwrapped")


def _asked(env: Any, name: str) -> list[Any]:
    """Return an attribute of a layer, or of environments in its processes, if they run."""
    if name in vars(env):
        return [vars(env)[name]]
    with suppress(Exception):  # whatever closed ones raise
        if "processes" in vars(env):
            ask = getattr(env, "env_method", None) or env.call
            return [*env.get_attr(name)] if any(ask("has_wrapper_attr", name)) else []
    return []


def natives(env: Any) -> list[MiddlePointEnv | MiddlePointVectorEnv]:
    """Return the plants in environments."""
    return [each for each in layers(env) if isinstance(each, _NATIVE)]


def overlap(env: Any, other: Any) -> bool:
    """Whether environments have a layer in common."""
    return not {*map(id, layers(env))}.isdisjoint(map(id, layers(other)))


class FromVecEnv:
    """A `VecEnv` of Stable-Baselines3 in the form of a vector environment of Gymnasium."""

    def __init__(self, env: Any) -> None:
        self.env, self._innermost, self.num_envs = env, env.unwrapped, env.num_envs
        self.single_observation_space = env.observation_space
        self.single_action_space = env.action_space

    def reset(self, *, seed: list[int]) -> tuple[Any, Infos]:
        """Reset all, with a seed each."""
        self._innermost._seeds = [*seed]  # its own `seed` may repeat them
        return self.env.reset(), _columns(self._innermost.reset_infos)

    def step(self, actions: Any) -> Any:
        """Step all."""
        observations, rewards, ended, infos = self.env.step(actions)
        # A `GymnasiumVecEnv` fills its list where episodes end.
        columns = _columns(infos) or getattr(self._innermost, "infos", {})
        return observations, rewards, ended, np.zeros_like(ended), columns


def _columns(infos: list[dict[str, Any]]) -> Infos:
    """Return infos as arrays, one element per environment."""
    names = [name for name, value in infos[0].items() if isinstance(value, int | float)]
    return {name: np.array([each.get(name, np.nan) for each in infos]) for name in names}


def _normalisers(env: Any) -> Iterator[tuple[Any, str]]:
    """Yield all that normalises, with the name of the flag that freezes its statistics."""
    for layer in layers(env):
        if _asked(layer, "update_running_mean"):
            raise ValueError(
                "env must not normalise in other processes, where its statistics cannot be "
                "frozen: use DummyVecEnv or SyncVectorEnv"
            )
        of_sb3 = isinstance(layer, loaded(f"{_SB3}.vec_env.VecNormalize"))
        if not (of_sb3 or hasattr(type(layer), "update_running_mean")):
            continue
        yield layer, "training" if of_sb3 else "update_running_mean"
        found = getattr(layer, "obs_rms", {})
        for each in found.values() if isinstance(found, dict) else [found]:
            if not each.mean.any() and (each.var == 1.0).all():
                raise ValueError(
                    f"env must have the statistics of the training in {type(layer).__name__}, "
                    "which has seen nothing: load or copy them"
                )


@contextmanager
def opened(env: Any, n: int, policy: Any = None) -> Iterator[Any]:
    """Yield given environments, or n that a function makes, frozen and ready for episodes.

    Those of a function are closed afterwards. Others are as before, but for a new episode.
    """
    given = isinstance(env, gymnasium.Env | VectorEnv) or is_vec_env(env)
    if not (given or callable(env)):
        allowed = "an id, an EnvSpec, environments, or a function that makes one"
        reject("env", env, f"{allowed} (a model that was loaded has no environments)")
    with ExitStack() as stack:
        plants = FromVecEnv(env) if is_vec_env(env) else env
        if not given or isinstance(env, gymnasium.Env):
            plants = SyncVectorEnv([lambda: env] if given else [partial(_one, env)] * n)
            stack.callback(plants.close)
            plants.closed = given  # then it is not ours to close
        if not natives(plants):
            reject("env", env, "an open environment of MiddlePointEnv in NumPy, wrapped or not")
        for layer, flag in _normalisers(plants):
            stack.callback(setattr, layer, flag, getattr(layer, flag))
            setattr(layer, flag, False)
        if given:
            stack.callback(_restart, plants, policy, _fresh(plants))
        yield plants


def _one(make: Callable[[], Any]) -> gymnasium.Env[Any, Any]:
    """Return the environment that a function makes."""
    made = make()
    if not isinstance(made, gymnasium.Env):
        allowed = "a function that makes one environment; where it makes many, call it"
        reject("env", made, allowed)
    return made


def _fresh(plants: Any) -> list[int]:
    """Return new seeds that follow from the last ones, so that a training can be repeated."""
    each_last: list[Any] = [each.np_random_seed for each in natives(plants)]
    last = np.hstack(each_last).tolist()
    entropy = None if None in last else [abs(seed) for seed in last]
    return [*map(int, np.random.SeedSequence(entropy).generate_state(plants.num_envs))]


def _restart(plants: Any, policy: Any, seeds: list[int]) -> None:
    """Reset plants with other seeds, so that training never meets the episodes of a score."""
    observations = None
    with suppress(Exception):  # a Monitor may not allow it; what is broken raised its own
        observations, _ = plants.reset(seed=seeds)
    algorithm = loaded(f"{_SB3}.base_class.BaseAlgorithm")
    if not (isinstance(policy, algorithm) and policy.env and overlap(policy.env, plants)):
        return
    policy._last_obs = None  # its training begins anew
    if isinstance(plants, FromVecEnv) and plants.env is policy.env:
        # In a callback it goes on with these, and would store the None.
        policy._last_obs = observations
        policy._last_episode_starts = np.ones(plants.num_envs, np.bool_)
        if (normalised := policy.get_vec_normalize_env()) is not None:
            policy._last_original_obs = normalised.get_original_obs()


def check_fit(policy: Any, plants: Any) -> None:
    """Refuse environments that a policy was not made for, if it is one that can tell."""
    _, owner = behind(policy)
    if hasattr(owner, "check_environment"):
        here = _traits(plants)
        wrapped = ", ".join(here["wrappers"] | here["action wrappers"])
        owner.check_environment(natives(plants)[0].parameters, wrapped, plants.num_envs)
    models = loaded(f"{_SB3}.base_class.BaseAlgorithm"), loaded(f"{_SB3}.policies.BaseModel")
    if not isinstance(policy, models):
        return
    pairs: dict[str, tuple[Any, Any]] = {
        "observation space": (policy.observation_space, plants.single_observation_space),
        "action space": (policy.action_space, plants.single_action_space),
    }
    own = getattr(policy, "env", None)
    if own and not isinstance(plants, FromVecEnv):
        here = _traits(plants)
        pairs |= {name: (its, here[name]) for name, its in _traits(own).items()}
    for name, (its, found) in pairs.items():
        if its != found:
            raise ValueError(
                f"env must have the {name} of policy's training, {its or 'none'}, got "
                f"{found or 'none'}: use evaluate(model, model.get_env()), or mptc_gym.sb3."
                "spec_of(model, id) in the same VecNormalize and VecFrameStack"
            )


def _traits(env: Any) -> dict[str, set[Any]]:
    """Return what changes observations and actions, as far as it can be known, by kind."""
    kinds = {
        kind.__name__
        for each in layers(env)
        if vars(each).get("norm_obs", True)  # a VecNormalize may be of rewards alone
        for kind in type(each).mro()
    }
    found: dict[str, set[Any]] = {"wrappers": kinds & {"VecNormalize", "VecFrameStack"}}
    if plants := natives(env):  # unlike closed processes, which cannot be asked
        moves = [each for layer in layers(env) for each in _asked(layer, "_increments")]
        found["action wrappers"] = {f"IncrementalAction{each}" for each in moves}
        found["windows"] = {plant.parameters.windows for plant in plants}
    return found


def replayed(steps: Steps, plants: Any, seeds: list[int]) -> Steps:
    """Yield steps, as long as `plants`, given the same seeds and commands, show the same."""
    _, shown = plants.reset(seed=seeds)
    limits = [shown.get(name, getattr(plants.parameters, name)) for name in ("u_min", "u_max")]
    for k, (before, after, ended) in enumerate(steps):
        if k == 0:
            before = before or shown  # where it does not keep the infos of a reset
            _check_infos(before, shown, k)
        flows = np.asarray(after.get("command", np.zeros(plants.num_envs)))
        *_, shown = plants.step(action_from_command(flows, *limits)[:, np.newaxis])
        _check_infos(after, shown, k + 1)
        yield before, after, ended


def _check_infos(infos: Infos, shown: Infos, k: int) -> None:
    """Refuse infos at sample k that are not those shown by the native plants."""
    # The last names first: what is drawn tells more than what follows from it.
    for name in reversed([name for name in shown if not name.startswith("_")]):
        found, right = infos.get(name, np.nan), shown[name]
        if not (np.abs(found - right) <= _TOLERANCE * (1.0 + np.abs(right))).all():
            raise ValueError(
                f"env must run the episodes of its seeds, whose {name} by sample {k} is "
                f"{shorten(right)}, got {shorten(infos.get(name))}: it must not reset with "
                "another seed, skip or repeat samples, or change the plant or info"
            )
