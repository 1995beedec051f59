"""Score any policy on fixed episodes: `evaluate`."""

from __future__ import annotations

import dataclasses
import json
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
from mptc_gym.presets import IDS
from mptc_gym.vector_env import MiddlePointVectorEnv
from mptc_gym.wrappers import IncrementalAction
from mptc_gym.wrappers.vector import IncrementalAction as VectorIncrementalAction

Values = NDArray[np.float64]  # one an episode, shape (episodes,)
Env = gymnasium.Env[Any, Any]
Batch = Callable[..., VectorEnv[Any, Any, Any]]  # makes n environments

SEED: Final = 7_000_000
"""Of the first of the fixed episodes; episode i has the seed `SEED + i`. Train on others."""
EPISODES: Final = 100
"""How many of them a score is the mean of, unless told otherwise."""
SAMPLES: Final = 1200
"""Of an episode whose environment has no limit."""

WINDOWS: Final = "setpoint_window", "error_window", "output_window", "action_window"
# Arguments that change what an agent sees or is paid, and not what it can come to.
_NO_MATTER: Final = *WINDOWS, "reward", "error_scale", "move_weight"
_BATCH: Final = 100  # episodes that run side by side
_RESAMPLES: Final = 2000  # of the bootstrap
_INCREMENTAL: Final = f"{IncrementalAction.__module__}:{IncrementalAction.__name__}"


@dataclass(frozen=True, eq=False, repr=False)
class Evaluation:
    """What `evaluate` found. `str` gives a line to read.

    What compares with the least possible error is None where the package has no bound, as for
    arguments that are no preset's. Arrays have an element for each episode.
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
    """How far the valve moves, t/h."""
    seeds: range
    """Of the episodes."""
    least_possible: float | None = None
    """The least possible mean error of these episodes, degC: see `benchmarks/limits`."""
    multiple: float | None = None
    """`mean_error / least_possible`."""
    score: float | None = None
    """0 for a valve that is left alone, 1 for the least possible error."""
    interval: tuple[float, float] | None = None
    """The ends of the score's 95 % interval, from drawing episodes."""
    least: Values | None = None
    """The least possible errors, degC. Where nothing but noise and load is drawn they are all
    the same: an expectation over these."""
    scores: Values | None = None
    """Of each episode against its own bound."""
    missing: str = ""
    """Where there is no bound: what to do about it."""

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
    """Run a policy on fixed episodes, and score it.

    Parameters
    ----------
    policy
        One of three, which gets observations of shape (n, size), float32, one row an episode,
        and returns actions of shape (n, 1). A batch has up to 100 episodes.

        - an object with `predict(observations, state, episode_start, deterministic)`, such as
          a model of Stable-Baselines3. It acts without exploration; a recurrent state begins
          anew with every batch.
        - an object with `act(observations)` and `reset()`, such as the controllers of `agents`.
          `reset` is called before every batch.
        - a function of observations.
    env
        An id, `IDS` has seven; an `EnvSpec`, which may name wrappers; or a function that makes
        an environment. A policy whose action is read by a wrapper, such as
        `IncrementalAction`, has to be judged with the wrapper: by one of the latter two.
    episodes
        How many, at least 2.
    seed
        Of the first episode. The default is that of all published scores. There are bounds for
        the 120 episodes from there on: take others than the first 100 to choose a policy by.
    **arguments
        More arguments for the id or the `EnvSpec`, as of `gymnasium.make`: those of the
        environment and `max_episode_steps`.

    Raises
    ------
    ValueError
        If there is no such environment, it is not one of this package, the policy does not fit
        it, or it returns actions of another shape or that are not finite.
    TypeError
        If an argument of the environment is unknown.

    Warns
    -----
    UserWarning
        If the policy is a model that does not say how it was trained, and `env` is an id.

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
        return dataclasses.replace(found, missing=_missing(parameters))
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
    """Return the least possible mean error of episodes, degC, as the package keeps it.

    None if the package does not have it for N = `samples` and these seeds. Where noise and load
    alone are drawn, it is the same for all episodes, and there for any seeds.
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
    """Return the bounds that `python -m benchmarks.limits --package` has written, by case."""
    text = resources.files("mptc_gym").joinpath("bounds.json").read_text(encoding="utf-8")
    cases = json.loads(text)["cases"].values()
    return {_case(Parameters(**case["arguments"])): np.array(case["least"]) for case in cases}


def _case(parameters: Parameters) -> Parameters:
    """Return the arguments without those that do not change what is possible."""
    defaults = {name: ARGUMENTS[name].default for name in _NO_MATTER}
    return dataclasses.replace(parameters, **defaults)


def _missing(parameters: Parameters) -> str:
    """Return how to come by a bound that the package does not have."""
    case = dataclasses.asdict(_case(parameters))
    options = "".join(
        f" --set {name}={value if isinstance(value, str) else json.dumps(value)}"
        for name, value in case.items()
        if value != ARGUMENTS[name].default
    ).replace(", ", ",")
    return f"no bound is kept for this case: python -m benchmarks.limits{options}"


def _interval(gained: Values, possible: Values) -> tuple[float, float]:
    """Return the 95 % interval of a quotient of means, by drawing episodes with replacement."""
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

    An environment whose observations would be scaled otherwise than in training is refused.
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
    """Return how to make many of an environment that step at once.

    It is called with their number, and with an `autoreset_mode` and a `render_mode` if need be.
    It is None if there is no such batch: for another environment, one without a spec, and in
    other wrappers than `IncrementalAction`.
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
    """Run one episode a seed, of N = `samples`, or less if the environments truncate before.

    Returned are the mean |e(k)| over k = 1 to N, degC, and how far the valve moves, t/h, both
    of each episode, and N. `batch` makes so many environments.
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
    """Return what a policy returned at sample k, if the environments can take it."""
    try:
        checked = np.asarray(actions)
        finite = np.isfinite(checked)
    except (TypeError, ValueError, RuntimeError):  # the last one: of tensors
        reject("actions of policy", actions, "an array of numbers")
    if checked.shape != (n, 1):
        raise ValueError(f"policy must return actions of shape {(n, 1)}, got {checked.shape}")
    if not finite.all():
        wrong = checked[~finite][0]
        raise ValueError(f"policy must return finite actions, got {wrong} at sample {k}")
    return checked
