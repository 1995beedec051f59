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
from mptc_gym.scoring.fit import check_fit
from mptc_gym.scoring.opening import Plants, opened
from mptc_gym.scoring.policies import start
from mptc_gym.scoring.rollout import Sample, replayed, rollout
from mptc_gym.vector_env import MiddlePointVectorEnv

Values = NDArray[np.float64]  # one number for each episode, shape (episodes,)

# Seed of the first episode of a published score; the next episode has the next seed. The value
# is arbitrary, but never changes, so that scores stay comparable.
SEED: Final = 7_000_000
EPISODES: Final = 100  # episodes of a published score
# Seed of the first episode for choosing among policies. No published score uses the episodes
# from this seed on.
VALIDATION_SEED: Final = 5_000_000
VALIDATION_EPISODES: Final = 200  # episodes from `VALIDATION_SEED` on that have bounds
SAMPLES: Final = 1200  # samples of an episode, unless the environment ends the episode earlier
WINDOWS: Final = "setpoint_window", "error_window", "output_window", "action_window"
# The arguments of an environment that change observations or rewards, but not the least
# possible error of a controller.
_WITHOUT_EFFECT_ON_BOUNDS: Final = *WINDOWS, "reward", "error_scale", "move_weight"
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
        Mean of `errors`, degC, and mean of `travels`, t/h.
    errors : ndarray, shape (episodes,)
        Mean error of each episode, degC: the mean of |e(k)| over the samples k = 1 to N, where
        e is the error of the temperature.
    travels : ndarray, shape (episodes,)
        Valve travel of each episode, t/h: the sum of the magnitudes of all changes of the
        applied flow.
    seeds : range
        Seeds of the episodes.
    note : str
        Why there is no score, or why the valve never moved, and what to do; otherwise "".
    least_possible : float or None
        Least possible mean error of any controller, degC. This attribute and all that follow
        are None if the package has no bound for the episodes; `note` says why.
    multiple : float or None
        `mean_error / least_possible`.
    score : float or None
        0 for the mean error of a valve that never moves, 1 for the least possible mean error.
    interval : (float, float) or None
        95 % bootstrap interval of the score, from resampled episodes.
    least, scores : ndarray or None, shape (episodes,)
        Least possible mean error of each episode, degC, and score of each episode. If only
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
        mean_error = f"{self.env}: mean error {self.mean_error:.3f} degC"
        score = ""
        if self.interval is not None:
            mean_error += f", {self.multiple:.2f} times the least possible"
            score = f"score {self.score:.3f}"
            low, high = self.interval
            if low < high:
                score += f" (95 % {low:.3f} to {high:.3f})"
        travel = f"valve travel {self.travel:.0f} t/h"
        episodes = f"{len(self.errors)} episodes"
        if np.ptp(self.errors) == 0.0:
            episodes += ", all alike"
        parts = [mean_error, score, travel, episodes, self.note]
        return "; ".join(part for part in parts if part)


