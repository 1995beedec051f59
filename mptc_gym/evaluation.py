"""Score any policy on fixed episodes, in the environments that it is to act in."""

from __future__ import annotations

import itertools
import json
from dataclasses import asdict, dataclass, replace
from functools import cache
from importlib import resources
from typing import Any, Final

import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from mptc_gym import acting
from mptc_gym.checks import MOST_PLANTS, count
from mptc_gym.parameters import ARGUMENTS, Parameters
from mptc_gym.plant import action_from_command
from mptc_gym.presets import IDS
from mptc_gym.vector_env import MiddlePointVectorEnv

Values = NDArray[np.float64]  # one per episode, shape (episodes,)

SEED: Final = 7_000_000  # of the first fixed episode, as the next one has the next seed
VALIDATION_SEED: Final = 5_000_000  # of the first episode to choose policies by
VALIDATION_EPISODES: Final = 200  # with bounds, never published as a result
EPISODES: Final = 100
SAMPLES: Final = 1200  # of an episode, unless its environment ends it earlier
WINDOWS: Final = "setpoint_window", "error_window", "output_window", "action_window"
# Arguments that change observations or rewards, but not the least possible error.
_NO_MATTER: Final = *WINDOWS, "reward", "error_scale", "move_weight"
_RESAMPLES: Final = 2000  # bootstrap resamples


@dataclass(frozen=True, eq=False, repr=False)
class Evaluation:
    """Result of `evaluate`, shown in one line.

    Attributes
    ----------
    env : str
        The environment's id, or the name of its class.
    mean_error, travel : float
        Means of `errors` and `travels`.
    errors, travels : ndarray, shape (episodes,)
        Mean of |e(k)| over k = 1 to N, degC, and distance that the valve moves, t/h.
    seeds : range
        Seeds of the episodes.
    least_possible : float or None
        Least possible mean error, degC: see `benchmarks/bounds`. This and all that follows are
        None where the package has no bound, as for arguments of no preset;
        `python -m benchmarks.bounds` computes others.
    multiple : float or None
        `mean_error / least_possible`.
    score : float or None
        0 for a valve that is left alone, 1 for the least possible error.
    interval : (float, float) or None
        95 % bootstrap interval of the score, from resampled episodes.
    least, scores : ndarray or None, shape (episodes,)
        Least possible error of each episode, degC, and its score against it. Where only noise
        and load are drawn, the error is its expectation over these.
    """

    env: str
    mean_error: float
    travel: float
    errors: Values
    travels: Values
    seeds: range
    least_possible: float | None = None
    multiple: float | None = None
    score: float | None = None
    interval: tuple[float, float] | None = None
    least: Values | None = None
    scores: Values | None = None

    def __repr__(self) -> str:
        error = f"{self.env}: mean error {self.mean_error:.3f} degC"
        alike = ", all alike" if np.ptp(self.errors) == 0.0 else ""
        runs = f"valve travel {self.travel:.0f} t/h; {len(self.errors)} episodes{alike}"
        if self.interval is None:
            return f"{error}; {runs}; no bound is kept: see python -m benchmarks.bounds --help"
        low, high = self.interval
        drawn = f" (95 % {low:.3f} to {high:.3f})" if low < high else ""
        score = f"{self.multiple:.2f} times the least possible; score {self.score:.3f}{drawn}"
        return f"{error}, {score}; {runs}"


def evaluate(
    policy: Any,
    env: Any = IDS["paper"],
    *,
    episodes: int = EPISODES,
    seed: int = SEED,
    **arguments: Any,
) -> Evaluation:
    """Run a policy on fixed episodes and score it.

    As with `evaluate_policy` of Stable-Baselines3, the policy acts in exactly the environments
    that it is given: their windows, wrappers and statistics must be those of its training.

    Parameters
    ----------
    policy
        A function of observations, shape (n, size), that returns actions, shape (n, 1); a
        `torch.nn.Module`, called with tensors, in evaluation mode; or an object with `predict`,
        such as a model of Stable-Baselines3, or with `act`, such as those in `agents`.
        `predict` is given `state`, `episode_start` and `deterministic=True` as far as it takes
        them, others the last where they name it. A method `reset` is called before each round;
        what was learnt carries over.
    env
        An id, such as one of `IDS`, or an `EnvSpec`; a function that makes one environment; or
        environments: one, a vector environment of Gymnasium, or a `VecEnv` of
        Stable-Baselines3, such as `model.get_env()`. These run several rounds if they are fewer
        than `episodes`. They are not closed, their statistics are frozen meanwhile, and they
        begin a new episode afterwards.
    episodes, seed
        Number of episodes, at least 2, and seed of the first. The default is that of all
        published scores. Bounds exist for the 120 episodes from there on: to select a policy,
        use others than the first 100.
    **arguments
        Further arguments for an id or a spec, as in `gymnasium.make`.

    Returns
    -------
    Evaluation
        Mean error, score and valve travel, also of each episode in arrays, shape (episodes,).

    Raises
    ------
    ValueError
        If the environment does not exist, is not one of this package or runs other episodes
        than those of its seeds; or if the policy or its actions do not fit it.

    Examples
    --------
    >>> import mptc_gym, numpy as np
    >>> print(mptc_gym.evaluate(lambda observations: np.zeros((len(observations), 1))))
    MiddlePoint-v0: mean error 5.000 degC, 5.49 times the least possible; score 0.000; \
valve travel 0 t/h; 100 episodes, all alike

    A model of Stable-Baselines3 acts in its own environments, or in others like them:

    >>> from stable_baselines3 import PPO
    >>> plants = mptc_gym.sb3.make_vec_env("MiddlePointNoisy-v0", 10, action_window=20)
    >>> model = PPO("MlpPolicy", plants).learn(20_000)
    >>> mptc_gym.evaluate(model, model.get_env())
    >>> mptc_gym.evaluate(model, mptc_gym.sb3.spec_of(model, "MiddlePointHard-v0"))
    """
    episodes = count("episodes", episodes, 2, MOST_PLANTS)
    first = count("seed", seed, 0, 2**63)
    seeds, by_id = range(first, first + episodes), isinstance(env, str | EnvSpec)
    with acting.opened(env, episodes, policy, **arguments) as plants:
        one, *others = acting.natives(plants)
        case = case_of(one.parameters)
        if any(case_of(each.parameters) != case for each in others):
            raise ValueError("env must have the same plants, but for windows and rewards")
        acting.check_fit(policy, plants)
        most = (by_id and plants.spec.max_episode_steps) or SAMPLES
        # What the package itself makes runs the episodes of its seeds.
        expected = None if by_id and plants.unwrapped is one else one.parameters
        errors, travels, samples = _run(policy, plants, seeds, most, expected)
    return Evaluation(
        env=one.spec.id if one.spec else type(one).__name__,
        mean_error=float(errors.mean()),
        travel=float(travels.mean()),
        errors=errors,
        travels=travels,
        seeds=seeds,
        **_judged(errors, case, samples, seeds),
    )


