"""Score any policy on fixed episodes, in the environments that it is to act in."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from functools import cache
from importlib import resources
from typing import Any, Final, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from mptc_gym.acting import Replay, opened, rollout
from mptc_gym.adapters import Plants, VectorPlants
from mptc_gym.checks import MOST_PLANTS, count
from mptc_gym.fit import check_fit
from mptc_gym.parameters import ARGUMENTS, Parameters
from mptc_gym.plant import action_from_command
from mptc_gym.policies import Act, check_policy, start
from mptc_gym.presets import IDS
from mptc_gym.vector_env import MiddlePointVectorEnv

Values = NDArray[np.float64]  # one per episode, shape (episodes,)

SEED: Final = 7_000_000  # of the first published episode, as the next one has the next seed
EPISODES: Final = 100
VALIDATION_SEED: Final = 5_000_000  # of the first episode to choose by, never published
VALIDATION_EPISODES: Final = 200
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
    note : str
        Why there is no score, or why it is 0, and what to do; empty if neither is so.
    least_possible : float or None
        Least possible mean error, degC. This and all that follows are None where the package
        has no bound: `note` says why.
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
    """Run a policy on fixed episodes and score it.

    As with `evaluate_policy` of Stable-Baselines3, the policy acts in exactly the environments
    that are handed over: their windows, wrappers and statistics must be those of its training.
    Nothing of them changes, as the policy acts in a copy. So a training may score its model in
    its own environments.

    Parameters
    ----------
    policy
        One of four forms:

        - an object with `predict`, as a model of Stable-Baselines3; it gets `state`,
          `episode_start` and `deterministic=True`, except those that it does not take;
        - an object with `act`, as those in `agents`, which takes and returns NumPy arrays;
        - a `torch.nn.Module`, or a method of one: it gets a tensor, of float32 unless its
          weights are of another type, is in evaluation mode, and computes no gradients;
        - any other function of observations, shape (n, size), that returns actions, shape
          (n, 1), in NumPy arrays.

        A bound `predict` or `act` stands for its object, and a `functools.partial` for its
        function. If the object has a method `reset`, it is called before each round of
        episodes. What a policy learns in an evaluation stays with it.
    env
        An id, such as one of `IDS`, or an `EnvSpec`; a function that makes one environment in
        each call; or environments: one, a vector environment of Gymnasium, or a `VecEnv` of
        Stable-Baselines3, such as `model.get_env()`. The latter run several rounds if they are
        fewer than `episodes`.

        Environments in other processes, in a window, or with anything else that cannot be
        copied act themselves, and begin a new episode afterwards; where a model trains in
        them, this is an error. A copy shares what closures, global random streams and files
        opened by name refer to.
    episodes, seed
        Number of episodes, at least 2, and seed of the first. The default is that of all
        published scores. To choose among policies, use `seed=VALIDATION_SEED`, of
        `mptc_gym.evaluation`, with at most 200 episodes: they are never published. An episode
        has 1,200 samples, or fewer if its environment ends it earlier.
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
        than those of its seeds; or if the policy or its actions do not fit it. A model of
        Stable-Baselines3 that still has its environments is compared with them: windows, and
        wrappers by name.

    Examples
    --------
    >>> import mptc_gym, numpy as np
    >>> print(mptc_gym.evaluate(lambda observations: np.ones((len(observations), 1))))
    MiddlePoint-v0: mean error 6.613 degC, 7.26 times the least possible; score -0.394; \
