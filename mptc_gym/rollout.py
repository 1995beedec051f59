"""Run a policy in new environments, and check that the episodes belong to their seeds."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any, Final, NamedTuple

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import SyncVectorEnv, VectorEnv
from numpy.typing import NDArray

from mptc_gym.plant.actuator import action_from_command
from mptc_gym.plant.checks import reject, shorten
from mptc_gym.plant.parameters import INTERFACE, Parameters
from mptc_gym.vector_env import MiddlePointVectorEnv, parameters_of

# Largest difference between an info and the expected info, divided by (1 + |expected info|):
# far more than rounding errors, and far less than the effect of another plant or seed.
_TOLERANCE: Final = 1e-6

Act = Callable[[Any], Any]  # from observations to actions, both with a row for each plant
Infos = Mapping[str, Any]  # infos of n plants by name, in arrays of shape (n,)
# A vector environment of Gymnasium. The annotation is not `VectorEnv`, because the annotated
# method `VectorEnv.reset` takes no list of seeds.
Plants = Any


class Sample(NamedTuple):
    """Observations and infos of n plants at one sample k."""

    # One row for each plant. At the end of an episode, some environments return the first
    # observation of the next episode.
    observations: Any
    infos: Infos  # infos of sample k; at the end of an episode, not those of the next episode
    ended: NDArray[np.bool_]  # whether this sample is the last of an episode, shape (n,)


def rollout(plants: Plants, act: Act, samples: int, seeds: Sequence[int]) -> Iterator[Sample]:
    """Yield the samples of n plants that a policy controls, beginning with a reset.

    Parameters
    ----------
    plants
        Vector environment of Gymnasium with a plant for each seed.
    act
        Function from observations to actions, as `start` returns.
    samples
        Number N of steps; the samples k = 0, 1, ..., N are yielded.
    seeds
        Seed of each plant's episode.

    Raises
    ------
    ValueError
        If actions are not finite, or do not have the shape of the action space.
    """
    observations, infos = plants.reset(seed=[*seeds])
    yield Sample(observations, infos, np.zeros(len(seeds), np.bool_))
    shape = (len(seeds), *plants.single_action_space.shape)
    for _ in range(samples):
        actions = _checked_actions(act(observations), shape)
        observations, _, terminated, truncated, infos = plants.step(actions)
        # At the end of an episode, some environments return the infos of the next episode, and
        # put the infos of the last sample into "final_info".
        yield Sample(observations, infos.get("final_info", infos), terminated | truncated)


def _checked_actions(actions: Any, shape: tuple[int, ...]) -> NDArray[Any]:
    """Return actions as an array; ValueError unless they are finite, and of shape `shape`."""
    array = np.asarray(actions)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(
            f"policy must return finite actions, shape {shape}, one row for each row of the "
            f"observations, got {shorten(actions)}, shape {array.shape}; write a policy of one "
            "observation as lambda o: numpy.stack([policy(row) for row in o])"
        )
    return array


def start(policy: Any, n: int) -> Act:
    """Reset a policy, and return a function that acts in one episode of n plants.

    A policy is an object with a method `predict` or `act`, or a function of NumPy arrays. If
    the policy has a method `reset`, `start` calls `reset`. A ValueError is raised if `policy`
    is a module of PyTorch, whose `forward` takes tensors.
    """
    if hasattr(policy, "predict"):
        act = _act_by_predict(policy.predict, n)
    elif hasattr(policy, "act"):
        act = policy.act
    elif hasattr(policy, "forward"):  # a torch.nn.Module
        written = "lambda o: module(torch.as_tensor(o)).detach().numpy()"
        reject("policy", policy, f"a function of NumPy arrays, such as {written}")
    else:
        act = policy
    if hasattr(policy, "reset"):
        policy.reset()
    return act


def _act_by_predict(predict: Callable[..., Any], n: int) -> Act:
    """Return a function from observations to actions that calls the method `predict`.

    The state that `predict` returns, such as that of a recurrent network, is passed to the next
    call. Of the keywords of Stable-Baselines3, `predict` receives those that it takes.
    """
    accepted = inspect.signature(predict).parameters
    takes_any = any(argument.kind is argument.VAR_KEYWORD for argument in accepted.values())
    keywords = {"state": None, "episode_start": np.ones(n, np.bool_), "deterministic": True}
    names = [name for name in keywords if takes_any or name in accepted]

    def act(observations: Any) -> Any:
        """Return the actions from `predict`, and keep the returned state for the next call."""
        # With those keywords that `predict` takes; only the first call starts an episode.
        returned = predict(observations, **{name: keywords[name] for name in names})
        keywords["episode_start"] = np.zeros(n, np.bool_)
        if isinstance(returned, tuple):  # actions and state
            returned, keywords["state"] = returned
        return returned

    return act


@contextmanager
def opened(policy: Any, env: Any, n: int, arguments: Mapping[str, Any]) -> Iterator[Plants]:
    """Make environments in which a policy can act, for a `with` statement that closes them.

    Parameters
    ----------
    policy
        Policy in one of the forms that `start` takes.
    env
        Id, `EnvSpec`, or function that makes a new environment, as in `mptc_gym.evaluate`.
    n
        Number of plants, unless `env` is a function that makes many.
    arguments
        Arguments of the environment, by name.

    Yields
    ------
    VectorEnv
        Vector environment, in which no wrapper updates normalisation statistics.

    Raises
    ------
    ValueError
        If `env` is an existing environment, or is not of this package, or does not fit the
        policy, or if normalisation statistics cannot be frozen or were never updated.
    """
    plants = _make_plants(policy, env, n, arguments)
    try:
        _freeze_statistics(plants)
        check_fit(policy, plants, is_made_by_user=callable(env))
        yield plants
    finally:
        plants.close()


def _make_plants(policy: Any, env: Any, n: int, arguments: Mapping[str, Any]) -> Plants:
    """Return a new vector environment; the docstring of `opened` describes the arguments."""
    if isinstance(env, str | EnvSpec):
        if training_of(policy) is not None:
            from mptc_gym.sb3_vec_env import like  # which needs Stable-Baselines3

            return _FromVecEnv(like(policy, env, n, **arguments))
        if isinstance(env, EnvSpec) and env.additional_wrappers:
            # A batch cannot have these wrappers of single environments.
            return gymnasium.make_vec(
                env, n, vectorization_mode="sync", disable_env_checker=True, **arguments
            )
        return gymnasium.make_vec(env, n, **arguments)
    if not callable(env):
        allowed = (
            "an id, an EnvSpec such as that of an environment, or a function that makes a new "
            "environment, such as lambda: ..."
        )
        reject("env", env, allowed)
    if arguments:
        raise ValueError(f"{', '.join(arguments)} must be given where env is made, in env")
    first, second = env(), env()  # two, to see whether the function makes new ones
    if first.unwrapped is second.unwrapped:
        reject("env", first, "a function that makes a new environment at each call")
    if isinstance(first, gymnasium.Env):
        # The two environments that are already made count.
        makers = [lambda: first, lambda: second, *[env] * (n - 2)]
        return SyncVectorEnv(makers[:n])
    second.close()
    return first if isinstance(first, VectorEnv) else _FromVecEnv(first)


class _FromVecEnv(VectorEnv[Any, Any, Any]):
    """A vector environment of Gymnasium that wraps a `VecEnv` of Stable-Baselines3."""

    def __init__(self, venv: Any) -> None:
        self.venv = venv
        self.num_envs = venv.num_envs
        self.single_observation_space = venv.observation_space
        self.single_action_space = venv.action_space

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Reset all plants with successive seeds, of which the list `seed` has the first."""
        self.venv.seed(seed[0])  # a `VecEnv` counts on from the first seed, at its next reset
        observations = self.venv.reset()
        return observations, _in_arrays(self.venv.unwrapped.reset_infos)

    def step(self, actions: NDArray[Any]) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step all plants; each episode that has ended counts as terminated."""
        observations, rewards, ended, infos = self.venv.step(actions)
        # A `GymnasiumVecEnv` fills its list of infos only where episodes end, and has the infos
        # of all plants in its attribute `infos`.
        arrays = _in_arrays(infos) or self.venv.unwrapped.infos
        return observations, rewards, ended, np.zeros_like(ended), arrays

    def get_attr(self, name: str) -> Any:
        """Return the value of an attribute for each plant."""
        return self.venv.get_attr(name)

    def close_extras(self, **kwargs: Any) -> None:
        """Close the `VecEnv`."""
        self.venv.close()


def _in_arrays(infos: Sequence[Infos]) -> dict[str, Any]:
    """Return the numbers in the infos of n plants, by name, in arrays of shape (n,)."""
    # The infos of all plants have the same names.
    names = [name for name, value in infos[0].items() if isinstance(value, int | float)]
    return {name: np.array([info[name] for info in infos]) for name in names}


def layers(env: Any) -> Iterator[Any]:
    """Yield `env` and all wrappers and environments within `env` that are in this process."""
    yield env
    attributes = vars(env)
    inner = [attributes.get("venv"), attributes.get("env"), *attributes.get("envs", ())]
    for layer in inner:
        if layer is not None:
            yield from layers(layer)


def _freeze_statistics(plants: Plants) -> None:
    """Stop all updates of normalisation statistics in new environments.

    A ValueError is raised if statistics were never updated, or are in worker processes.
    """
    for layer in layers(plants):
        if "processes" in vars(layer):  # a SubprocVecEnv or an AsyncVectorEnv
            ask = getattr(layer, "env_method", None) or layer.call
            if any(ask("has_wrapper_attr", "update_running_mean")):
                raise ValueError(
                    "env must not normalise in worker processes, where the statistics go on "
                    "changing: use DummyVecEnv or SyncVectorEnv"
                )
        if hasattr(type(layer), "update_running_mean"):  # a wrapper of Gymnasium
            layer.update_running_mean = False
        if "norm_obs" in vars(layer):  # a VecNormalize
            layer.training = False
        statistics = vars(layer).get("obs_rms")
        if statistics is not None and statistics.count < 1.0:  # initial statistics count 1e-4
            raise ValueError(
                f"env must have the statistics of the policy's training in "
                f"{type(layer).__name__}, got initial ones: set its obs_rms to that of the "
                "training, or write VecNormalize.load(path, env)"
            )


def check_fit(policy: Any, plants: Plants, *, is_made_by_user: bool) -> None:
    """Raise a ValueError if a controller or a model was made for other environments."""
    parameters = parameters_of(plants)
    if hasattr(policy, "check_environment"):
        policy.check_environment(parameters, plants.num_envs)
    training = training_of(policy)
    if training is not None and is_made_by_user:
        expected, received = _interface(training), _interface(plants)
        differing = [name for name in expected if expected[name] != received[name]]
        if differing:
            raise ValueError(
                f"env must have the interface of the policy's training, "
                f"{', '.join(f'{name}={expected[name]}' for name in differing)}, got "
                f"{', '.join(f'{name}={received[name]}' for name in differing)}"
            )
    if hasattr(policy, "get_env"):
        expected_spaces = policy.observation_space.shape, policy.action_space
        spaces = plants.single_observation_space.shape, plants.single_action_space
        if spaces != expected_spaces:
            raise ValueError(
                f"env must have the observations and actions of the policy's training, "
                f"{expected_spaces}, got {spaces}: leave out the arguments that change them, "
                "and load a model with its environments, PPO.load(path, env=...)"
            )


def training_of(policy: Any) -> Any:
    """Return the training environments of a Stable-Baselines3 model; None if it has none."""
    return policy.get_env() if hasattr(policy, "get_env") else None


def _interface(env: Any) -> dict[str, Any]:
    """Return what a policy must find as in its training, by name."""
    parameters = parameters_of(env)
    interface = {name: getattr(parameters, name) for name in INTERFACE}
    interface["normalised"] = any("obs_rms" in vars(layer) for layer in layers(env))
    return interface


def replayed(
    samples: Iterator[Sample], case: Parameters, seeds: Sequence[int]
) -> Iterator[Sample]:
    """Yield the samples of a rollout, and compare each sample with a second simulation.

    The second simulation is a `MiddlePointVectorEnv` with the seeds of the rollout and the
    arguments `case`, whose actions set flows: the flows that the rollout commanded. A
    ValueError is raised if infos of the rollout differ from infos of the second simulation: the
    environment of the rollout then has changed the seed, skipped samples, or changed the plant
    or the infos.
    """
    plants = MiddlePointVectorEnv(len(seeds), **asdict(case))
    _, expected = plants.reset(seed=[*seeds])
    for k, sample in enumerate(samples):
        if k > 0:
            # Where the info is missing, `_compare_infos` raises the error.
            commands = sample.infos.get("command", np.zeros(len(seeds)))
            actions = action_from_command(commands, case.u_min, case.u_max)
            expected = plants.step(np.reshape(actions, (-1, 1)))[-1]  # the infos
        _compare_infos(sample.infos, expected, k)
        yield sample


def _compare_infos(infos: Infos, expected: Infos, k: int) -> None:
    """Raise a ValueError if infos of n plants at sample k differ from the expected infos."""
    names = [name for name in expected if not name.startswith("_")]  # "_name" is a mask
    # Compare the last names first: the last infos of a step are the noise, the load and the
    # drift factors, in which a difference explains differences in other infos.
    for name in reversed(names):
        differences = np.abs(infos.get(name, np.nan) - expected[name])  # NaN is refused
        if not (differences <= _TOLERANCE * (1.0 + np.abs(expected[name]))).all():
            raise ValueError(
                f"env must run the episodes of its seeds, whose {name} at sample {k} is "
                f"{shorten(expected[name])}, got {shorten(infos.get(name))}: env must not "
                "reset with another seed, skip or repeat samples, end an episode early, or "
                "change the plant or the infos"
            )
