"""Open environments of any kind as one vector environment of Gymnasium to act in.

Environments of any kind are an id, a spec (`EnvSpec`), a function that makes an environment,
and environments of Gymnasium or Stable-Baselines3.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any, Final

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import SyncVectorEnv, VectorEnv
from numpy.typing import NDArray

from mptc_gym.environments.layers import (
    is_environment,
    layers,
    loaded,
    normaliser_flag,
    plant_groups,
)
from mptc_gym.environments.making import Env, make_batch, make_one
from mptc_gym.plant.checks import reject
from mptc_gym.scoring.copies import Copy
from mptc_gym.scoring.policies import form_of
from mptc_gym.scoring.rollout import infos_in_arrays

_POLICY_OF_A_MODEL: Final = "stable_baselines3.common.policies.BaseModel"

# A vector environment of Gymnasium. It has no type `VectorEnv` here, as the method `reset` of
# this type takes no list of seeds.
Plants = Any


@contextmanager
def opened(env: Any, n: int, policy: Any, /, **arguments: Any) -> Iterator[Plants]:
    """Return a context with a vector environment for a policy to act in.

    In the context, wrappers that normalise do not update their statistics.

    Parameters
    ----------
    env
        As in `mptc_gym.evaluate`. From an id, a spec or a function, environments are made,
        which are closed at the end of the context. Environments are copied; those that cannot
        be copied are used themselves, and begin a new episode at the end of the context.
    n
        Number of plants to make, if `env` is an id, a spec or a function.
    policy
        As in `mptc_gym.evaluate`.
    **arguments
        Further arguments for an id or a spec, as in `gymnasium.make`.

    Yields
    ------
    VectorEnv
        A vector environment of Gymnasium, whose plants are those of `env`.

    Raises
    ------
    ValueError
        If `env` or `policy` is of another kind; if `env` holds no plants of this package in
        NumPy; or if `env` cannot be copied and is the environment in which `policy` trains.
    """
    target = form_of(policy).target
    if arguments and not isinstance(env, str | EnvSpec):
        raise ValueError(
            f"{', '.join(arguments)} must be given where env is made: evaluate takes arguments "
            "of the plant only with an id or a spec"
        )
    with ExitStack() as stack:  # which undoes all steps of opening, the last step first
        if is_environment(env):
            copy = Copy(env)
            _refuse_training_environments(copy, target)
            plants = _as_vector(copy.env)
            originals_act = bool(copy.shared)
        else:
            plants = _make(env, n, arguments)
            originals_act = False
            stack.callback(plants.close)
        if not plant_groups(plants):
            allowed = "of MiddlePointEnv in NumPy, and open, such as an id or a spec of it"
            reject("env", env, allowed)
        if originals_act:  # in layers that could not be copied, within copies of other layers
            stack.enter_context(_statistics_frozen(env))
            stack.callback(_as_vector(env).reset, seed=_next_seeds(plants))
        stack.enter_context(_statistics_frozen(plants))
        yield plants


def _make(env: Any, n: int, arguments: Mapping[str, Any]) -> Plants:
    """Return a vector environment with n plants, made by an id, a spec or a function `env`.

    `arguments` are further arguments of `gymnasium.make` for an id or a spec.
    """
    if isinstance(env, str | EnvSpec):
        single = make_one(env, arguments)
        batch = make_batch(single, n)
        if batch is not None:
            return batch
        return _sync_vector_env([single, *(make_one(env, arguments) for _ in range(n - 1))])
    if not callable(env):
        allowed = "an id, an EnvSpec, environments, or a function that makes one"
        reject("env", env, f"{allowed} (a model that was loaded has no environments)")
    environments = [env() for _ in range(n)]
    for environment in environments:
        if not isinstance(environment, gymnasium.Env):
            allowed = "a function that makes one environment; where it makes many, call it"
            reject("env", environment, allowed)
    return _sync_vector_env(environments)


def _sync_vector_env(environments: list[Env]) -> Plants:
    """Return a vector environment that steps the given environments one after another."""
    # SyncVectorEnv takes functions that make environments. The default argument keeps the
    # environment of each function.
    return SyncVectorEnv([lambda env=env: env for env in environments])  # type: ignore[misc]


def _as_vector(env: Any) -> Plants:
    """Return an environment or a vector environment as a vector environment of Gymnasium."""
    if isinstance(env, VectorEnv):
        return env
    if not isinstance(env, gymnasium.Env):
        return _FromVecEnv(env)
    plants = _sync_vector_env([env])
    # Some versions of Gymnasium close the environments within a vector environment when the
    # vector environment is deleted, unless it is closed.
    plants.closed = True
    return plants


class _FromVecEnv(VectorEnv[Any, Any, Any]):
    """A `VecEnv` of Stable-Baselines3 as a vector environment of Gymnasium."""

    def __init__(self, venv: Any) -> None:
        self.venv = venv
        self.num_envs = venv.num_envs
        self.single_observation_space = venv.observation_space
        self.single_action_space = venv.action_space
        self.closed = True  # so that only the user closes the environments of the user

    @property
    def np_random_seed(self) -> Any:
        """A list of the latest seed of each plant."""
        return self.venv.get_attr("np_random_seed")

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Reset all plants, and return observations and infos, both in arrays.

        `seed` is a list with a seed for each plant. Only a `GymnasiumVecEnv` takes all seeds.
        Any other `VecEnv` takes the first seed, and gives the next integers to the next plants.
        """
        innermost = self.venv.unwrapped
        if hasattr(innermost, "set_seeds"):
            innermost.set_seeds(seed)
        else:
            self.venv.seed(seed[0])
        observations = self.venv.reset()
        return observations, {**infos_in_arrays(innermost.reset_infos)}

    def step(self, actions: NDArray[Any]) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step all plants, and return observations, rewards, flags and infos, all in arrays.

        The flags say which episodes have ended. All ended episodes count as terminated.
        """
        observations, rewards, ended, infos = self.venv.step(actions)
        # A `GymnasiumVecEnv` fills its list of infos only where episodes end, and has the infos
        # of all plants in its attribute `infos`.
        arrays = infos_in_arrays(infos) or getattr(self.venv.unwrapped, "infos", {})
        return observations, rewards, ended, np.zeros_like(ended), {**arrays}


def _refuse_training_environments(copy: Copy, target: Any) -> None:
    """Raise a ValueError if a policy may train in layers that copy and original share.

    `target` is the model or another object behind the policy. The attribute `policy` of a model
    of Stable-Baselines3 does not know the model's environments, so it may train in any.
    """
    training = getattr(target, "env", None)
    trains_there = is_environment(training) and any(
        id(layer) in copy.shared for layer in layers(training)
    )
    is_policy_of_a_model = isinstance(target, loaded(_POLICY_OF_A_MODEL))
    if trains_there or (copy.shared and is_policy_of_a_model):
        raise ValueError(
            "env must not be the training environments of policy, as these cannot be copied "
            f"({copy.reason}): make others like them, and pass the model itself, or use "
            "evaluate(model, spec_of(model, id)), with spec_of from mptc_gym.sb3"
        )


def _next_seeds(plants: Plants) -> list[int]:
    """Return a seed for a new episode of each plant, computed from the present seeds.

    Without new seeds, a user's environments would continue the random numbers of the scored
    episodes. The new seeds are not random, so that a user can repeat a program.
    """
    present_seeds = np.ravel(plants.unwrapped.np_random_seed).tolist()
    # A SeedSequence takes no negative number, which is Gymnasium's value for an unknown seed.
    entropy = [abs(seed) for seed in present_seeds if seed is not None]
    seeds: list[int] = np.random.SeedSequence(entropy).generate_state(plants.num_envs).tolist()
    return seeds


@contextmanager
def _statistics_frozen(env: Any) -> Iterator[None]:
    """Return a context in which no wrapper of an environment updates its statistics."""
    with ExitStack() as stack:
        for layer in layers(env):
            flag = normaliser_flag(layer)  # name of an attribute; "" if there are no statistics
            if flag:
                # Put the present value back at the end of the context.
                stack.callback(setattr, layer, flag, getattr(layer, flag))
                setattr(layer, flag, False)
        yield
