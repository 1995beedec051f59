"""Score a policy on episodes with fixed seeds, relative to a reference error."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import cache
from importlib import resources
from typing import Any, Final, NamedTuple

import numpy as np

from mptc_gym.plant.actuator import action_from_command
from mptc_gym.plant.checks import count
from mptc_gym.plant.parameters import ARGUMENTS, EPISODE_STEPS, INTERFACE, Parameters
from mptc_gym.presets import IDS, PRESETS
from mptc_gym.rollout import (
    Plants,
    Sample,
    layers,
    opened,
    replayed,
    rollout,
    start,
)
from mptc_gym.scores import (
    Values,
    mean_absolute_error,
    score,
    score_interval,
    scores,
    valve_travel,
)
from mptc_gym.vector_env import MiddlePointVectorEnv, parameters_of

# Seed of the first episode, unless the caller asks for another seed; episode i has `SEED + i`.
# The seed is arbitrary, but never changes, so that published scores remain comparable.
SEED: Final = 7_000_000
EPISODES: Final = 100  # episodes of a score, unless the caller asks for another number
# Seed of the first validation episode. Validation episodes serve to choose among policies, so a
# policy that is chosen on validation episodes is not chosen on the default episodes of a score.
VALIDATION_SEED: Final = 5_000_000
VALIDATION_EPISODES: Final = 200  # validation episodes with a known reference error
# Arguments of an environment that change observations or rewards, but not the error of an ideal
# controller.
_WITHOUT_EFFECT_ON_REFERENCE: Final = *INTERFACE, "reward", "error_scale", "move_weight"
_VALVE_IDLE: Final = (  # a note on episodes
    "the valve never moved: score the policy in the action form of its training, or choose "
    'actions that leave the dead zone, as with action="change" and a compensated_dead_zone'
)


@dataclass(frozen=True, eq=False, repr=False)
class Evaluation:
    """Result of `evaluate`: the errors, the scores and the valve travel of a policy.

    `str(evaluation)` returns a summary in one line.

    Attributes
    ----------
    env : str
        Id of the preset that is most similar to the plant, with the names of arguments of the
        plant that differ from those of the preset.
    mean_error, travel : float
        Mean absolute error, degC, and valve travel, t/h, each averaged over the episodes.
    errors : ndarray, shape (episodes,)
        Mean absolute error of each episode, degC: the mean of |e(k)| over all samples k of the
        episode after k = 0, where e(k) is the set point minus the temperature.
    travels : ndarray, shape (episodes,)
        Valve travel of each episode, t/h: the sum of the absolute changes of the flow that the
        valve applies.
    seeds : range
        Seeds of the episodes.
    note : str
        Reasons why the score is missing and why the valve never moved; otherwise "".
    reference : float or None
        Reference error, degC, averaged over the episodes: the mean error of an ideal controller
        that knows the plant and the present load, but not the future. If the package does not
        know the reference error, the attributes `reference`, `ratio`, `score`, `interval`,
        `references` and `scores` are None, and the attribute `note` says why.
    ratio : float or None
        The mean error of the policy divided by the reference error.
    is_bound : bool
        Whether it is proven that no controller without foresight has a smaller mean error than
        the reference error, on average. If false, set points follow a timetable, and a policy
        that has learnt the timetable can have a ratio below 1 and a score above 1; or the
        reference error is unknown.
    score : float or None
        Score of the policy: 0 for the mean error of a valve that never moves, 1 for the
        reference error.
    interval : (float, float) or None
        95 % confidence interval of the score, from a bootstrap that resamples episodes.
    references, scores : ndarray or None, shape (episodes,)
        Reference error of each episode, degC, and score of each episode. If nothing but noise
        and load is random in the environment, the reference error is an expected value, the
        same for all episodes.
    """

    env: str
    mean_error: float
    travel: float
    errors: Values
    travels: Values
    seeds: range
    note: str = ""
    reference: float | None = None
    ratio: float | None = None
    is_bound: bool = False
    score: float | None = None
    interval: tuple[float, float] | None = None
    references: Values | None = None
    scores: Values | None = None

    def __repr__(self) -> str:
        mean_error = f"{self.env}: mean error {self.mean_error:.3f} degC"
        score = ""
        # Equal episodes may differ by rounding errors.
        are_alike = bool(np.ptp(self.errors) < 1e-6)
        if self.interval is not None:
            mean_error += f", {self.ratio:.2f} times the reference"
            score = f"score {self.score:.3f}"
            low, high = self.interval
            if not are_alike:
                score += f" (95 % {low:.3f} to {high:.3f})"
        travel = f"valve travel {self.travel:.0f} t/h"
        episodes = f"{len(self.errors)} episodes"
        if are_alike:
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
    """Run a policy on episodes with fixed seeds, and return errors, score and valve travel.

    The policy acts in new environments, which `evaluate` makes, uses and closes.

    Parameters
    ----------
    policy
        Policy to score, in one of three forms:

        - An object with a method `predict`, such as a model of Stable-Baselines3. `predict`
          receives those of the keywords `state`, `episode_start` and `deterministic=True` that
          `predict` takes.

        - An object with a method `act`, such as a controller in `agents`. `act` takes
          observations, shape (n, size), and returns actions, shape (n, 1), in NumPy arrays.

        - A function that takes observations, shape (n, size), and returns actions, shape
          (n, 1), in NumPy arrays. For a PyTorch module, write the function
          `lambda o: module(torch.as_tensor(o)).detach().numpy()`.

        If the policy has a method `reset`, `evaluate` calls `reset` whenever all environments
        begin a new episode.
    env
        Environment in one of two forms:

        - An id, such as "MiddlePoint-v0", or an `EnvSpec`. A Stable-Baselines3 model that has
          its training environments finds the interface of its training: see
          `mptc_gym.sb3.like`.

        - A function without arguments that makes a new environment, vector environment of
          Gymnasium or `VecEnv` of Stable-Baselines3. If the function makes fewer than
          `episodes` environments at once, each environment runs several episodes in turn.
    episodes
        Number of episodes, at least 2. An episode has 1,200 samples, or fewer if the
        environment ends the episode earlier.
    seed
        Seed of the first episode; episode i has the seed `seed + i`. Use the default seed for a
        score to publish. To choose among policies, pass `VALIDATION_SEED` of
        `mptc_gym.evaluation`: the 200 seeds from `VALIDATION_SEED` on are for this choice, and
        differ from the default seeds.
    **arguments
        Further arguments of the environment, as in `gymnasium.make`, if `env` is an id or a
        spec.

    Returns
    -------
    Evaluation
        Mean error, score and valve travel of the policy, over all episodes and of each episode.

    Raises
    ------
    ValueError
        If `env` is an existing environment, is not of this package, or does not run the
        episodes that belong to the seeds. If the policy does not fit the environment, or
        returns actions that are not finite or of the wrong shape. If normalisation statistics
        were never trained.

    Examples
    --------
    >>> import mptc_gym, numpy as np
    >>> print(mptc_gym.evaluate(lambda observations: np.ones((len(observations), 1))))
    MiddlePoint-v0: mean error 6.613 degC, 7.26 times the reference; score -0.394; \
