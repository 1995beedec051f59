"""Open environments of any kind as one vector environment of Gymnasium to act in."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any, Final

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import SyncVectorEnv, VectorEnv
from numpy.typing import NDArray

from mptc_gym.checks import reject
from mptc_gym.layers import is_environment, layers, loaded, normaliser_flag, plant_groups
from mptc_gym.making import Env, make_batch, make_one
from mptc_gym.scoring.copies import Copy
from mptc_gym.scoring.policies import form_of
from mptc_gym.scoring.rollout import in_columns

_POLICY_OF_A_MODEL: Final = "stable_baselines3.common.policies.BaseModel"

# A vector environment of Gymnasium. `VectorEnv` as its type does not allow a list of seeds.
Plants = Any


@contextmanager
def opened(env: Any, n: int, policy: Any, /, **arguments: Any) -> Iterator[Plants]:
    """Open a vector environment for a policy to act in.

    While it is open, wrappers that normalise do not update their statistics.

    Parameters
    ----------
    env
        As in `mptc_gym.evaluate`. The policy acts in a copy of environments that are handed
        over. Environments that cannot be copied act themselves, and begin a new episode
        afterwards. Environments that are made here are closed afterwards.
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
        NumPy; or if it cannot be copied and is the environment in which `policy` trains.
    """
    target = form_of(policy).target
    if arguments and not isinstance(env, str | EnvSpec):
        raise ValueError(
            f"{', '.join(arguments)} must be given where env is made: evaluate takes arguments "
            "of the plant only with an id or a spec"
        )
    with ExitStack() as stack:  # which undoes all in the reverse order
        if is_environment(env):
            copy = Copy(env)
            _refuse_training_environments(copy, target)
            plants = _as_vector(copy.env)
            acts_itself = bool(copy.shared)
        else:
            plants = _make(env, n, arguments)
            acts_itself = False
            stack.callback(plants.close)
        if not plant_groups(plants):
            allowed = "of MiddlePointEnv in NumPy, and open, such as an id or a spec of it"
            reject("env", env, allowed)
        if acts_itself:  # within the copies of wrappers that can be copied
            stack.enter_context(_frozen(env))
            stack.callback(_as_vector(env).reset, seed=_next_seeds(plants))
        stack.enter_context(_frozen(plants))
        yield plants


def _make(env: Any, n: int, arguments: Mapping[str, Any]) -> Plants:
    """Make n plants from an id or a spec, or by n calls of a function."""
    if isinstance(env, str | EnvSpec):
        single = make_one(env, arguments)
        batch = make_batch(single, n)
        if batch is None:
            return _in_turn([single, *(make_one(env, arguments) for _ in range(n - 1))])
        return batch
    if not callable(env):
        allowed = "an id, an EnvSpec, environments, or a function that makes one"
        reject("env", env, f"{allowed} (a model that was loaded has no environments)")
    environments = [env() for _ in range(n)]
    for environment in environments:
        if not isinstance(environment, gymnasium.Env):
            allowed = "a function that makes one environment; where it makes many, call it"
            reject("env", environment, allowed)
    return _in_turn(environments)


def _in_turn(environments: list[Env]) -> Plants:
    """Return a vector environment that steps environments one after another."""
    return SyncVectorEnv([lambda env=env: env for env in environments])  # type: ignore[misc]


def _as_vector(env: Any) -> Plants:
    """Return environments of any kind as a vector environment of Gymnasium."""
    if isinstance(env, VectorEnv):
        return env
    if not isinstance(env, gymnasium.Env):
        return _FromVecEnv(env)
    plants = _in_turn([env])
    plants.closed = True  # as some versions of Gymnasium close what a deleted one holds
    return plants


class _FromVecEnv(VectorEnv[Any, Any, Any]):
    """A `VecEnv` of Stable-Baselines3 as a vector environment of Gymnasium."""

    def __init__(self, venv: Any) -> None:
        self.venv = venv
        self.num_envs = venv.num_envs
        self.single_observation_space = venv.observation_space
        self.single_action_space = venv.action_space
        self.closed = True  # as only the user closes environments that are handed over

    @property
    def np_random_seed(self) -> Any:
        """The latest seed of each plant, in a list."""
        return self.venv.get_attr("np_random_seed")

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Reset all plants, and return observations and infos.

        Only a `GymnasiumVecEnv` takes a seed for each plant. Another `VecEnv` takes the first
        seed, and gives the following integers to the other plants.
        """
        innermost = self.venv.unwrapped
        if hasattr(innermost, "set_seeds"):
            innermost.set_seeds(seed)
        else:
            self.venv.seed(seed[0])
        observations = self.venv.reset()
        return observations, {**in_columns(innermost.reset_infos)}

    def step(self, actions: NDArray[Any]) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step all plants, and return observations, rewards, flags and infos."""
        observations, rewards, ended, infos = self.venv.step(actions)
        # A `GymnasiumVecEnv` fills its list of infos only where episodes end.
        columns = in_columns(infos) or getattr(self.venv.unwrapped, "infos", {})
        return observations, rewards, ended, np.zeros_like(ended), {**columns}


def _refuse_training_environments(copy: Copy, target: Any) -> None:
    """Raise a ValueError if `target`, a policy, may train in layers that a copy shares.

    The `policy` of a model of Stable-Baselines3 does not know the environments of the model, so
    it may train in any.
    """
    training = getattr(target, "env", None)
    trains_there = is_environment(training) and any(
        id(layer) in copy.shared for layer in layers(training)
    )
    is_part_of_a_model = isinstance(target, loaded(_POLICY_OF_A_MODEL))
    if trains_there or (copy.shared and is_part_of_a_model):
        raise ValueError(
            "env must not be the training environments of policy, as these cannot be copied "
            f"({copy.reason}): make others like them, and pass the model itself, or use "
            "evaluate(model, spec_of(model, id)), with spec_of from mptc_gym.sb3"
        )


def _next_seeds(plants: Plants) -> list[int]:
    """Return seeds of new episodes, which follow from the seeds of the present episodes.

    With these seeds, the environments of a user do not go on with the episodes of a score, and
    a user who seeds the environments can repeat a program.
    """
    present = np.ravel(plants.unwrapped.np_random_seed).tolist()
    # Gymnasium has a negative number for a seed that it does not know.
    entropy = [abs(seed) for seed in present if seed is not None]
    seeds: list[int] = np.random.SeedSequence(entropy).generate_state(plants.num_envs).tolist()
    return seeds


@contextmanager
def _frozen(env: Any) -> Iterator[None]:
    """Keep the wrappers of an environment from updating their statistics for a while."""
    with ExitStack() as stack:
        for layer in layers(env):
            flag = normaliser_flag(layer)
            if flag:
                stack.callback(setattr, layer, flag, getattr(layer, flag))
                setattr(layer, flag, False)
        yield
