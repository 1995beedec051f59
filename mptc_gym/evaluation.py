"""Score any policy on fixed episodes, in the environments in which the policy is to act."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import cache
from importlib import resources
from typing import Any, Final, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from mptc_gym.environments.layers import plant_groups
from mptc_gym.plant.checks import MOST_PLANTS, count
from mptc_gym.plant.dynamics import action_from_command
from mptc_gym.plant.parameters import ARGUMENTS, Parameters
from mptc_gym.presets import IDS
from mptc_gym.scoring.fit import check_fit
from mptc_gym.scoring.opening import Plants, opened
from mptc_gym.scoring.policies import start
from mptc_gym.scoring.rollout import Sample, replayed, rollout
from mptc_gym.vector_env import MiddlePointVectorEnv

Values = NDArray[np.float64]  # one number for each episode, shape (episodes,)

# The seed of the first of the episodes behind published scores; episode i has the seed SEED +
# i. The value is arbitrary, but never changes, so that scores stay comparable.
SEED: Final = 7_000_000
EPISODES: Final = 100  # episodes of a published score
# The seed of the first of the episodes for choosing among policies, which no published score
# uses; episode i has the seed VALIDATION_SEED + i.
VALIDATION_SEED: Final = 5_000_000
VALIDATION_EPISODES: Final = 200  # episodes for which the package has bounds
SAMPLES: Final = 1200  # samples of an episode, unless the environment ends the episode earlier
WINDOWS: Final = "setpoint_window", "error_window", "output_window", "action_window"
# The arguments of an environment that change observations or rewards, but not the least
# possible error of a controller.
_NO_MATTER: Final = *WINDOWS, "reward", "error_scale", "move_weight"
_RESAMPLES: Final = 2000  # how often episodes are resampled for the bootstrap interval


@dataclass(frozen=True, eq=False, repr=False)
class Evaluation:
    """The result of `evaluate`: errors, scores and valve travel of a policy.

    `str` of an evaluation is a summary in one line.

    Attributes
    ----------
    env : str
        The id of the environment, or the name of the class of an environment without an id.
    mean_error, travel : float
        Means of `errors`, degC, and of `travels`, t/h, over all episodes.
    errors, travels : ndarray, shape (episodes,)
        For each episode, the mean error, that is the mean of |e(k)| over the samples k = 1 to
        N, degC, with the error e of the temperature; and the valve travel, that is the sum of
        the magnitudes of all changes of the applied flow, t/h.
    seeds : range
        Seeds of the episodes.
    note : str
        Why there is no score, or why the score is 0, and what to do. The note is empty if there
        is a score other than 0.
    least_possible : float or None
        Least possible mean error of any controller, degC. `least_possible`, `multiple`,
        `score`, `interval`, `least` and `scores` are None where the package has no bound:
        `note` says why.
    multiple : float or None
        `mean_error / least_possible`.
    score : float or None
        0 for the mean error of a valve that never moves, 1 for the least possible mean error.
    interval : (float, float) or None
        95 % bootstrap interval of the score, from resampled episodes.
    least, scores : ndarray or None, shape (episodes,)
        Least possible mean error of each episode, degC, and score of each episode. Where only
        noise and load are random, `least` is the expected value over noise and load.
    """

    env: str
    mean_error: float
    travel: float
    errors: Values
    travels: Values
    seeds: range
    note: str = ""
    least_possible: float | None = None
    multiple: float | None = None
    score: float | None = None
    interval: tuple[float, float] | None = None
    least: Values | None = None
    scores: Values | None = None

    def __repr__(self) -> str:
        parts = [f"{self.env}: mean error {self.mean_error:.3f} degC"]
        if self.interval is not None:
            low, high = self.interval
            interval = f" (95 % {low:.3f} to {high:.3f})" if low < high else ""
            parts[0] += f", {self.multiple:.2f} times the least possible"
            parts.append(f"score {self.score:.3f}{interval}")
        parts.append(f"valve travel {self.travel:.0f} t/h")
        alike = ", all alike" if np.ptp(self.errors) == 0.0 else ""
        parts.append(f"{len(self.errors)} episodes{alike}")
        if self.note:
            parts.append(self.note)
        return "; ".join(parts)


def evaluate(
    policy: Any,
    env: Any = IDS["paper"],
    *,
    episodes: int = EPISODES,
    seed: int = SEED,
    **arguments: Any,
) -> Evaluation:
    """Run a policy on fixed episodes and return errors, score and valve travel.

    As with `evaluate_policy` of Stable-Baselines3, the policy acts in exactly the environments
    that are passed as `env`: the windows of the observation, the wrappers, and the statistics
    of wrappers that normalise must be those of the policy's training. The policy acts in a copy
    of the environments, which themselves do not change. A training may therefore score its
    model in the environments of the training.

    Parameters
    ----------
    policy
        A policy has one of four forms:

        - an object with `predict`, such as a model of Stable-Baselines3; `predict` receives
          `state`, `episode_start` and `deterministic=True`, as far as `predict` has these
          arguments;
        - an object with `act`, such as a controller in `agents`; `act` takes observations,
          shape (n, size), and returns actions, shape (n, 1), in NumPy arrays;
        - a `torch.nn.Module`, or a method of a module; the module receives the observations in
          a tensor of the type of the module's weights; meanwhile, the module is in evaluation
          mode, and computes no gradients;
        - any other function of observations, shape (n, size), that returns actions, shape
          (n, 1), in NumPy arrays.

        A bound method `predict` or `act` stands for the object of the method, and a
        `functools.partial` for the function within the partial. If the policy has a method
        `reset`, this method is called before each round of episodes. What a policy learns in an
        evaluation stays with the policy.
    env
        An id, such as one of `IDS`, or an `EnvSpec`; a function that makes one environment in
        each call; or environments: a single environment, a vector environment of Gymnasium, or
        a `VecEnv` of Stable-Baselines3, such as `model.get_env()`. If there are fewer
        environments than `episodes`, the environments run several rounds.

        Environments that cannot be copied, such as those in other processes or with a window,
        are used themselves, and begin a new episode after the evaluation. A ValueError is
        raised if the policy is a model that trains in environments that cannot be copied.
        Original and copy share files that are opened by name, global random number generators,
        and variables to which functions refer.
    episodes
        Number of episodes, at least 2. An episode has 1,200 samples, or fewer if the
        environment ends the episode earlier.
    seed
        Seed of the first episode; the next episode has the next seed. The default is the seed
        of all published scores. To choose among policies, import `VALIDATION_SEED` from
        `mptc_gym.evaluation`: no published score uses the 200 episodes from this seed on.
    **arguments
        Further arguments for an id or a spec, as in `gymnasium.make`.

    Returns
    -------
    Evaluation
        Mean error, score and valve travel of the policy, over all episodes in numbers, and of
        each episode in arrays of shape (episodes,).

    Raises
    ------
    ValueError
        If the environment does not exist, is not of this package, or runs other episodes than
        those that belong to the seeds; or if the policy or the policy's actions do not fit the
        environment. If a model of Stable-Baselines3 still has the environments of its training,
        `env` must have the windows of these environments, and wrappers of the same names.

    Examples
    --------
    >>> import mptc_gym, numpy as np
    >>> print(mptc_gym.evaluate(lambda observations: np.ones((len(observations), 1))))
    MiddlePoint-v0: mean error 6.613 degC, 7.26 times the least possible; score -0.394; \
