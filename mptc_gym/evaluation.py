"""Score any policy on fixed episodes."""

from __future__ import annotations

import dataclasses
import json
import shlex
import warnings
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from functools import cache, partial
from importlib import resources
from typing import Any, Final, cast

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import SyncVectorEnv, VectorEnv
from numpy.typing import NDArray

from mptc_gym.checks import MOST_PLANTS, count, reject
from mptc_gym.env import MiddlePointEnv
from mptc_gym.parameters import ARGUMENTS, Parameters
from mptc_gym.plant import action_from_command
from mptc_gym.policies import acting, check_fit, trained_on
from mptc_gym.presets import IDS, PRESETS
from mptc_gym.vector_env import MiddlePointVectorEnv
from mptc_gym.wrappers import IncrementalAction
from mptc_gym.wrappers.vector import IncrementalAction as VectorIncrementalAction

Values = NDArray[np.float64]  # one per episode, shape (episodes,)
Env = gymnasium.Env[Any, Any]
Batch = Callable[..., VectorEnv[Any, Any, Any]]  # makes n environments

SEED: Final = 7_000_000
"""Seed of the first fixed episode; episode i has the seed `SEED + i`. Train on other seeds."""
EPISODES: Final = 100
"""Default number of episodes per score."""
SAMPLES: Final = 1200
"""Length of an episode if its environment has no time limit, samples."""

WINDOWS: Final = "setpoint_window", "error_window", "output_window", "action_window"
# Arguments that change observations or rewards, but not the least possible error.
_NO_MATTER: Final = *WINDOWS, "reward", "error_scale", "move_weight"
_BATCH: Final = 100  # episodes run side by side
_RESAMPLES: Final = 2000  # bootstrap resamples
_INCREMENTAL: Final = f"{IncrementalAction.__module__}:{IncrementalAction.__name__}"


@dataclass(frozen=True, eq=False, repr=False)
class Evaluation:
    """Result of `evaluate`; `str` gives a one-line summary.

    Fields that depend on the least possible error are None where the package has no bound, as
    for arguments of no preset. Arrays have one element per episode.
    """

    env: str
    """The environment's id."""
    mean_error: float
    """Mean of |e(k)| over k = 1 to N and over all episodes, degC."""
    travel: float
    """Mean distance that the valve moves in an episode, t/h."""
    errors: Values
    """Mean of |e(k)| over k = 1 to N, degC."""
    travels: Values
    """Distance that the valve moves, t/h."""
    seeds: range
    """Seeds of the episodes."""
    least_possible: float | None = None
    """Least possible mean error of these episodes, degC: see `benchmarks/bounds`."""
    multiple: float | None = None
    """`mean_error / least_possible`."""
    score: float | None = None
    """0 for a valve that is left alone, 1 for the least possible error."""
    interval: tuple[float, float] | None = None
    """95 % bootstrap interval of the score, from resampled episodes."""
    least: Values | None = None
    """Least possible error, degC. Where only noise and load are drawn, all elements equal its
    expectation over these."""
    scores: Values | None = None
    """Score of each episode against its own bound."""
    missing: str = ""
    """How to compute the bound if there is none; otherwise empty."""

    def __str__(self) -> str:
        parts = [f"{self.env}: mean error {self.mean_error:.3f} degC"]
        if self.interval is not None:
            low, high = self.interval
            parts[0] += f", {self.multiple:.2f} times the least possible"
            drawn = f" (95 % {low:.3f} to {high:.3f})" if low < high else ""
            parts.append(f"score {self.score:.3f}{drawn}")
        alike = ", all alike" if np.ptp(self.errors) == 0.0 else ""
        parts += [f"valve travel {self.travel:.0f} t/h", f"{len(self.errors)} episodes{alike}"]
        return "; ".join([*parts, self.missing] if self.missing else parts)

    def __repr__(self) -> str:
        score = "None" if self.score is None else f"{self.score:.3f}"
        return f"Evaluation({self.env!r}, mean_error={self.mean_error:.3f}, score={score})"