def evaluate(
    policy: Any,
    env: Any = "MiddlePoint-v0",
    *,
    episodes: int = EPISODES,
    seed: int = SEED,
    **arguments: Any,
) -> Evaluation:
    """Run a policy on fixed episodes and return errors, score and valve travel.

    The policy acts in a copy of exactly the environments that are passed as `env`. Windows of
    the observation, wrappers, and the statistics of wrappers that normalise must be those of
    the policy's training. The environments themselves do not change, so a training may score
    its model in the environments of the training.

    Parameters
    ----------
    policy
        A policy has one of four forms:

        - an object with `predict`, such as a model of Stable-Baselines3; the keywords `state`,
          `episode_start` and `deterministic=True` are passed to `predict` if `predict` takes
          them;
        - an object with `act`, such as a controller in `agents`; `act` takes observations,
          shape (n, size), and returns actions, shape (n, 1), in NumPy arrays;
        - a `torch.nn.Module`, or a method of a module; the module receives the observations in
          a tensor of the type of its weights, is in evaluation mode, and computes no gradients;
        - any other function of observations, shape (n, size), that returns actions, shape
          (n, 1), in NumPy arrays.

        A bound method `predict` or `act` stands for the object of the method. If the policy has
        a method `reset`, this method is called before each round of episodes. What a policy
        learns in an evaluation stays with the policy.
    env
        An id, such as one of `IDS`, or an `EnvSpec`; a function that makes one environment in
        each call; or environments: a single environment, a vector environment of Gymnasium, or
        a `VecEnv` of Stable-Baselines3, such as `model.get_env()`. If there are fewer
        environments than `episodes`, the environments run several rounds of episodes.

        Environments that cannot be copied, such as those in other processes or with a window,
        are used themselves, and begin a new episode after the evaluation. A copy shares with
        its original the global random number generators, files that are opened by name, and
        the variables outside a function that the function uses.
    episodes
        Number of episodes, at least 2. An episode has 1,200 samples, or fewer if the
        environment ends the episode earlier.
    seed
        Seed of the first episode; the next episode has the next seed. The default is the seed
        of all published scores. To choose among policies, use `VALIDATION_SEED` of
        `mptc_gym.evaluation`: no published score uses the 200 episodes from this seed on.
    **arguments
        Further arguments for an id or a spec, as in `gymnasium.make`.

    Returns
    -------
    Evaluation
        Mean error, score and valve travel of the policy, over all episodes and of each episode.

    Raises
    ------
    ValueError
        If `env` does not exist, is not of this package, or runs other episodes than those of
        the seeds; if the policy or the policy's actions do not fit `env`; if the policy is a
        model of Stable-Baselines3 that still has the environments of its training, and `env`
        has other windows or wrappers; or if the policy trains in environments that cannot be
        copied.

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
    bound = find_bound(case, runs.length, seeds)
    notes = [bound.why_not, _why_idle(runs.travels, parameters)]
    evaluation = Evaluation(
        env=groups[0].name,
        mean_error=float(runs.errors.mean()),
        travel=float(runs.travels.mean()),
        errors=runs.errors,
        travels=runs.travels,
        seeds=seeds,
        note="; ".join(note for note in notes if note),
    )
    if bound.least is None:
        return evaluation
    return _with_scores(evaluation, bound.least, _idle_errors(case, seeds))


class _Runs(NamedTuple):
    """Errors and valve travels of episodes that have the same length."""

    errors: Values  # mean of |e(k)| of each episode, degC, with e the error of the temperature
    travels: Values  # sum of the changes of the applied flow in each episode, t/h
    length: int  # number of samples N of each episode


def _run(policy: Any, plants: Plants, seeds: range, parameters: Parameters) -> _Runs:
    """Run an episode of a policy for each seed, in rounds of as many episodes as plants.

    A ValueError is raised if episodes have different lengths, or if their noise, load or set
    points are not those of the seeds.
    """
    n = plants.num_envs
    rounds: list[_Runs] = []
    for first in seeds[::n]:
        seeds_of_round = [*range(first, first + n)]
        samples = rollout(plants, start(policy, n), SAMPLES, seeds_of_round)
        if type(plants) is not MiddlePointVectorEnv:  # wrappers may change the episodes
            samples = replayed(samples, parameters, seeds_of_round)
        rounds.append(_measure(samples, n))
        if rounds[-1].length != rounds[0].length:
            _refuse_lengths(rounds[-1].length)
    # The last round may have more episodes than are asked for.
    errors = np.hstack([runs.errors for runs in rounds])[: len(seeds)]
    travels = np.hstack([runs.travels for runs in rounds])[: len(seeds)]
    return _Runs(errors, travels, rounds[0].length)


def _measure(samples: Iterator[Sample], n: int) -> _Runs:
    """Return errors and valve travels of n plants from the samples of one episode.

    A ValueError is raised if not all plants end the episode at the same sample.
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


