"""Turn the argument `env` of `evaluate` into one vector environment of Gymnasium.

`env` is an id, a spec (`EnvSpec`), a function that makes an environment, or environments of
Gymnasium or Stable-Baselines3.
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
from mptc_gym.rollout import infos_in_arrays
from mptc_gym.scoring.copies import Copy
from mptc_gym.scoring.policies import form_of

# Base class of the attribute `policy` of a Stable-Baselines3 model.
_POLICY_NETWORK: Final = "stable_baselines3.common.policies.BaseModel"

# A vector environment of Gymnasium. The annotation is not `VectorEnv`, because the annotated
# method `VectorEnv.reset` takes no list of seeds.
Plants = Any


@contextmanager
def opened(env: Any, n: int, policy: Any, /, **arguments: Any) -> Iterator[Plants]:
    """Return a context manager that yields a vector environment in which a policy can act.

    The forms of `env` and `policy` are those that `mptc_gym.evaluate` takes. If `env` is an id,
    a spec or a function, n plants are made, and closed at the end of the context. If `env` is
    an environment, the policy acts in a copy of this environment. An environment that cannot be
    copied is used directly, and is reset at the end of the context. While the policy acts, no
    wrapper updates normalisation statistics.

    A ValueError is raised if `evaluate` does not take the form of `env` or `policy`, if `env`
    holds no NumPy environments of this package, or if `env` is the training environment of
    `policy` and cannot be copied.
    """
    target = form_of(policy).target
    if arguments and not isinstance(env, str | EnvSpec):
        raise ValueError(
            f"{', '.join(arguments)} must be given where env is made: evaluate takes arguments "
            "of the plant only if env is an id or an EnvSpec"
        )
    with ExitStack() as stack:  # which undoes the steps below, the last step first
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
        if originals_act:  # as at least one object of `env` could not be copied
            stack.enter_context(_statistics_frozen(env))
            stack.callback(_as_vector(env).reset, seed=_next_seeds(plants))
        stack.enter_context(_statistics_frozen(plants))
        yield plants


def _make(env: Any, n: int, arguments: Mapping[str, Any]) -> Plants:
    """Return a vector environment with n plants, made from an id, a spec or a function."""
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
    # SyncVectorEnv takes functions that make environments. The default argument binds each
    # function to a different environment.
    return SyncVectorEnv([lambda env=env: env for env in environments])  # type: ignore[misc]


def _as_vector(env: Any) -> Plants:
    """Return an environment of any kind as a vector environment of Gymnasium."""
    if isinstance(env, VectorEnv):
        return env
    if not isinstance(env, gymnasium.Env):
        return _FromVecEnv(env)
    plants = _sync_vector_env([env])
    # Some versions of Gymnasium close the inner environments of a vector environment when the
    # vector environment is deleted, unless the vector environment is marked as closed.
    plants.closed = True
    return plants


class _FromVecEnv(VectorEnv[Any, Any, Any]):
    """A vector environment of Gymnasium that wraps a `VecEnv` of Stable-Baselines3."""

    def __init__(self, venv: Any) -> None:
        self.venv = venv
        self.num_envs = venv.num_envs
        self.single_observation_space = venv.observation_space
        self.single_action_space = venv.action_space
        self.closed = True  # so that deleting this object does not close the `VecEnv`

    @property
    def np_random_seed(self) -> Any:
        """The latest seeds of all plants, in a list."""
        return self.venv.get_attr("np_random_seed")

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Reset all plants, and return observations and infos, both in arrays.

        A `GymnasiumVecEnv` uses all seeds of the list `seed`, one for each plant. Any other
        `VecEnv` uses only the first seed, and gives plant i the first seed + i.
        """
        innermost = self.venv.unwrapped
        if hasattr(innermost, "set_seeds"):
            innermost.set_seeds(seed)
        else:
            self.venv.seed(seed[0])
        observations = self.venv.reset()
        return observations, {**infos_in_arrays(innermost.reset_infos)}

    def step(self, actions: NDArray[Any]) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step all plants; return observations, rewards, `terminated`, `truncated` and infos.

        Every episode that has ended counts as terminated, and none as truncated.
        """
        observations, rewards, ended, infos = self.venv.step(actions)
        # A `GymnasiumVecEnv` fills its list of infos only where episodes end, and has the infos
        # of all plants in its attribute `infos`.
        arrays = infos_in_arrays(infos) or getattr(self.venv.unwrapped, "infos", {})
        return observations, rewards, ended, np.zeros_like(ended), {**arrays}


def _refuse_training_environments(copy: Copy, target: Any) -> None:
    """Raise a ValueError if a policy may train in an environment that was not copied.

    `target` is the policy, or the object of the policy if the policy is a bound method. A
    policy network `model.policy` does not know the training environments of the model, so for a
    policy network, the error is raised for any environment that was not copied.
    """
    training = getattr(target, "env", None)
    trains_there = is_environment(training) and any(
        id(wrapper_or_environment) in copy.shared for wrapper_or_environment in layers(training)
    )
    # `loaded` returns the class if its module has been imported, and () otherwise.
    is_policy_network = isinstance(target, loaded(_POLICY_NETWORK))
    if trains_there or (copy.shared and is_policy_network):
        raise ValueError(
            "env must not be the training environments of policy, as these cannot be copied "
            f"({copy.reason}): make others like them, and pass the model itself, not "
            "model.policy, or use evaluate(model, spec_of(model, id)) with mptc_gym.sb3.spec_of"
        )


def _next_seeds(plants: Plants) -> list[int]:
    """Return a seed for the next episode of each plant, computed from the present seeds.

    After an evaluation, a user's environments need new seeds, because otherwise the random
    numbers would continue where the scored episodes end. The new seeds depend only on the
    present seeds, so a program that is run again gives the same results.
    """
    present_seeds = np.ravel(plants.unwrapped.np_random_seed).tolist()
    # Gymnasium marks an unknown seed by -1, and a SeedSequence takes no negative number.
    entropy = [abs(seed) for seed in present_seeds if seed is not None]
    seeds: list[int] = np.random.SeedSequence(entropy).generate_state(plants.num_envs).tolist()
    return seeds


@contextmanager
def _statistics_frozen(env: Any) -> Iterator[None]:
    """Return a context in which no wrapper of `env` updates normalisation statistics."""
    with ExitStack() as stack:
        for layer in layers(env):
            flag = normaliser_flag(layer)  # name of an attribute, or ""
            if flag:
                # Restore the present value of the flag at the end of the context.
                stack.callback(setattr, layer, flag, getattr(layer, flag))
                setattr(layer, flag, False)
        yield
