"""Run a policy on a batch of plants: the one loop for scores, benchmarks and tests."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from mptc_gym.checks import shorten


class Step(NamedTuple):
    """What a step of a batch showed; the arrays have one element per plant."""

    before: dict[str, Any]
    """The infos at sample k."""
    after: dict[str, Any]
    """The infos at sample k + 1."""
    ended: NDArray[np.bool_]
    """Whether the episodes have ended."""


def rollout(
    plants: VectorEnv[Any, Any, Any],
    act: Callable[[Any], Any],
    samples: int,
    seed: int,
) -> Iterator[Step]:
    """Reset a batch with seeds from `seed` on, and step it through samples k = 0, 1, ...

    `act` is called with the observations, shape (n, size), and returns the actions.

    Raises
    ------
    ValueError
        If actions have the wrong shape or are not finite.
    """
    observations, infos = plants.reset(seed=seed)
    for k in range(samples):
        actions = _checked(act(observations), plants.action_space.shape, k)
        before = infos
        observations, _, terminated, truncated, infos = plants.step(actions)
        yield Step(before, infos, terminated | truncated)


def _checked(actions: Any, shape: Any, k: int) -> NDArray[Any]:
    """Return a policy's actions at sample k as an array, if the environments can take them."""
    try:
        checked = np.asarray(actions)
        finite = np.isfinite(checked)
    except (TypeError, ValueError, RuntimeError) as error:  # the last: from tensors
        hint = "its first element" if isinstance(actions, tuple) else f"an array ({error})"
        raise ValueError(
            f"policy must return an array of numbers, got {shorten(actions)}: return {hint}"
        ) from error
    if checked.shape != shape:
        raise ValueError(f"policy must return actions of shape {shape}, got {checked.shape}")
    if not finite.all():
        wrong = checked[~finite][0]
        raise ValueError(f"policy must return finite actions, got {wrong} at sample {k}")
    return checked