def evaluate(
    policy: Any,
    env: str | EnvSpec | Callable[[], Env] = "MiddlePoint-v0",
    *,
    episodes: int = EPISODES,
    seed: int = SEED,
    **arguments: Any,
) -> Evaluation:
    """Run a policy on fixed episodes and score it.

    Parameters
    ----------
    policy
        One of three kinds. It receives observations of shape (n, size), float32, one row per
        episode, and returns actions of shape (n, 1). A batch has up to 100 episodes.

        - an object with `predict(observations, state, episode_start, deterministic)`, such as
          a Stable-Baselines3 model. It acts without exploration; a recurrent state is reset
          before every batch.
        - an object with `act(observations)` and `reset()`, such as the controllers in `agents`.
          `reset` is called before every batch.
        - a function of the observations.
    env
        An id, such as one of `IDS`; an `EnvSpec`, which may include wrappers; or a function
        that makes an environment. A policy trained with a wrapper that changes its actions,
        such as `IncrementalAction`, needs that wrapper here, from a spec or a function.
    episodes
        Number of episodes, at least 2.
    seed
        Seed of the first episode. The default is that of all published scores. Bounds exist for
        the 120 episodes from there on: to select a policy, use others than the first 100.
    **arguments
        Further arguments for the id or the `EnvSpec`, as in `gymnasium.make`: those of the
        environment and `max_episode_steps`.

    Raises
    ------
    ValueError
        If the environment does not exist or is not one of this package, if the policy does not
        fit it, or if the policy's actions have the wrong shape or are not finite.
    TypeError
        If an argument of the environment is unknown.

    Warns
    -----
    UserWarning
        If the policy is a model that does not record how it was trained, and `env` is an id.

    Examples
    --------
    >>> import mptc_gym, numpy as np
    >>> print(mptc_gym.evaluate(lambda observations: np.zeros((len(observations), 1))))
    MiddlePoint-v0: mean error 5.000 degC, 5.49 times the least possible; score 0.000; \
valve travel 0 t/h; 100 episodes, all alike
    """
    episodes = count("episodes", episodes, 2, MOST_PLANTS)
    first = count("seed", seed, 0, 2**63)
    seeds = range(first, first + episodes)
    make = _maker(env, arguments)
    single = make()
    parameters = _parameters(single)
    with closing(single):
        check_fit(policy, single, parameters)
        is_model = hasattr(policy, "observation_space")
        if is_model and isinstance(env, str) and trained_on(policy) is None:
            warnings.warn(
                "policy does not say how it was trained: its actions are taken for flows, not "
                "for changes of the flow. Save it by mptc_gym.sb3.save, or give env as an "
                "EnvSpec with the wrappers of its training",
                stacklevel=2,
            )
        name = single.spec.id if single.spec else type(single.unwrapped).__name__
        samples = (single.spec and single.spec.max_episode_steps) or SAMPLES
        batch = native_batch(single) or (lambda n: SyncVectorEnv([make] * n))
    errors, travels, samples = _run(batch, policy, seeds, samples)
    found = Evaluation(
        name, float(errors.mean()), float(travels.mean()), errors, travels, seeds
    )
    least = least_errors(parameters, samples, seeds)
    if least is None:
        return dataclasses.replace(found, missing=_missing(parameters, samples, seeds))
    plants: Batch = partial(MiddlePointVectorEnv, **dataclasses.asdict(parameters))
    rest = action_from_command(0.0, parameters.u_min, parameters.u_max)
    idle, _, _ = _run(plants, lambda seen: np.full((len(seen), 1), rest), seeds, samples)
    gained, possible = idle - errors, idle - least
    return dataclasses.replace(
        found,
        least_possible=float(least.mean()),
        multiple=float(errors.mean() / least.mean()),
        score=float(gained.mean() / possible.mean()),
        interval=_interval(gained, possible),
        least=least,
        scores=gained / possible,
    )


def least_errors(parameters: Parameters, samples: int, seeds: range) -> Values | None:
    """Return the least possible mean error of each episode, degC, from the package's bounds.

    Return None if there is no bound for N = `samples` and these seeds. Where only noise and
    load are drawn, one bound holds for all episodes and any seeds.
    """
    least = _kept().get(_case(parameters))
    if least is None or samples != SAMPLES:
        return None
    if len(least) == 1:
        return np.repeat(least, len(seeds))
    first, beyond = seeds.start - SEED, seeds.stop - SEED
    return least[first:beyond] if first >= 0 and beyond <= len(least) else None


@cache
def _kept() -> dict[Parameters, Values]:
    """Return the bounds written by `python -m benchmarks.bounds --package`, by case."""
    text = resources.files("mptc_gym").joinpath("bounds.json").read_text(encoding="utf-8")
    cases = json.loads(text)["cases"].values()
    return {_case(Parameters(**case["arguments"])): np.array(case["least"]) for case in cases}


def _case(parameters: Parameters) -> Parameters:
    """Return the arguments, with those that do not affect the bound at their defaults."""
    defaults = {name: ARGUMENTS[name].default for name in _NO_MATTER}
    return dataclasses.replace(parameters, **defaults)


def _missing(parameters: Parameters, samples: int, seeds: range) -> str:
    """Return a message with the command that computes a missing bound."""
    case, options = _case(parameters), []
    for name, given in PRESETS.items():
        if case == _case(Parameters(**given)):
            options = ["--preset", name]
    if not options:
        for name, value in dataclasses.asdict(case).items():
            if value != ARGUMENTS[name].default:
                text = json.dumps(value, separators=(",", ":")).strip('"')
                options += ["--set", f"{name}={text}"]
    asked = {"samples": samples, "episodes": len(seeds), "seed": seeds.start}
    usual = {"samples": SAMPLES, "episodes": EPISODES, "seed": SEED}
    for name, value in asked.items():
        if value != usual[name]:
            options += [f"--{name}", str(value)]
    command = shlex.join(["python", "-m", "benchmarks.bounds", *options])
    return f"no bound is kept for this case: {command}"