def _refuse_lengths(length: int) -> NoReturn:
    """Raise a ValueError: episodes differ in length, and one of them has `length` samples."""
    raise ValueError(f"env must end all episodes at once, got an end after {length} samples")


def _why_idle(travels: Values, parameters: Parameters) -> str:
    """Return why the valve has never moved, and what helps; "" if the valve has moved.

    `travels` are the valve travels of the episodes, t/h.
    """
    if travels.any():
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


def find_bound(parameters: Parameters, length: int, seeds: range) -> Bound:
    """Return the least possible mean error of each episode, or why the package has none.

    `length` is the number of samples of an episode, and each episode has one of the seeds.
    """
    least_by_seed = _read_bounds().get(case_of(parameters))
    if least_by_seed is None:
        return Bound(
            None,
            "bounds are kept for the presets alone, without other arguments of the plant; in a "
            "checkout, python -m benchmarks.bounds --help says how to compute others",
        )
    if length != SAMPLES:
        return Bound(
            None,
            f"bounds are kept for episodes of {SAMPLES:,} samples, not of {length:,}: leave "
            "max_episode_steps as it is",
        )
    if len(least_by_seed[SEED]) == 1:  # one bound for all seeds: only noise and load are random
        return Bound(np.repeat(least_by_seed[SEED], len(seeds)))
    seeds_with_bounds = []
    for first, least in least_by_seed.items():
        if first <= seeds.start and seeds.stop <= first + len(least):
            return Bound(least[seeds.start - first : seeds.stop - first])
        seeds_with_bounds.append(f"{first:,} to {first + len(least) - 1:,}")
    return Bound(
        None,
        f"bounds of these plants are kept for seeds {' and '.join(seeds_with_bounds)}, not for "
        f"{seeds.start:,} to {seeds.stop - 1:,}: choose seed and episodes among them",
    )


@cache
def _read_bounds() -> dict[Parameters, dict[int, Values]]:
    """Return all bounds of the package, which `python -m benchmarks.bounds --package` wrote.

    Returns
    -------
    dict of dict of ndarray
        Least possible mean errors, degC. The outer key is the case of the plants, as `case_of`
        returns it. The inner key is the seed of the first episode: element i of the array
        belongs to this seed + i. An array of one element belongs to all seeds.
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
    """Return arguments of plants, with defaults in place of those that change no bound.

    Plants of the same case have the same least possible errors.
    """
    defaults = {name: ARGUMENTS[name].default for name in _WITHOUT_EFFECT_ON_BOUNDS}
    return replace(parameters, **defaults)


def _idle_errors(parameters: Parameters, seeds: range) -> Values:
    """Return the mean error of the episode of each seed if the valve never moves, degC."""
    n = len(seeds)
    plants = MiddlePointVectorEnv(n, **asdict(parameters))
    idle_action = action_from_command(0.0, parameters.u_min, parameters.u_max)
    idle_actions = np.full((n, 1), idle_action)
    samples = rollout(plants, lambda _: idle_actions, SAMPLES, [*seeds])
    return _measure(samples, n).errors


def _with_scores(evaluation: Evaluation, least: Values, idle_errors: Values) -> Evaluation:
    """Return an evaluation with the fields that need a bound, such as the score.

    For each episode, `least` is the least possible mean error, and `idle_errors` is the mean
    error if the valve never moves, both in degC.
    """
    gained = idle_errors - evaluation.errors
    possible = idle_errors - least
    n = len(gained)
    generator = np.random.default_rng(0)
    resampled_scores = []
    for _ in range(_RESAMPLES):
        resample = generator.integers(n, size=n)  # numbers of episodes, drawn with replacement
        resampled_scores.append(gained[resample].mean() / possible[resample].mean())
    low, high = np.quantile(resampled_scores, (0.025, 0.975)).tolist()
    return replace(
        evaluation,
        least_possible=float(least.mean()),
        multiple=float(evaluation.errors.mean() / least.mean()),
        score=float(gained.mean() / possible.mean()),
        interval=(low, high),
        least=least,
        scores=gained / possible,
    )
