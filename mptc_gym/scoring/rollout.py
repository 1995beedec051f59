"""Step a policy through a vector environment, and check the episodes that it runs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mptc_gym.checks import reject, shorten
from mptc_gym.parameters import Parameters
from mptc_gym.plant import action_from_command
from mptc_gym.scoring.policies import Act
from mptc_gym.vector_env import MiddlePointVectorEnv

_TOLERANCE: Final = 1e-6  # of infos, in their units, and relative to their values

Infos = Mapping[str, Any]  # by name, arrays of shape (n,)


class Sample(NamedTuple):
    """What n plants return at one sample."""

    observations: Any  # one row for each plant, as the policy receives them
    infos: Infos  # of this sample, also where the same step begins the next episode
    ended: NDArray[np.bool_]  # whether this sample is the last of an episode, shape (n,)


def rollout(env: Any, act: Act, samples: int, seeds: list[int]) -> Iterator[Sample]:
    """Reset plants, step them with the actions of a policy, and yield the samples.

    Parameters
    ----------
    env
        A vector environment of Gymnasium with n plants.
    act
        The policy: it takes observations, one row for each plant, and returns actions.
    samples
        Number N of steps: N + 1 samples are yielded, k = 0, 1, ..., N.
    seeds
        The n seeds of the episodes.

    Raises
    ------
    ValueError
        If the environment refuses a reset, or if an action is not finite or of another shape.
    """
    try:
        observations, infos = env.reset(seed=seeds)
    except RuntimeError as error:  # from a Monitor that does not allow early resets
        raise ValueError(f"env must allow another episode: {error}") from error
    yield Sample(observations, in_columns(infos), np.zeros(len(seeds), np.bool_))
    shape = (len(seeds), *env.single_action_space.shape)
    for _ in range(samples):
        actions = _checked(act(observations), shape)
        observations, _, terminated, truncated, infos = env.step(actions)
        columns = in_columns(infos)
        last = columns.get("final_info", columns)
        yield Sample(observations, last, terminated | truncated)


def in_columns(infos: Any) -> Infos:
    """Return infos by name, as arrays of shape (n,).

    Infos that come as dicts, one for each plant, are reduced to their numbers.
    """
    if isinstance(infos, Mapping):
        return infos
    names = [name for name, value in infos[0].items() if isinstance(value, int | float)]
    return {name: np.array([info.get(name, np.nan) for info in infos]) for name in names}


def _checked(actions: Any, shape: tuple[int, ...]) -> NDArray[Any]:
    """Return the actions of a policy as an array; ValueError if the plants cannot take them."""
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


def replayed(
    samples: Iterator[Sample], parameters: Parameters, seeds: list[int]
) -> Iterator[Sample]:
    """Yield the samples of a rollout, as long as they are those of the seeds' episodes.

    Plain plants with these parameters and seeds receive the commands of the rollout. A
    ValueError is raised at the first sample whose infos differ from those of the plain plants:
    the environment has then reseeded, skipped samples, or changed the plant or the infos.
    """
    plants = MiddlePointVectorEnv(len(seeds), **asdict(parameters))
    _, expected = plants.reset(seed=seeds)
    u_min = expected.get("u_min", parameters.u_min)
    u_max = expected.get("u_max", parameters.u_max)
    for k, sample in enumerate(samples):
        if k > 0:
            commands = np.asarray(sample.infos.get("command", np.zeros(len(seeds))))
            actions = action_from_command(commands, u_min, u_max)[:, np.newaxis]
            expected = plants.step(actions)[-1]
        if k > 0 or sample.infos:  # some environments have no infos of a reset
            _compare(sample.infos, expected, k)
        yield sample


def _compare(infos: Infos, expected: Infos, k: int) -> None:
    """Raise a ValueError if the infos of sample k differ from the expected ones."""
    # The last names first: a number that was drawn says more than what follows from it.
    for name in reversed([name for name in expected if not name.startswith("_")]):
        differences = np.abs(infos.get(name, np.nan) - expected[name])
        if not (differences <= _TOLERANCE * (1.0 + np.abs(expected[name]))).all():
            raise ValueError(
                f"env must run the episodes of its seeds, whose {name} at sample {k} is "
                f"{shorten(expected[name])}, got {shorten(infos.get(name))}: it must not reset "
                "with another seed, skip or repeat samples, or change the plant or info"
            )
