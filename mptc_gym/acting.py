"""Let any policy act in environments of any kind, both as they are given."""

import difflib
import inspect
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict
from functools import partial
from types import SimpleNamespace
from typing import Any, Final, cast

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import SyncVectorEnv, VectorEnv
from numpy.typing import NDArray

from mptc_gym.checks import reject, shorten
from mptc_gym.env import MiddlePointEnv
from mptc_gym.plant import action_from_command
from mptc_gym.presets import IDS
from mptc_gym.vector_env import MiddlePointVectorEnv

_SB3: Final = "stable_baselines3.common"
_TOLERANCE: Final = 1e-6  # of infos, degC or t/h, and relative to them
Env = gymnasium.Env[Any, Any]
Act = Callable[[Any], Any]  # observations, one row a plant, to actions
Infos = Mapping[str, Any]  # arrays, one element per plant
Steps = Iterator[tuple[Infos, NDArray[np.bool_]]]


def rollout(plants: Any, act: Act, samples: int, seeds: list[int]) -> Steps:
    """Reset and step plants; yield infos at samples k = 0, 1, ..., and which episodes end."""
    try:
        observations, infos = plants.reset(seed=seeds)
    except RuntimeError as error:  # of a Monitor, in the middle of an episode
        raise ValueError(f"env must allow another episode: {error}") from error
    yield infos, np.zeros(plants.num_envs, np.bool_)
    shape = plants.num_envs, *plants.single_action_space.shape
    for _ in range(samples):
        actions = _checked(act(observations), shape)
        observations, _, terminated, truncated, infos = plants.step(actions)
        # Where the same step resets a plant, the last sample's infos are apart.
        yield infos.get("final_info", infos), terminated | truncated


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
    (function, _), (_, owner) = behind(act), behind(policy)
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
    return cast("Act", _in_torch(owner, act, forward) if is_module else act)


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


def _in_torch(module: Any, act: Act, tensors: bool) -> Act:
    """Return the function of a `torch.nn.Module`, without gradients."""
    torch: Any = sys.modules["torch"]
    like = next(module.parameters(), torch.empty(0))

    def tensor(seen: Any) -> Any:
        if isinstance(seen, Mapping):
            return {name: tensor(each) for name, each in seen.items()}
        return torch.tensor(seen).to(like)

    def acting(observations: Any) -> Any:
        with torch.no_grad():
            actions = act(tensor(observations) if tensors else observations)
        return np.array(actions.tolist()) if isinstance(actions, torch.Tensor) else actions

    return acting


def is_environment(env: Any) -> bool:
    """Whether this is an environment or many, of Gymnasium or of Stable-Baselines3."""
    return isinstance(env, (gymnasium.Env, VectorEnv, loaded(f"{_SB3}.vec_env.VecEnv")))


def layers(env: Any) -> Iterator[Any]:
    """Yield environments and all in them; of running processes, copies of what matters."""
    yield env
    for name in ("venv", "env", "envs", "batches"):
        inside = vars(env).get(name, ())
        for each in inside if isinstance(inside, list | tuple) else (inside,):
            if is_environment(each):
                yield from layers(each)
    if "processes" in vars(env):
        ask = getattr(env, "env_method", None) or env.call
        with suppress(Exception):  # whatever closed ones raise
            yield from env.get_attr("unwrapped")
            for name in ("_increments", "update_running_mean"):
                has = ask("has_wrapper_attr", name)
                # To ask one that has it not would end its process.
                found = env.get_attr(name) if all(has) else filter(None, has)
                yield from (SimpleNamespace(**{name: each}) for each in found)


def natives(env: Any) -> list[MiddlePointEnv | MiddlePointVectorEnv]:
    """Return the plants in environments."""
    kinds = MiddlePointEnv, MiddlePointVectorEnv
    return [each for each in layers(env) if isinstance(each, kinds)]


def overlap(env: Any, other: Any) -> bool:
    """Whether environments have a layer in common."""
    others = [*layers(other)]
    return any(each is one for each in layers(env) for one in others)


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
        if "update_running_mean" in vars(layer):
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
def opened(env: Any, n: int, policy: Any = None, /, **arguments: Any) -> Iterator[Any]:
    """Yield plants, frozen. Given ones are reset afterwards, and n that it makes are closed."""
    with ExitStack() as stack:
        plants, given = _batch(env, n, arguments)
        if not given:
            stack.callback(plants.close)
        if not natives(plants):
            reject("env", env, "an open environment of MiddlePointEnv in NumPy, wrapped or not")
        _, owner = behind(policy)
        parts = owner.modules() if isinstance(owner, loaded("torch.nn.Module")) else ()
        for each, flag in [*_normalisers(plants), *((part, "training") for part in parts)]:
            stack.callback(setattr, each, flag, getattr(each, flag))
            setattr(each, flag, False)
        if given:
            last: list[Any] = [each.np_random_seed for each in natives(plants)]
            stack.callback(_restart, plants, policy, np.hstack(last).tolist())
        yield plants