valve travel 10 t/h; 100 episodes, all alike

    A model of Stable-Baselines3 acts in its own environments, or in other environments with the
    same windows and wrappers:

    >>> from mptc_gym.sb3 import make_vec_env, spec_of
    >>> from stable_baselines3 import PPO
    >>> plants = make_vec_env("MiddlePointNoisy-v0", 10, action_window=20)
    >>> model = PPO("MlpPolicy", plants).learn(20_000)
    >>> mptc_gym.evaluate(model, model.get_env())
    >>> mptc_gym.evaluate(model, spec_of(model, "MiddlePointHard-v0"))
    """
    episodes = count("episodes", episodes, 2, MOST_PLANTS)
    first = count("seed", seed, 0, 2**63)
    seeds = range(first, first + episodes)
    with opened(env, episodes, policy, **arguments) as plants:
        check_fit(policy, plants)
        groups = plant_groups(plants)
        parameters = groups[0].parameters
        case = case_of(parameters)
        if any(case_of(group.parameters) != case for group in groups):
            raise ValueError("env must have the same plants, but for windows and rewards")
        runs = _run(policy, plants, seeds, parameters)
    bound = find_bound(case, runs.samples, seeds)
    judged = {} if bound.least is None else _judge(runs.errors, bound.least, case, seeds)
    notes = [bound.why_not, _why_idle(runs, parameters)]
    return Evaluation(
        env=groups[0].name,
        mean_error=float(runs.errors.mean()),
        travel=float(runs.travels.mean()),
        errors=runs.errors,
        travels=runs.travels,
        seeds=seeds,
        note="; ".join(filter(None, notes)),
        **judged,
    )


class _Runs(NamedTuple):
    """Errors and valve travels of a policy's episodes, from which the score is computed."""

    errors: Values  # mean of |e(k)| of each episode, degC, with e the error of the temperature
    travels: Values  # sum of the changes of the applied flow in each episode, t/h
    samples: int  # number of samples N of each episode


