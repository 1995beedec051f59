"""Score any policy on fixed episodes: `evaluate`."""

from __future__ import annotations

import dataclasses
import inspect
import json
import warnings
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import cache, partial
from importlib import resources
from typing import Any, Final, cast

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec, WrapperSpec
from gymnasium.vector import SyncVectorEnv, VectorEnv
from gymnasium.wrappers import NormalizeObservation
from numpy.typing import NDArray

from mptc_gym.checks import MOST_PLANTS, count, reject
from mptc_gym.env import MiddlePointEnv
from mptc_gym.parameters import ARGUMENTS, Parameters
from mptc_gym.plant import action_from_command
from mptc_gym.presets import IDS
from mptc_gym.vector_env import MiddlePointVectorEnv
from mptc_gym.wrappers import IncrementalAction
from mptc_gym.wrappers.vector import IncrementalAction as VectorIncrementalAction

Values = NDArray[np.float64]  # one an episode, shape (episodes,)
Act = Callable[[NDArray[np.float32]], Any]  # observations, shape (n, size), to actions
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
_ACTING: Final = "a function, or an object with predict or with act"
_BATCH: Final = 100  # episodes that run side by side
_RESAMPLES: Final = 2000  # of the bootstrap
_INCREMENTAL: Final = f"{IncrementalAction.__module__}:{IncrementalAction.__name__}"


@dataclass(frozen=True, eq=False, repr=False)
class Evaluation:
    """What `evaluate` found. `str` gives a line to read.

    Attributes
    ----------
    env
        The environment's id.
    mean_error
        Mean of |e(k)| over k = 1 to N and over all episodes, degC.
    least_possible
        The least possible mean error of these episodes, degC; `python -m benchmarks.limits`
        explains it. None where the package has none, as for arguments that are no preset's.
    multiple
        `mean_error / least_possible`, or None.
    score
        0 for a valve that is left alone, 1 for the least possible error, or None.
    interval
        The ends of the score's 95 % interval, from drawing episodes, or None.
    travel
        Mean distance that the valve moves in an episode, t/h.
    errors, travels
        The same of each episode, shape (episodes,).
    least
        The least possible error of each episode, or None. Where nothing but noise and load is
        drawn it is the same for all: an expectation over these.
    scores
        The score of each episode against its own bound, or None.
    seeds
        Of the episodes.
    missing
        Where there is no bound: what to do about it. Otherwise "".
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
    missing: str = ""

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
    env: str | EnvSpec | Callable[[], gymnasium.Env[Any, Any]] = "MiddlePoint-v0",
    *,
    episodes: int = EPISODES,
    seed: int = SEED,
    **arguments: Any,
) -> Evaluation:
    """Run a policy on fixed episodes, and score it.

    Parameters
    ----------
    policy
        One of three:

        - an object with `predict(observations, state, episode_start, deterministic)`, such as
          a model of Stable-Baselines3. It acts without exploration; a recurrent state begins
          anew with every batch of episodes.
        - an object with `act(observations)` and `reset()`, such as the controllers of `agents`.
          `reset` is called before every batch.
        - a function of observations.

        Each gets observations of shape (n, size), float32, one row an episode, and returns
        actions of shape (n, 1). A batch has up to 100 episodes.
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

    Returns
    -------
    Evaluation
        Of all episodes.

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
    make = _maker(env, arguments)
    single = make()
    parameters = _parameters(single)
    with closing(single):
        _check_fit(policy, single, parameters)
        of_model = isinstance(env, str) and hasattr(policy, "observation_space")
        if of_model and trained_on(policy) is None:
            warnings.warn(
                "policy does not say how it was trained: its actions are taken for flows, not "
                "for changes of the flow. Save it by mptc_gym.sb3.save, or give env as an "
                "EnvSpec with the wrappers of its training",
                stacklevel=2,
            )
        name = single.spec.id if single.spec else type(single.unwrapped).__name__
        samples = (single.spec and single.spec.max_episode_steps) or SAMPLES
        batch = native_batch(single) or (lambda n: SyncVectorEnv([make] * n))
    seeds = range(first, first + episodes)
    errors, travels, samples = _run(batch, partial(acting, policy), seeds, samples)
    least = least_errors(parameters, samples, seeds)
    if least is None:
        bound: dict[str, Any] = {"missing": _missing(parameters)}
    else:
        rest = action_from_command(0.0, parameters.u_min, parameters.u_max)
        batch = partial(MiddlePointVectorEnv, **dataclasses.asdict(parameters))
        idle, _, _ = _run(
            batch, lambda: lambda seen: np.full((len(seen), 1), rest), seeds, samples
        )
        gained, possible = idle - errors, idle - least
        bound = {
            "least_possible": float(least.mean()),
            "multiple": float(errors.mean() / least.mean()),
            "score": float(gained.mean() / possible.mean()),
            "interval": _interval(gained, possible),
            "least": least,
            "scores": gained / possible,
        }
    mean_error, travel = float(errors.mean()), float(travels.mean())
    return Evaluation(name, mean_error, travel, errors, travels, seeds, **bound)