def _batch(env: Any, n: int, arguments: Mapping[str, Any]) -> tuple[Any, bool]:
    """Return environments as a vector environment, and whether they are given, not made."""
    if isinstance(env, str | EnvSpec):
        make = partial(make_one, env, arguments)
        single = make()
        plants = native_batch(single, n) or SyncVectorEnv([make] * n)
        plants.unwrapped.spec = single.spec
        return plants, False
    if arguments:
        raise ValueError(f"{', '.join(arguments)} must be given where env is made")
    if isinstance(env, gymnasium.Env):
        plants = SyncVectorEnv([lambda: env])
        plants.closed = True  # as it is not ours to close
        return plants, True
    if is_environment(env):
        return env if isinstance(env, VectorEnv) else FromVecEnv(env), True
    if not callable(env):
        allowed = "an id, an EnvSpec, environments, or a function that makes one"
        reject("env", env, f"{allowed} (a model that was loaded has no environments)")
    return SyncVectorEnv([partial(_one, env)] * n), False


def make_one(env: str | EnvSpec, arguments: Mapping[str, Any]) -> Env:
    """Make an environment from an id or a spec; ValueError if it cannot be found."""
    try:
        return gymnasium.make(env, disable_env_checker=True, **arguments)
    except (gymnasium.error.Error, ImportError):
        close = difflib.get_close_matches(str(env), IDS.values(), n=1)
        hint = f"did you mean {close[0]}?" if close else f"such as {IDS['paper']}"
        reject("env", env, f"the id of an environment ({hint})")


def _one(make: Callable[[], Any]) -> Env:
    """Return the environment that a function makes."""
    made = make()
    if not isinstance(made, gymnasium.Env):
        allowed = "a function that makes one environment; where it makes many, call it"
        reject("env", made, allowed)
    return made


def native_batch(single: Env, n: int, **modes: Any) -> Any:
    """Return n of an environment in one batch, or None for a foreign one or its wrappers."""
    spec, plant = single.spec, single.unwrapped
    if spec is None or type(plant) is not MiddlePointEnv:
        return None
    wrappers = {each.entry_point for each in spec.additional_wrappers}
    if wrappers - {"mptc_gym.wrappers:IncrementalAction"}:
        return None
    modes["max_episode_steps"] = spec.max_episode_steps
    plants: Any = MiddlePointVectorEnv(n, **modes, **asdict(plant.parameters))
    plants.spec = spec
    for each in spec.additional_wrappers:
        from mptc_gym.wrappers.vector import IncrementalAction  # here: it imports this module

        plants = IncrementalAction(plants, **(each.kwargs or {}))
    return plants


def _restart(plants: Any, policy: Any, last: list[int]) -> None:
    """Reset plants, so that training never meets the episodes of a score."""
    # Seeds that follow from the last ones: the training can be repeated.
    entropy = None if None in last else [*map(abs, last)]
    seeds = np.random.SeedSequence(entropy).generate_state(plants.num_envs).tolist()
    observations = None
    with suppress(Exception):  # a Monitor may not allow it; what is broken raised its own
        observations, _ = plants.reset(seed=seeds)
    algorithm = loaded(f"{_SB3}.base_class.BaseAlgorithm")
    if isinstance(policy, algorithm) and policy.env and overlap(policy.env, plants):
        # In a callback, training goes on with these; otherwise None makes it begin anew.
        whole = isinstance(plants, FromVecEnv) and plants.env is policy.env
        policy._last_obs = observations if whole else None
        policy._last_episode_starts = np.ones(policy.n_envs, np.bool_)
        if whole and (normalised := policy.get_vec_normalize_env()) is not None:
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
    every = [*layers(env)]
    # A VecNormalize may be of rewards alone.
    shown = [each for each in every if vars(each).get("norm_obs", True)]
    kinds = {kind.__name__ for each in shown for kind in type(each).mro()}
    found: dict[str, set[Any]] = {"wrappers": kinds & {"VecNormalize", "VecFrameStack"}}
    if plants := natives(env):  # unlike closed processes, which cannot be asked
        moves = [vars(each).get("_increments") for each in every]
        found["action wrappers"] = {f"IncrementalAction{each}" for each in moves if each}
        found["windows"] = {plant.parameters.windows for plant in plants}
    return found


def replayed(steps: Steps, plants: Any, seeds: list[int]) -> Steps:
    """Yield steps, as long as `plants`, given the same seeds and commands, show the same."""
    _, shown = plants.reset(seed=seeds)
    limits = [shown.get(name, getattr(plants.parameters, name)) for name in ("u_min", "u_max")]
    for k, (infos, ended) in enumerate(steps):
        if k > 0:
            flows = np.asarray(infos.get("command", np.zeros(plants.num_envs)))
            *_, shown = plants.step(action_from_command(flows, *limits)[:, np.newaxis])
        elif not infos:  # where it does not keep those of a reset
            infos = shown
        # The last names first: what is drawn tells more than what follows from it.
        for name in reversed([name for name in shown if not name.startswith("_")]):
            found, right = infos.get(name, np.nan), shown[name]
            if not (np.abs(found - right) <= _TOLERANCE * (1.0 + np.abs(right))).all():
                raise ValueError(
                    f"env must run the episodes of its seeds, whose {name} by sample {k} is "
                    f"{shorten(right)}, got {shorten(infos.get(name))}: it must not reset with "
                    "another seed, skip or repeat samples, or change the plant or info"
                )
        yield infos, ended
