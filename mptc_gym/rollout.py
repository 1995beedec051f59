"""Run a policy in a vector environment, and check that the episodes belong to their seeds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mptc_gym.plant.checks import reject, shorten
from mptc_gym.plant.dynamics import action_from_command
from mptc_gym.plant.parameters import Parameters
from mptc_gym.scoring.policies import Act
from mptc_gym.vector_env import MiddlePointVectorEnv

# Largest difference between an info and the expected info, divided by (1 + |expected info|):
# far more than rounding errors, and far less than the effect of another plant or seed.
_TOLERANCE: Final = 1e-6

Infos = Mapping[str, Any]  # infos of n plants by name, in arrays of shape (n,)


class Sample(NamedTuple):
    """Observations and infos of n plants at one sample k."""

    # One row for each plant. At the end of an episode, some environments return the first
    # observation of the next episode.
    observations: Any
    infos: Infos  # infos of sample k; at the end of an episode, not those of the next episode
    ended: NDArray[np.bool_]  # whether this sample is the last of an episode, shape (n,)


def rollout(env: Any, act: Act, samples: int, seeds: list[int]) -> Iterator[Sample]:
    """Yield the samples of n plants that a policy controls, beginning with a reset.

    `env` is a vector environment of Gymnasium with a plant for each seed. The samples k = 0, 1,
    ..., N are yielded, where N is the argument `samples`. A ValueError is raised if `env` does
    not allow a reset, or if the policy returns actions that are not finite or do not have the
    shape of the action space.
    """
    try:
        observations, infos = env.reset(seed=seeds)
    except RuntimeError as error:  # from a Monitor that does not allow early resets
        raise ValueError(f"env must allow a reset in mid-episode: {error}") from error
    yield Sample(observations, _copied(infos_in_arrays(infos)), np.zeros(len(seeds), np.bool_))
    shape = (len(seeds), *env.single_action_space.shape)
    for _ in range(samples):
        actions = _checked_actions(act(observations), shape)
        observations, _, terminated, truncated, infos = env.step(actions)
        arrays = infos_in_arrays(infos)
        # At the end of an episode, some environments return the infos of the next episode, and
        # put the infos of the last sample into "final_info".
        infos_of_sample = _copied(arrays.get("final_info", arrays))
        yield Sample(observations, infos_of_sample, terminated | truncated)


def infos_in_arrays(infos: Any) -> Infos:
    """Return the infos of n plants as a dict from names to arrays of shape (n,).

    A dict `infos` is returned unchanged. A list `infos` holds a dict for each plant; only names
    that have a number in the first dict are kept, and a number that a plant lacks becomes NaN.
    """
    if isinstance(infos, Mapping):
        return infos
    names = [name for name, value in infos[0].items() if isinstance(value, int | float)]
    return {name: np.array([info.get(name, np.nan) for info in infos]) for name in names}


def _copied(infos: Infos) -> Infos:
    """Return infos as a new dict of new arrays, without the masks under names such as "_error".

    A wrapper may write the infos of the next sample into the arrays of this sample.
    """
    return {name: np.array(infos[name]) for name in infos if not name.startswith("_")}


def _checked_actions(actions: Any, shape: tuple[int, ...]) -> NDArray[Any]:
    """Return the actions of a policy as an array, after a check of shape and values.

    A ValueError is raised if the actions are not finite numbers in an array of shape `shape`.
    """
    if isinstance(actions, tuple):
        allowed = (
            "a function that returns actions alone, such as lambda o: agent.get_action(o)[0], "
            "or with tensors lambda o: agent.get_action(torch.as_tensor(o))[0].numpy()"
        )
        reject("policy", actions, allowed)
    try:
        checked = np.asarray(actions)  # `asarray` drops the mask of a masked array
        is_masked = np.ma.is_masked(actions)
        if checked.shape == shape and np.isfinite(checked).all() and not is_masked:
            return checked
        received = f"{shorten(actions)}, shape {checked.shape}"
    except (TypeError, ValueError, RuntimeError) as error:  # RuntimeError: from tensors
        received = f"{shorten(actions)} ({error})"
    raise ValueError(f"policy must return finite actions, shape {shape}, got {received}")


def replayed(
    samples: Iterator[Sample], parameters: Parameters, seeds: list[int]
) -> Iterator[Sample]:
    """Yield the samples of a rollout, and compare each sample with a second simulation.

    The second simulation is a `MiddlePointVectorEnv` with the arguments, the seeds and the
    commands of the rollout. A ValueError is raised if infos of the rollout differ from infos of
    the second simulation: the environment of the rollout then has changed the seed, skipped
    samples, or changed the plant or the infos.
    """
    plants = MiddlePointVectorEnv(len(seeds), **(asdict(parameters) | {"action": "flow"}))
    _, expected = plants.reset(seed=seeds)
    for k, sample in enumerate(samples):
        if k > 0:
            commands = np.asarray(sample.infos.get("command", np.zeros(len(seeds))))
            actions = action_from_command(commands, parameters.u_min, parameters.u_max)[
                :, np.newaxis
            ]
            expected = plants.step(actions)[-1]
        if k > 0 or sample.infos:  # some environments return no infos at a reset
            _compare_infos(sample.infos, expected, k)
        yield sample


def _compare_infos(infos: Infos, expected: Infos, k: int) -> None:
    """Raise a ValueError if infos of n plants at sample k differ from the expected infos."""
    names = [name for name in expected if not name.startswith("_")]  # "_name" is a mask
    # Compare the last names first: the last infos of a step are the noise, the load and the
    # drift factors, in which a difference explains differences in other infos.
    for name in reversed(names):
        differences = np.abs(infos.get(name, np.nan) - expected[name])
        if not (differences <= _TOLERANCE * (1.0 + np.abs(expected[name]))).all():
            raise ValueError(
                f"env must run the episodes of its seeds, whose {name} at sample {k} is "
                f"{shorten(expected[name])}, got {shorten(infos.get(name))}: env must not "
                "reset with another seed, skip or repeat samples, or change the plant or infos"
            )