def least_errors(parameters: Parameters, samples: int, seeds: range) -> Values | None:
    """Return the least possible mean error of episodes, degC, as the package keeps it.

    Returns
    -------
    ndarray, shape (episodes,), or None
        None if the package does not have it for N = `samples` and these seeds. Where noise and
        load alone are drawn, it is the same for all episodes, and there for any seeds.
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


def _maker(env: Any, arguments: dict[str, Any]) -> Callable[[], gymnasium.Env[Any, Any]]:
    """Return a function that makes one environment."""
    if isinstance(env, str | EnvSpec):
        return partial(make_one, env, arguments)
    if not callable(env):
        reject("env", env, "an id, an EnvSpec or a function that makes an environment")
    if arguments:
        raise ValueError(f"{', '.join(arguments)} must be given in the function that is env")
    return cast("Callable[[], gymnasium.Env[Any, Any]]", env)


def make_one(env: str | EnvSpec, arguments: dict[str, Any]) -> gymnasium.Env[Any, Any]:
    """Make an environment from an id or a spec; ValueError if there is no such id."""
    try:
        return gymnasium.make(env, disable_env_checker=True, **arguments)
    except (gymnasium.error.UnregisteredEnv, ModuleNotFoundError) as error:
        allowed = f"the id of an environment, such as one of {', '.join(IDS.values())}"
        raise ValueError(f"env must be {allowed}, got {env!r}") from error


def _parameters(single: gymnasium.Env[Any, Any]) -> Parameters:
    """Return the arguments of an environment of this package.

    An environment whose observations would be scaled otherwise than in training is refused.
    """
    inner = getattr(single, "unwrapped", None)
    if not isinstance(inner, MiddlePointEnv):
        reject("env", single, "a MiddlePointEnv, in wrappers or not")
    while isinstance(single, gymnasium.Wrapper):
        if isinstance(single, NormalizeObservation):
            raise ValueError(
                "env must not be in NormalizeObservation, whose statistics would begin anew: "
                "train in VecNormalize and save by mptc_gym.sb3.save, or scale by fixed numbers"
            )
        single = single.env
    return inner.parameters


def _check_fit(policy: Any, single: gymnasium.Env[Any, Any], parameters: Parameters) -> None:
    """Refuse an environment that does not show what a policy reads, or reads what it means."""
    shape, own = single.observation_space.shape, getattr(policy, "observation_space", None)
    normaliser_of(policy)
    if own is not None and own.shape != shape:
        raise ValueError(
            f"env must have observations of shape {own.shape}, as policy reads them, got "
            f"{shape}: give it the windows of the training, such as action_window=20, or take "
            "mptc_gym.sb3.spec_of(policy)"
        )
    wanted, place = getattr(policy, "observation", {}), getattr(policy, "error_index", None)
    if place is not None:
        if place != parameters.heads[0] or not parameters.error_window:
            raise ValueError(
                f"env must show its newest error as element {place} of the observation, where "
                f"policy reads it, got windows {parameters.windows}"
            )
    elif isinstance(wanted, Mapping) and any(
        getattr(parameters, name) != value for name, value in wanted.items()
    ):
        asked = ", ".join(f"{name}={value}" for name, value in wanted.items())
        raise ValueError(
            f"env must have the windows that policy wants, {asked}, got {parameters.windows}"
        )
    spec, now = trained_on(policy), single.spec
    if spec is not None and now is not None:
        missing = [each for each in action_wrappers(spec) if each not in action_wrappers(now)]
        if missing:
            raise ValueError(
                f"env must have the wrapper that policy was trained with, {missing[0].name}"
                f"({missing[0].kwargs}): give it as an EnvSpec, see mptc_gym.sb3.spec_of"
            )


def trained_on(policy: Any) -> EnvSpec | None:
    """Return the spec of the environment that a policy was trained on, if that is known.

    `mptc_gym.sb3` notes it in the observation space; models of Stable-Baselines3 that were not
    loaded from a file still have their environments.
    """
    text = getattr(getattr(policy, "observation_space", None), "trained_on", None)
    if text is not None:
        return EnvSpec.from_json(text)
    with suppress(AttributeError):  # no model, or no environments, or they have no spec
        spec: EnvSpec | None = policy.get_env().get_attr("spec")[0]
        return spec
    return None


def normaliser_of(policy: Any) -> Callable[[NDArray[Any]], NDArray[Any]] | None:
    """Return what normalises the observations of a policy as in its training.

    It is None if it was trained without, or with one of rewards alone; and a ValueError if its
    statistics are lost.
    """
    live = getattr(policy, "get_vec_normalize_env", lambda: None)()
    if live is not None:
        return cast("Callable[[NDArray[Any]], NDArray[Any]]", live.normalize_obs)
    space = getattr(policy, "observation_space", None)
    kept = getattr(space, "normalised", None)
    if kept is None:
        # A model that learns on policy has these where, and only where, it is normalised.
        on_policy = hasattr(policy, "rollout_buffer")
        originals = getattr(policy, "_last_original_obs", None)
        if on_policy and originals is not None and not hasattr(space, "trained_on"):
            raise ValueError(
                "policy must come with the statistics of the VecNormalize that it was trained "
                "in: save it by mptc_gym.sb3.save"
            )
        return None
    mean, deviation = np.array(kept["mean"]), np.sqrt(np.array(kept["var"]) + kept["epsilon"])
    most = kept["clip_obs"]
    return lambda seen: np.clip((seen - mean) / deviation, -most, most).astype(np.float32)


def action_wrappers(spec: EnvSpec) -> list[WrapperSpec]:
    """Return the wrappers of a spec but those that only look on."""
    watching = "Monitor", "RecordEpisodeStatistics", "RecordVideo"
    return [each for each in spec.additional_wrappers if each.name not in watching]


def native_batch(single: gymnasium.Env[Any, Any]) -> Batch | None:
    """Return how to make many of an environment that step at once.

    It is called with their number, and with an `autoreset_mode` if need be. It is None if there
    is no such batch: for another environment, one without a spec, and in other wrappers than
    `IncrementalAction`.
    """
    inner, spec = single.unwrapped, single.spec
    if type(inner) is not MiddlePointEnv or spec is None:
        return None
    added = spec.additional_wrappers
    if [each.entry_point for each in added] not in ([], [_INCREMENTAL]):
        return None
    arguments = dataclasses.asdict(inner.parameters)
    plants: Batch = partial(
        MiddlePointVectorEnv, max_episode_steps=spec.max_episode_steps, **arguments
    )
    if not added:
        return plants
    moves = added[0].kwargs or {}
    return lambda n, **mode: VectorIncrementalAction(plants(n, **mode), **moves)


def acting(policy: Any) -> Act:
    """Bring a policy to the start of a batch of episodes, and return how it acts in it."""
    if isinstance(policy, type):
        reject("policy", policy, f"{_ACTING}, not a class")
    if callable(getattr(policy, "predict", None)):
        return _predicting(policy)
    if callable(getattr(policy, "act", None)):
        if callable(getattr(policy, "reset", None)):
            policy.reset()
        return cast("Act", policy.act)
    if not callable(policy):
        reject("policy", policy, _ACTING)
    return cast("Act", policy)


def _predicting(policy: Any) -> Act:
    """Return how a policy in the form of Stable-Baselines3 acts, from the start of episodes."""
    known = inspect.signature(policy.predict).parameters
    normalise = normaliser_of(policy)
    state, begins = None, True

    def act(observations: NDArray[np.float32]) -> Any:
        nonlocal state, begins
        if normalise is not None:
            observations = normalise(observations)
        offered = {
            "state": state,
            "episode_start": np.full(len(observations), begins),
            "deterministic": True,
        }
        begins = False
        told = {name: value for name, value in offered.items() if name in known}
        actions = policy.predict(observations, **told)
        if isinstance(actions, tuple):
            actions, state = actions
        return actions

    return act


def _run(
    batch: Batch, start: Callable[[], Act], seeds: range, samples: int
) -> tuple[Values, Values, int]:
    """Run one episode a seed, of N = `samples`, or less if the environments truncate before.

    `batch` makes so many environments, and `start` begins their episodes and returns how to
    act. Returned are the mean |e(k)| over k = 1 to N, degC, and how far the valve moves, t/h,
    both of each episode, and N.
    """
    errors, travels = np.empty(len(seeds)), np.empty(len(seeds))
    for first in range(0, len(seeds), _BATCH):
        which = slice(first, min(first + _BATCH, len(seeds)))
        n = which.stop - first
        with closing(batch(n)) as plants:
            act = start()
            observations, _ = plants.reset(seed=seeds[first])
            error, travel, before = np.zeros(n), np.zeros(n), np.zeros(n)
            for k in range(1, samples + 1):
                actions = _checked(act(observations), n, k)
                observations, _, terminated, truncated, infos = plants.step(actions)
                error += np.abs(infos["error"])
                travel += np.abs(infos["applied"] - before)
                before = infos["applied"]
                ended = terminated | truncated
                if ended.any():
                    if not ended.all():
                        raise ValueError("env must end all its episodes at the same sample")
                    samples = k
                    break
        errors[which], travels[which] = error / samples, travel
    return errors, travels, samples


def _checked(actions: Any, n: int, k: int) -> NDArray[Any]:
    """Return what a policy returned as an array, if the environments can take it."""
    try:
        checked = np.asarray(actions)
        finite = np.isfinite(checked)
    except (TypeError, ValueError, RuntimeError):  # the last one: of tensors
        reject("actions of policy", actions, "an array of numbers")
    if checked.shape != (n, 1):
        raise ValueError(
            f"policy must return actions of shape {(n, 1)} for {n} observations, got "
            f"{checked.shape}"
        )
    if not finite.all():
        raise ValueError(
            f"policy must return finite actions, got {checked[~finite][0]} at "
            f"sample {k - 1} of an episode"
        )
    return checked