def _interval(gained: Values, possible: Values) -> tuple[float, float]:
    """Return the 95 % bootstrap interval of a quotient of means over episodes."""
    generator, n = np.random.default_rng(0), len(gained)
    drawn = (generator.integers(n, size=n) for _ in range(_RESAMPLES))
    quotients = [gained[which].mean() / possible[which].mean() for which in drawn]
    low, high = np.quantile(quotients, (0.025, 0.975))
    return float(low), float(high)


def _maker(env: Any, arguments: dict[str, Any]) -> Callable[[], Env]:
    """Return a function that makes one environment."""
    if isinstance(env, str | EnvSpec):
        return partial(make_one, env, arguments)
    if not callable(env):
        reject("env", env, "an id, an EnvSpec or a function that makes an environment")
    if arguments:
        raise ValueError(f"{', '.join(arguments)} must be given in the function that is env")
    return cast("Callable[[], Env]", env)


def make_one(env: str | EnvSpec, arguments: dict[str, Any]) -> Env:
    """Make an environment from an id or a spec; ValueError if there is no such id."""
    try:
        return gymnasium.make(env, disable_env_checker=True, **arguments)
    except (gymnasium.error.UnregisteredEnv, ModuleNotFoundError):
        reject(
            "env", env, f"the id of an environment, such as one of {', '.join(IDS.values())}"
        )


def _parameters(single: Env) -> Parameters:
    """Return the arguments of an environment of this package.

    An environment that would scale observations differently than in training is refused.
    """
    inner = getattr(single, "unwrapped", None)
    if not isinstance(inner, MiddlePointEnv):
        reject("env", single, "a MiddlePointEnv, in wrappers or not")
    if single.has_wrapper_attr("obs_rms"):
        raise ValueError(
            "env must not be in NormalizeObservation, whose statistics would begin anew: "
            "train in VecNormalize and save by mptc_gym.sb3.save, or scale by fixed numbers"
        )
    return inner.parameters


def native_batch(single: Env) -> Batch | None:
    """Return a function that makes many of an environment, to be stepped at once.

    It takes their number and, optionally, an `autoreset_mode` and a `render_mode`. Return None
    if there is no such batch: for another environment, one without a spec, or one in wrappers
    other than `IncrementalAction`.
    """
    inner, spec = single.unwrapped, single.spec
    if type(inner) is not MiddlePointEnv or spec is None:
        return None
    arguments = dataclasses.asdict(inner.parameters)
    plants: Batch = partial(
        MiddlePointVectorEnv, max_episode_steps=spec.max_episode_steps, **arguments
    )
    match spec.additional_wrappers:
        case ():
            return plants
        case (only,) if only.entry_point == _INCREMENTAL:
            moves = only.kwargs or {}
            return lambda n, **modes: VectorIncrementalAction(plants(n, **modes), **moves)
    return None


def _run(batch: Batch, policy: Any, seeds: range, samples: int) -> tuple[Values, Values, int]:
    """Run one episode per seed, of N = `samples`, or fewer if the environments end earlier.

    Return the mean |e(k)| over k = 1 to N, degC, and the valve travel, t/h, of each episode;
    and N. `batch(n)` makes n environments.
    """
    errors, travels = np.empty(len(seeds)), np.empty(len(seeds))
    for first in range(0, len(seeds), _BATCH):
        which = slice(first, min(first + _BATCH, len(seeds)))
        n = which.stop - first
        with closing(batch(n)) as plants:
            act = acting(policy)
            observations, _ = plants.reset(seed=seeds[first])
            error, travel, before = np.zeros(n), np.zeros(n), np.zeros(n)
            for k in range(samples):
                actions = _checked(act(observations), n, k)
                observations, _, terminated, truncated, infos = plants.step(actions)
                error += np.abs(infos["error"])
                travel += np.abs(infos["applied"] - before)
                before = infos["applied"]
                ended = terminated | truncated
                if ended.any():
                    if not ended.all():
                        raise ValueError("env must end all its episodes at the same sample")
                    samples = k + 1
                    break
        errors[which], travels[which] = error / samples, travel
    return errors, travels, samples


def _checked(actions: Any, n: int, k: int) -> NDArray[Any]:
    """Return a policy's actions at sample k as an array, if the environments can take them."""
    try:
        checked = np.asarray(actions)
        finite = np.isfinite(checked)
    except (TypeError, ValueError, RuntimeError):  # the last: from tensors
        reject("actions of policy", actions, "an array of numbers")
    if checked.shape != (n, 1):
        raise ValueError(f"policy must return actions of shape {(n, 1)}, got {checked.shape}")
    if not finite.all():
        wrong = checked[~finite][0]
        raise ValueError(f"policy must return finite actions, got {wrong} at sample {k}")
    return checked