def _run(policy: Any, plants: Plants, seeds: range, parameters: Parameters) -> _Runs:
    """Run an episode of a policy for each seed, in rounds of as many episodes as plants.

    Parameters
    ----------
    policy
        A policy, as in `evaluate`.
    plants
        A vector environment in which the policy acts.
    seeds
        The seeds of the episodes.
    parameters
        The arguments of the plants.

    Raises
    ------
    ValueError
        If episodes have different lengths, or if the episodes are not those of the seeds.
    """
    n = plants.num_envs
    rounds: list[_Runs] = []
    for first in seeds[::n]:
        seeds_of_round = [*range(first, first + n)]
        samples = rollout(plants, start(policy, n), SAMPLES, seeds_of_round)
        if type(plants) is not MiddlePointVectorEnv:  # wrappers may change the episodes
            samples = replayed(samples, parameters, seeds_of_round)
        rounds.append(_measure(samples, n))
        if rounds[-1].samples != rounds[0].samples:
            _refuse_lengths(rounds[-1].samples)
    # The last round may have more episodes than are asked for.
    errors = np.hstack([runs.errors for runs in rounds])[: len(seeds)]
    travels = np.hstack([runs.travels for runs in rounds])[: len(seeds)]
    return _Runs(errors, travels, rounds[0].samples)


def _measure(samples: Iterator[Sample], n: int) -> _Runs:
    """Return errors and valve travels of n episodes, whose samples are `samples`.

    A ValueError is raised if not all episodes end at the same sample.
    """
    next(samples)  # sample k = 0, which no policy has affected
    total_errors = np.zeros(n)
    travels = np.zeros(n)
    applied = np.zeros(n)  # applied flow, t/h, which is 0 at rest
    length = 0
    for sample in samples:
        length += 1
        total_errors += np.abs(sample.infos["error"])
        travels += np.abs(sample.infos["applied"] - applied)
        applied = sample.infos["applied"]
        if sample.ended.any():
            if not sample.ended.all():
                _refuse_lengths(length)
            break
    return _Runs(total_errors / length, travels, length)


def _refuse_lengths(samples: int) -> NoReturn:
    """Raise a ValueError: episodes differ in length, and one has `samples` samples."""
    raise ValueError(f"env must end all episodes at once, got an end after {samples} samples")


def _why_idle(runs: _Runs, parameters: Parameters) -> str:
    """Return why the valve has never moved, and what helps; "" if the valve has moved.

    `runs` are the results of the episodes, and `parameters` the arguments of the plants.
    """
    if runs.travels.any():
        return ""
    low, high = parameters.range_of("dead_zone")
    if high == 0.0:
        return "the valve never moved"
    zone = f"{low:g}" if low == high else f"{low:g} to {high:g}"
    return (
        f"no action left the dead zone of {zone} t/h: train in mptc_gym.wrappers."
        "IncrementalAction with compensate_dead_zone=True, or choose larger actions"
    )


