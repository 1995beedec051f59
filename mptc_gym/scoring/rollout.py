"""Step a policy through a vector environment, and check that the episodes are as expected."""

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

# An info may differ from the expected info by this number times (1 + |expected info|): far more
# than rounding errors, and far less than any change of the plant.
_TOLERANCE: Final = 1e-6

Infos = Mapping[str, Any]  # infos of n plants by name, in arrays of shape (n,)


class Sample(NamedTuple):
    """What n plants return at one sample k."""

    observations: Any  # one row for each plant, as the policy receives them
    infos: Infos  # infos of sample k; at the end of an episode, not those of the next episode
    ended: NDArray[np.bool_]  # whether this sample is the last of an episode, shape (n,)


def rollout(env: Any, act: Act, samples: int, seeds: list[int]) -> Iterator[Sample]:
    """Reset plants, step the plants with the actions of a policy, and yield the samples.

    Parameters
    ----------
    env
        A vector environment of Gymnasium with n plants.
    act
        The policy, as a function from observations to actions, both with a row for each plant.
    samples
        Number N of steps: N + 1 samples are yielded, k = 0, 1, ..., N.
    seeds
        The seeds of the n episodes.

    Raises
    ------
    ValueError
        If `env` cannot begin another episode, or if an action is not finite or of another shape
        than that of the action space.
    """
    try:
        observations, infos = env.reset(seed=seeds)
    except RuntimeError as error:  # from a Monitor that does not allow early resets
        raise ValueError(f"env must allow another episode: {error}") from error
    yield Sample(observations, infos_in_arrays(infos), np.zeros(len(seeds), np.bool_))
    shape = (len(seeds), *env.single_action_space.shape)
    for _ in range(samples):
        actions = _checked_actions(act(observations), shape)
        observations, _, terminated, truncated, infos = env.step(actions)
        arrays = infos_in_arrays(infos)
        # Where an episode ends, some environments return infos of the next episode, and put
        # those of the last sample into "final_info".
        infos_of_sample = arrays.get("final_info", arrays)
        yield Sample(observations, infos_of_sample, terminated | truncated)


def infos_in_arrays(infos: Any) -> Infos:
    """Return the infos of n plants by name, in arrays of shape (n,).

    `infos` is a dict of arrays, which is returned as it is, or a list with a dict for each
    plant. From a list, only numbers are taken, and NaN for a plant without a number of a name.
    """
    if isinstance(infos, Mapping):
        return infos
    names = [name for name, value in infos[0].items() if isinstance(value, int | float)]
    return {name: np.array([info.get(name, np.nan) for info in infos]) for name in names}


def _checked_actions(actions: Any, shape: tuple[int, ...]) -> NDArray[Any]:
    """Return the actions of a policy as an array, after checking that plants can take them.

    A ValueError is raised if the actions are not finite numbers of the shape `shape`.
    """
    if isinstance(actions, tuple):
        allowed = (
            "a function that returns actions alone, such as lambda o: agent.get_action(o)[0], "
            "or with tensors lambda o: agent.get_action(torch.as_tensor(o))[0].numpy()"
        )
        reject("policy", actions, allowed)
    try:
        checked = np.asarray(actions)  # which drops the mask of a masked array
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
    """Yield the samples of a rollout, and check that they belong to the seeds' episodes.

    For the check, a `MiddlePointVectorEnv` with the same arguments and seeds receives the
    commands of the rollout. A ValueError is raised if its infos differ from those of the
    rollout, because the environment of the rollout has reseeded, skipped samples, or changed
    the plant or the infos.
    """
    plants = MiddlePointVectorEnv(len(seeds), **asdict(parameters))
    _, expected = plants.reset(seed=seeds)
    # Limits of the actuator that are sampled for each episode are infos of the reset.
    u_min = expected.get("u_min", parameters.u_min)
    u_max = expected.get("u_max", parameters.u_max)
    for k, sample in enumerate(samples):
        if k > 0:
            commands = np.asarray(sample.infos.get("command", np.zeros(len(seeds))))
            actions = action_from_command(commands, u_min, u_max)[:, np.newaxis]
            expected = plants.step(actions)[-1]
        if k > 0 or sample.infos:  # some environments have no infos of a reset
            _compare_infos(sample.infos, expected, k)
        yield sample


def _compare_infos(infos: Infos, expected: Infos, k: int) -> None:
    """Raise a ValueError if the infos of n plants at sample k differ from the expected ones."""
    names = [name for name in expected if not name.startswith("_")]  # those with "_" are masks
    # The last names come first: they are the plants' numbers that are sampled for an episode,
    # and a difference in these numbers explains differences in other infos.
    for name in reversed(names):
        differences = np.abs(infos.get(name, np.nan) - expected[name])
        if not (differences <= _TOLERANCE * (1.0 + np.abs(expected[name]))).all():
            raise ValueError(
                f"env must run the episodes of its seeds, whose {name} at sample {k} is "
                f"{shorten(expected[name])}, got {shorten(infos.get(name))}: it must not reset "
                "with another seed, skip or repeat samples, or change the plant or info"
            )