def _run(
    policy: Any, plants: Any, seeds: range, most: int, expected: Parameters | None = None
) -> tuple[Values, Values, int]:
    """Return the mean |e(k)|, degC, and valve travel, t/h, of an episode per seed; and N.

    Others than those of plants with the arguments `expected`, if any, are refused.
    """
    rounds, lengths, n = [], set(), plants.num_envs
    for first in seeds[::n]:
        own = [*range(first, first + n)]
        steps = acting.rollout(plants, acting.start(policy, n), most, own)
        if expected:
            steps = acting.replayed(steps, MiddlePointVectorEnv(n, **asdict(expected)), own)
        totals = np.zeros((2, n))
        pairs = itertools.pairwise(steps)
        for k, ((before, _), (after, ended)) in enumerate(pairs, 1):  # noqa: B007 (used below)
            totals += np.abs((after["error"], after["applied"] - before["applied"]))
            if ended.any():
                break
        lengths.add(k)
        if len(lengths) > 1 or ended.any() != ended.all():
            raise ValueError(f"env must end all episodes at once, got an end after {k} samples")
        rounds.append(totals)
    errors, travels = np.hstack(rounds)[:, : len(seeds)]
    return errors / k, travels, k


def least_errors(parameters: Parameters, samples: int, seeds: range) -> Values | None:
    """Return the least possible mean error of each episode, degC, or None if it is not kept."""
    least = _kept().get(case_of(parameters))
    if least is None or samples != SAMPLES:
        return None
    if len(least) == 1:  # only noise and load are drawn, if anything: it holds for any seeds
        return np.repeat(least, len(seeds))
    first, beyond = seeds.start - SEED, seeds.stop - SEED
    return least[first:beyond] if first >= 0 and beyond <= len(least) else None


@cache
def _kept() -> dict[Parameters, Values]:
    """Return the bounds written by `python -m benchmarks.bounds --package`, by case."""
    text = resources.files("mptc_gym").joinpath("bounds.json").read_text(encoding="utf-8")
    cases = json.loads(text)["cases"].values()
    return {case_of(Parameters(**case["arguments"])): np.array(case["least"]) for case in cases}


def case_of(parameters: Parameters) -> Parameters:
    """Return the arguments, with those that do not affect the bound at their defaults."""
    return replace(parameters, **{name: ARGUMENTS[name].default for name in _NO_MATTER})


def _judged(
    errors: Values, parameters: Parameters, samples: int, seeds: range
) -> dict[str, Any]:
    """Return what an `Evaluation` says of errors beside the bound, if there is one."""
    least = least_errors(parameters, samples, seeds)
    if least is None:
        return {}
    rest, n = action_from_command(0.0, parameters.u_min, parameters.u_max), len(seeds)
    plants = MiddlePointVectorEnv(n, **asdict(parameters))
    idle, *_ = _run(lambda _: np.full((n, 1), rest), plants, seeds, samples)
    gained, possible = idle - errors, idle - least
    generator = np.random.default_rng(0)
    drawn = (generator.integers(n, size=n) for _ in range(_RESAMPLES))
    quotients = [gained[which].mean() / possible[which].mean() for which in drawn]
    low, high = np.quantile(quotients, (0.025, 0.975)).tolist()
    return {
        "least_possible": float(least.mean()),
        "multiple": float(errors.mean() / least.mean()),
        "score": float(gained.mean() / possible.mean()),
        "interval": (low, high),
        "least": least,
        "scores": gained / possible,
    }