valve travel 10 t/h; 100 episodes, all alike

    A model of Stable-Baselines3 acts in its own environments, or in others like them:

    >>> from mptc_gym.sb3 import make_vec_env, spec_of
    >>> from stable_baselines3 import PPO
    >>> plants = make_vec_env("MiddlePointNoisy-v0", 10, action_window=20)
    >>> model = PPO("MlpPolicy", plants).learn(20_000)
    >>> mptc_gym.evaluate(model, model.get_env())
    >>> mptc_gym.evaluate(model, spec_of(model, "MiddlePointHard-v0"))
    """
    check_policy(policy)
    episodes = count("episodes", episodes, 2, MOST_PLANTS)
    first = count("seed", seed, 0, 2**63)
    seeds = range(first, first + episodes)
    with opened(env, episodes, policy, **arguments) as plants:
        name = plants.groups[0].name
        parameters = plants.groups[0].parameters
        case = case_of(parameters)
        if any(case_of(group.parameters) != case for group in plants.groups):
            raise ValueError("env must have the same plants, but for windows and rewards")
        check_fit(policy, plants)
        reference = None if plants.are_trusted else parameters
        runs = _run(policy, plants, seeds, reference)
    bound = find_bound(case, runs.samples, seeds)
    judged = {} if bound.least is None else _judge(runs.errors, bound.least, case, seeds)
    return Evaluation(
        env=name,
        mean_error=float(runs.errors.mean()),
        travel=float(runs.travels.mean()),
        errors=runs.errors,
        travels=runs.travels,
        seeds=seeds,
        note="; ".join(filter(None, [bound.why_not, _why_idle(runs, parameters)])),
        **judged,
    )


class _Runs(NamedTuple):
    """What the episodes of a policy are scored by."""

    errors: Values  # mean of |e(k)|, degC
    travels: Values  # of the valve, t/h
    samples: int  # N, of each episode


def _run(
    policy: Any, plants: Plants, seeds: range, reference: Parameters | None = None
) -> _Runs:
    """Run an episode per seed, in as many rounds as it takes.

    With `reference`, episodes that differ from those of plants with these arguments are a
    ValueError, as are episodes of different lengths.
    """
    rounds: list[_Runs] = []
    n = plants.num_envs
    for first in seeds[::n]:
        act = start(policy, n)
        rounds.append(_run_round(act, plants, [*range(first, first + n)], reference))
        if rounds[-1].samples != rounds[0].samples:
            _refuse_lengths(rounds[-1].samples)
    return _Runs(
        np.hstack([part.errors for part in rounds])[: len(seeds)],
        np.hstack([part.travels for part in rounds])[: len(seeds)],
        rounds[0].samples,
    )


def _run_round(
    act: Act, plants: Plants, seeds: list[int], reference: Parameters | None
) -> _Runs:
    """Run one episode of each plant, of `SAMPLES` samples or until it ends: see `_run`."""
    replay = None if reference is None else Replay(reference, seeds)
    total_errors = np.zeros(plants.num_envs)
    travels = np.zeros(plants.num_envs)
    applied = np.zeros(plants.num_envs)  # at rest
    samples = 0
    steps = rollout(plants, act, SAMPLES, seeds)
    initial = next(steps)
    if replay is not None:
        replay.check_reset(initial.infos)
    for sample in steps:
        samples += 1
        if replay is not None:
            replay.check_step(sample.infos)
        total_errors += np.abs(sample.infos["error"])
        travels += np.abs(sample.infos["applied"] - applied)
        applied = sample.infos["applied"]
        if sample.ended.any():
            if not sample.ended.all():
                _refuse_lengths(samples)
            break
    return _Runs(total_errors / samples, travels, samples)


def _why_idle(runs: _Runs, parameters: Parameters) -> str:
    """Return why the valve has never moved, and what helps; "" if it has."""
    low, high = parameters.range_of("dead_zone")
    if runs.travels.any():
        return ""
    if high == 0.0:
        return "the valve never moved"
    zone = f"{low:g}" if low == high else f"{low:g} to {high:g}"
    return (
        f"no action left the dead zone of {zone} t/h: train in mptc_gym.wrappers."
        "IncrementalAction with compensate_dead_zone=True, or choose larger actions"
    )


def _refuse_lengths(samples: int) -> NoReturn:
    raise ValueError(f"env must end all episodes at once, got an end after {samples} samples")


class Bound(NamedTuple):
    """The least possible mean error of each episode, degC, or the reason why it is missing."""

    least: Values | None
    why_not: str = ""


def find_bound(parameters: Parameters, samples: int, seeds: range) -> Bound:
    """Return the least possible mean error of each episode, as far as the package has it."""
    case = _read_bounds().get(case_of(parameters))
    if case is None:
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
    if case.is_the_same_for_all_seeds:
        return Bound(np.repeat(case.least[SEED], len(seeds)))
    for first, least in case.least.items():
        if first <= seeds.start and seeds.stop <= first + len(least):
            return Bound(least[seeds.start - first : seeds.stop - first])
    ranges = [f"{first:,} to {first + len(least) - 1:,}" for first, least in case.least.items()]
    return Bound(
        None,
        f"bounds of these plants are kept for seeds {' and '.join(ranges)}, not for "
        f"{seeds.start:,} to {seeds.stop - 1:,}: choose seed and episodes among them",
    )


class _Case(NamedTuple):
    """The bounds of a case of `bounds.json`."""

    least: dict[int, Values]  # by the seed of the first episode

    @property
    def is_the_same_for_all_seeds(self) -> bool:
        """Whether only noise and load are random, if anything."""
        return len(self.least[SEED]) == 1


@cache
def _read_bounds() -> dict[Parameters, _Case]:
    """Return the bounds written by `python -m benchmarks.bounds --package`, by case."""
    text = resources.files("mptc_gym").joinpath("bounds.json").read_text(encoding="utf-8")
    cases = {}
    for record in json.loads(text)["cases"].values():
        least = {SEED: np.array(record["least"])}
        if "validation_least" in record:
            least[VALIDATION_SEED] = np.array(record["validation_least"])
        cases[case_of(Parameters(**record["arguments"]))] = _Case(least)
    return cases


def case_of(parameters: Parameters) -> Parameters:
    """Return the arguments, with those that do not affect the bound at their defaults."""
    return replace(parameters, **{name: ARGUMENTS[name].default for name in _NO_MATTER})


def _judge(
    errors: Values, least: Values, parameters: Parameters, seeds: range
) -> dict[str, Any]:
    """Return what an `Evaluation` says of errors beside the least possible ones."""
    n = len(seeds)
    idle_action = action_from_command(0.0, parameters.u_min, parameters.u_max)
    idle_plants = VectorPlants(MiddlePointVectorEnv(n, **asdict(parameters)))
    idle_errors = _run(lambda _: np.full((n, 1), idle_action), idle_plants, seeds).errors
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