class Bound(NamedTuple):
    """The least possible mean error of each episode, or why the package has no bound."""

    least: Values | None  # least possible mean error of each episode, degC, shape (episodes,)
    why_not: str = ""  # why `least` is None


def find_bound(parameters: Parameters, samples: int, seeds: range) -> Bound:
    """Return the least possible mean error of each episode, or why the package has none.

    Parameters
    ----------
    parameters
        The arguments of the plants.
    samples
        Number of samples N of an episode.
    seeds
        The seeds of the episodes.
    """
    least_by_seed = _read_bounds().get(case_of(parameters))
    if least_by_seed is None:
        return Bound(
            None,
            "bounds are kept for the presets alone, without other arguments of the plant; in a "
            "checkout, python -m benchmarks.bounds --help says how to compute others",
        )
    if samples != SAMPLES:
        return Bound(
            None,
            f"bounds are kept for episodes of {SAMPLES:,} samples, not of {samples:,}: leave "
            "max_episode_steps as it is",
        )
    if len(least_by_seed[SEED]) == 1:  # one bound for all seeds: only noise and load are random
        return Bound(np.repeat(least_by_seed[SEED], len(seeds)))
    ranges = []
    for first, least in least_by_seed.items():
        if first <= seeds.start and seeds.stop <= first + len(least):
            return Bound(least[seeds.start - first : seeds.stop - first])
        ranges.append(f"{first:,} to {first + len(least) - 1:,}")
    return Bound(
        None,
        f"bounds of these plants are kept for seeds {' and '.join(ranges)}, not for "
        f"{seeds.start:,} to {seeds.stop - 1:,}: choose seed and episodes among them",
    )


@cache
def _read_bounds() -> dict[Parameters, dict[int, Values]]:
    """Return the bounds that `python -m benchmarks.bounds --package` wrote to `bounds.json`.

    Returns
    -------
    dict of dict of ndarray
        Least possible mean errors, degC. The outer key is the case: the arguments of the
        plants, as `case_of` returns the arguments. The inner key is the seed of the first
        episode: element i of the array belongs to this seed + i; an array of one element
        belongs to all seeds.
    """
    text = resources.files("mptc_gym").joinpath("bounds.json").read_text(encoding="utf-8")
    bounds = {}
    for record in json.loads(text)["cases"].values():
        least_by_seed = {SEED: np.array(record["least"])}
        if "validation_least" in record:
            least_by_seed[VALIDATION_SEED] = np.array(record["validation_least"])
        bounds[case_of(Parameters(**record["arguments"]))] = least_by_seed
    return bounds


def case_of(parameters: Parameters) -> Parameters:
    """Return arguments of plants, with defaults for those that do not affect the bound.

    Plants of the same case have the same least possible errors.
    """
    return replace(parameters, **{name: ARGUMENTS[name].default for name in _NO_MATTER})


def _judge(
    errors: Values, least: Values, parameters: Parameters, seeds: range
) -> dict[str, Any]:
    """Return the fields of an `Evaluation` that compare errors with least possible errors.

    Parameters
    ----------
    errors, least
        Mean error and least possible mean error of each episode, degC, shape (episodes,).
    parameters
        The arguments of the plants.
    seeds
        The seeds of the episodes.
    """
    n = len(seeds)
    idle_plants = MiddlePointVectorEnv(n, **asdict(parameters))
    idle_action = action_from_command(0.0, parameters.u_min, parameters.u_max)
    idle_actions = np.full((n, 1), idle_action)
    idle_samples = rollout(idle_plants, lambda _: idle_actions, SAMPLES, [*seeds])
    idle_errors = _measure(idle_samples, n).errors
    gained = idle_errors - errors
    possible = idle_errors - least
    generator = np.random.default_rng(0)
    quotients = []
    for _ in range(_RESAMPLES):
        resample = generator.integers(n, size=n)
        quotients.append(gained[resample].mean() / possible[resample].mean())
    low, high = np.quantile(quotients, (0.025, 0.975)).tolist()
    return {
        "least_possible": float(least.mean()),
        "multiple": float(errors.mean() / least.mean()),
        "score": float(gained.mean() / possible.mean()),
        "interval": (low, high),
        "least": least,
        "scores": gained / possible,
    }