valve travel 10 t/h; 100 episodes, all alike

    A model of Stable-Baselines3, on the plants of its training and on others:

    >>> from mptc_gym.sb3 import make_vec_env
    >>> from stable_baselines3 import PPO
    >>> plants = make_vec_env("MiddlePointNoisy-v0", 10, action_window=20)
    >>> model = PPO("MlpPolicy", plants).learn(20_000)
    >>> mptc_gym.evaluate(model, "MiddlePointNoisy-v0")
    >>> mptc_gym.evaluate(model, "MiddlePointHard-v0")
    """
    episodes = count("episodes", episodes, 2)
    first = count("seed", seed, 0, 2**63 - 1)
    seeds = range(first, first + episodes)
    with opened(policy, env, episodes, arguments) as plants:
        case = case_of(parameters_of(plants))
        # A user's code or wrapper may alter the episodes. Environments that are made from an id
        # without wrappers are one batch, which has no attribute `envs`.
        is_alterable = callable(env) or any("envs" in vars(layer) for layer in layers(plants))
        runs = _run(policy, plants, seeds, case, is_replayed=is_alterable)
    reference = find_reference(case, runs.length, seeds)
    notes = [reference.why_not, "" if runs.travels.any() else _VALVE_IDLE]
    evaluation = Evaluation(
        env=_name_of(case),
        mean_error=float(runs.errors.mean()),
        travel=float(runs.travels.mean()),
        errors=runs.errors,
        travels=runs.travels,
        seeds=seeds,
        note="; ".join(note for note in notes if note),
        is_bound=reference.is_bound,
    )
    if reference.errors is None:
        return evaluation
    return _with_scores(evaluation, reference.errors, _idle_errors(case, seeds))


class _Runs(NamedTuple):
    """Mean errors and valve travels of episodes."""

    errors: Values  # mean of |e(k)| of each episode, degC, with e the error of the temperature
    travels: Values  # sum of the changes of the applied flow in each episode, t/h
    length: int  # number of samples N of the shortest episode


def _name_of(case: Parameters) -> str:
    """Return the id of the most similar preset, with the arguments that differ from it."""
    changes_of = {}
    for preset, arguments in PRESETS.items():
        of_preset = vars(case_of(Parameters(**arguments)))
        changes = [name for name in ARGUMENTS if getattr(case, name) != of_preset[name]]
        changes_of[IDS[preset]] = changes
    # The preset from which the fewest arguments differ.
    name, changes = min(changes_of.items(), key=lambda item: len(item[1]))
    return f"{name} with another {', '.join(changes)}" if changes else name


def _run(
    policy: Any, plants: Plants, seeds: range, case: Parameters, *, is_replayed: bool
) -> _Runs:
    """Return the mean errors and valve travels of a policy in one episode for each seed.

    The result also has the length of the shortest episode. If `is_replayed` is true, a second
    simulation of plants with the arguments `case` checks the episodes.
    """
    n = plants.num_envs
    rounds: list[_Runs] = []
    for first in seeds[::n]:  # all plants run an episode in each round
        seeds_of_round = range(first, first + n)
        samples = rollout(plants, start(policy, n), EPISODE_STEPS, seeds_of_round)
        if is_replayed:
            samples = replayed(samples, case, seeds_of_round)
        rounds.append(_measure(samples))
    # The plants run at the same time, so there may be more episodes than seeds.
    errors = np.hstack([runs.errors for runs in rounds])[: len(seeds)]
    travels = np.hstack([runs.travels for runs in rounds])[: len(seeds)]
    return _Runs(errors, travels, min(runs.length for runs in rounds))


def _measure(samples: Iterator[Sample]) -> _Runs:
    """Return the mean errors and valve travels of plants from the samples of one episode."""
    next(samples)  # skip sample k = 0, which the policy cannot affect
    errors: list[Values] = []
    flows: list[Values] = []  # The infos of sample k have the flow of sample k - 1.
    for sample in samples:
        errors.append(sample.infos["error"])
        flows.append(sample.infos["applied"])
        if sample.ended.all():
            break
    return _Runs(
        errors=mean_absolute_error(np.array(errors)),
        travels=valve_travel(np.array(flows)),
        length=len(errors),
    )


class StoredReference(NamedTuple):
    """The stored reference error of each episode, or the reason why none is stored."""

    errors: Values | None  # reference error of each episode, degC, shape (episodes,)
    is_bound: bool = False  # `Evaluation.is_bound`
    why_not: str = ""  # why `errors` is None


def find_reference(parameters: Parameters, length: int, seeds: range) -> StoredReference:
    """Return the stored reference errors for the seeds, or why none are stored."""
    case = _stored_cases().get(case_of(parameters))
    if case is None:
        return StoredReference(
            None,
            why_not="reference errors are kept for the presets alone, without other arguments "
            "of the plant; in a checkout, python -m benchmarks.bounds --help says how to "
            "compute others",
        )
    if length != EPISODE_STEPS:
        return StoredReference(
            None,
            why_not=f"reference errors are kept for episodes of {EPISODE_STEPS:,} samples, not "
            f"of {length:,}: leave max_episode_steps as it is",
        )
    for first, errors in case.errors_by_seed.items():
        if len(errors) == 1:  # for all seeds, as only noise and load are random
            return StoredReference(np.repeat(errors, len(seeds)), case.is_bound)
        if first <= seeds.start and seeds.stop <= first + len(errors):
            of_seeds = errors[seeds.start - first : seeds.stop - first]
            return StoredReference(of_seeds, case.is_bound)
    stored_seeds = [
        f"{first:,} to {first + len(errors) - 1:,}"
        for first, errors in case.errors_by_seed.items()
    ]
    return StoredReference(
        None,
        why_not=f"reference errors of these plants are kept for seeds "
        f"{' and '.join(stored_seeds)}, not for {seeds.start:,} to {seeds.stop - 1:,}: choose "
        "seed and episodes among them",
    )


class _StoredCase(NamedTuple):
    """The reference errors of a case in the file `bounds.json`."""

    # Arrays of the reference errors for successive seeds, degC, by the first seed. If an array
    # has a single element, the reference error is the same for all seeds.
    errors_by_seed: dict[int, Values]
    is_bound: bool  # `Evaluation.is_bound`


@cache
def _stored_cases() -> dict[Parameters, _StoredCase]:
    """Return the cases in the file `bounds.json` by their arguments, as `case_of` returns."""
    text = resources.files("mptc_gym").joinpath("bounds.json").read_text(encoding="utf-8")
    cases = {}
    for record in json.loads(text)["cases"].values():
        errors_by_seed = {SEED: np.array(record["reference"])}
        if "validation_reference" in record:
            errors_by_seed[VALIDATION_SEED] = np.array(record["validation_reference"])
        # The kind "surprise" is the error of a controller that expects no change of the set
        # point, which another controller may expect.
        case = _StoredCase(errors_by_seed, is_bound=record["kind"] != "surprise")
        cases[case_of(Parameters(**record["arguments"]))] = case
    return cases


def case_of(parameters: Parameters) -> Parameters:
    """Return `parameters` with the default arguments of the observation and the reward.

    Plants for which `case_of` returns equal arguments have the same reference error.
    """
    defaults = {name: ARGUMENTS[name].default for name in _WITHOUT_EFFECT_ON_REFERENCE}
    return replace(parameters, **defaults)


def _idle_errors(parameters: Parameters, seeds: range) -> Values:
    """Return the mean error in the episode of each seed, degC, if the valve never moves."""
    n = len(seeds)
    plants = MiddlePointVectorEnv(n, **asdict(parameters))
    idle_action = action_from_command(0.0, parameters.u_min, parameters.u_max)
    idle_actions = np.full((n, 1), idle_action)
    samples = rollout(plants, lambda _: idle_actions, EPISODE_STEPS, [*seeds])
    return _measure(samples).errors


def _with_scores(evaluation: Evaluation, references: Values, idle_errors: Values) -> Evaluation:
    """Return a copy of `evaluation` with the reference errors and the scores."""
    errors = evaluation.errors
    return replace(
        evaluation,
        reference=float(references.mean()),
        ratio=float(errors.mean() / references.mean()),
        score=score(errors, idle_errors, references),
        interval=score_interval(errors, idle_errors, references),
        references=references,
        scores=scores(errors, idle_errors, references),
    )
