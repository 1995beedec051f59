"""Let a policy act in environments: open them, step them, and check the episodes they run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict
from functools import partial
from typing import Any, Final, cast

import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from mptc_gym.adapters import Infos, Plants, Sample, SeparatePlants, VectorPlants, adapted
from mptc_gym.checks import reject, shorten
from mptc_gym.copies import Copy, copied, freeze, training_flag
from mptc_gym.env import MiddlePointEnv
from mptc_gym.layers import (
    Processes,
    have_a_layer_in_common,
    is_environment,
    layers,
    loaded,
    runs_processes,
)
from mptc_gym.making import make_batch, make_by, make_one
from mptc_gym.parameters import Parameters
from mptc_gym.plant import action_from_command
from mptc_gym.policies import Act, evaluation_mode, object_of
from mptc_gym.vector_env import MiddlePointVectorEnv

_TOLERANCE: Final = 1e-6  # of infos, degC or t/h, and relative to them


def rollout(plants: Plants, act: Act, samples: int, seeds: list[int]) -> Iterator[Sample]:
    """Reset plants and step them with a policy; yield samples k = 0, 1, ..., `samples`."""
    try:
        sample = plants.reset(seeds)
    except RuntimeError as error:  # of a Monitor, in the middle of an episode
        raise ValueError(f"env must allow another episode: {error}") from error
    yield sample
    shape = (plants.num_envs, *plants.action_space.shape)
    for _ in range(samples):
        actions = _checked(act(sample.observations), shape)
        sample = plants.step(actions)
        yield sample


def _checked(actions: Any, shape: tuple[int, ...]) -> NDArray[Any]:
    """Return the actions of a policy as an array, if the environments can take them."""
    if isinstance(actions, tuple):
        allowed = (
            "a function that returns actions alone, such as lambda o: agent.get_action(o)[0], "
            "or with tensors lambda o: agent.get_action(torch.as_tensor(o))[0].numpy()"
        )
        reject("policy", actions, allowed)
    try:
        checked = np.asarray(actions)
        if checked.shape == shape and np.isfinite(checked).all():
            return checked
        received = f"{shorten(checked)}, shape {checked.shape}"
    except (TypeError, ValueError, RuntimeError) as error:  # the last: from tensors
        received = f"{shorten(actions)} ({error})"
    raise ValueError(f"policy must return finite actions, shape {shape}, got {received}")


class Replay:
    """The episodes of seeds in the plain plants, to compare with what an environment shows.

    An environment may reseed, skip samples, or change the plant or the info; its errors are
    then not those of the episodes, and the first difference is a ValueError.
    """

    def __init__(self, parameters: Parameters, seeds: list[int]) -> None:
        self._plants = MiddlePointVectorEnv(len(seeds), **asdict(parameters))
        _, self._infos = self._plants.reset(seed=seeds)
        self._limits = [
            self._infos.get(name, getattr(parameters, name)) for name in ("u_min", "u_max")
        ]
        self._sample = 0  # k

    def check_reset(self, infos: Infos) -> None:
        """Compare the infos of a reset, unless the environment keeps none."""
        if infos:
            self._compare(infos)

    def check_step(self, infos: Infos) -> None:
        """Step with the commands in the infos of a step, and compare them."""
        self._sample += 1
        commands = np.asarray(infos.get("command", np.zeros(self._plants.num_envs)))
        actions = action_from_command(commands, *self._limits)[:, np.newaxis]
        self._infos = self._plants.step(actions)[-1]
        self._compare(infos)

    def _compare(self, infos: Infos) -> None:
        # The last names first: what is drawn tells more than what follows from it.
        for name in reversed([name for name in self._infos if not name.startswith("_")]):
            expected = self._infos[name]
            differences = np.abs(infos.get(name, np.nan) - expected)
            if not (differences <= _TOLERANCE * (1.0 + np.abs(expected))).all():
                raise ValueError(
                    f"env must run the episodes of its seeds, whose {name} at sample "
                    f"{self._sample} is {shorten(expected)}, got {shorten(infos.get(name))}: "
                    "it must not reset with another seed, skip or repeat samples, or change "
                    "the plant or info"
                )


@contextmanager
def opened(env: Any, n: int, policy: Any = None, /, **arguments: Any) -> Iterator[Plants]:
    """Yield plants to act in: n that it makes, or a copy of environments that are handed over.

    What it makes is closed afterwards. Environments that cannot be copied act themselves and
    begin a new episode afterwards, unless a model trains in them, which is a ValueError.
    Statistics of wrappers are not updated, and modules of PyTorch are in evaluation mode.
    """
    with ExitStack() as stack:
        stack.enter_context(evaluation_mode(policy))
        if is_environment(env):
            if arguments:
                raise ValueError(f"{', '.join(arguments)} must be given where env is made")
            plants = stack.enter_context(_handed_over(env, policy))
        else:
            plants = _made(env, n, arguments)
            stack.callback(plants.close)
        _check_plants(plants)
        _freeze_statistics(plants)
        yield plants


def _made(env: Any, n: int, arguments: Mapping[str, Any]) -> Plants:
    """Return n environments of an id or a spec, or those that a function makes."""
    if isinstance(env, str | EnvSpec):
        batch = make_batch(make_one(env, arguments), n)
        if batch is None:
            return SeparatePlants(make_by(partial(make_one, env, arguments), n))
        plants = VectorPlants(batch)
        plants.are_trusted = batch.unwrapped is batch
        return plants
    if arguments:
        raise ValueError(f"{', '.join(arguments)} must be given where env is made")
    if not callable(env):
        allowed = "an id, an EnvSpec, environments, or a function that makes one"
        reject("env", env, f"{allowed} (a model that was loaded has no environments)")
    return SeparatePlants(make_by(env, n))


@contextmanager
def _handed_over(env: Any, policy: Any) -> Iterator[Plants]:
    """Yield a copy of environments that are handed over, as far as they can be copied."""
    copy = copied(env)
    refuse_the_models_own(copy, policy)
    if not copy.shared:
        yield adapted(copy.env)
        return
    seeds = _new_seeds(env)
    with _frozen(env):
        try:
            yield adapted(copy.env)
        except BaseException:
            with suppress(Exception):  # the first error says more
                adapted(env).reset(seeds)
            raise
        adapted(env).reset(seeds)


def refuse_the_models_own(copy: Copy, policy: Any) -> None:
    """Refuse a copy that runs environments themselves in which a model trains."""
    training = getattr(object_of(policy), "env", None)
    if not is_environment(training):
        return
    for layer in copy.shared:
        if have_a_layer_in_common(layer, training):
            raise ValueError(
                "env must not be the training environments of policy, as these cannot be "
                f"copied ({copy.reason}): make others like them, or use "
                "evaluate(model, spec_of(model, id)), with spec_of from mptc_gym.sb3"
            )


def _new_seeds(env: Any) -> list[int]:
    """Return seeds of new episodes, which follow from the seeds of the present ones.

    So a training that goes on does not meet the episodes of a score, and can be repeated.
    """
    present: list[int | None] = []
    for layer in layers(env):
        if isinstance(layer, MiddlePointEnv | MiddlePointVectorEnv):
            present += np.atleast_1d(np.array(layer.np_random_seed, object)).tolist()
        elif runs_processes(layer):
            present += Processes(layer).seeds()
    entropy = None if None in present else [abs(cast("int", seed)) for seed in present]
    n = getattr(env, "num_envs", 1)
    seeds: list[int] = np.random.SeedSequence(entropy).generate_state(n).tolist()
    return seeds


@contextmanager
def _frozen(env: Any) -> Iterator[None]:
    """Stop the wrappers of an environment from updating their statistics, for a while."""
    with ExitStack() as stack:
        for layer in layers(env):
            flag = training_flag(layer)
            if flag is not None:
                stack.callback(setattr, layer, flag, getattr(layer, flag))
                setattr(layer, flag, False)
        yield


def _check_plants(plants: Plants) -> None:
    """Refuse environments that hold no plants in NumPy."""
    if plants.groups:
        return
    env = plants.environments[0]
    allowed = "an open environment of MiddlePointEnv in NumPy, wrapped or not"
    if isinstance(env, loaded("mptc_gym.torch_env.MiddlePointTorchEnv")):
        allowed = "an environment in NumPy, such as one of the same id or spec"
    reject("env", env, allowed)


def _freeze_statistics(plants: Plants) -> None:
    """Stop wrappers from updating their statistics, and refuse those that have none."""
    for env in plants.environments:
        for layer in layers(env):
            if runs_processes(layer) and Processes(layer).normalise():
                raise ValueError(
                    "env must not normalise in other processes, where its statistics cannot "
                    "be frozen: use DummyVecEnv or SyncVectorEnv"
                )
            if training_flag(layer) is not None:
                freeze(layer)
                _check_statistics(layer)


def _check_statistics(layer: Any) -> None:
    """Refuse a wrapper that normalises by statistics of nothing."""
    statistics = getattr(layer, "obs_rms", {})
    parts = statistics.values() if isinstance(statistics, dict) else [statistics]
    for part in parts:
        if not part.mean.any() and (part.var == 1.0).all():
            raise ValueError(
                f"env must have the statistics of the training in {type(layer).__name__}, "
                "which has seen nothing: load or copy them"
            )
