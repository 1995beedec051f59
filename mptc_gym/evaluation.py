"""Score any policy on fixed episodes."""

from __future__ import annotations

import dataclasses
import json
import shlex
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import cache, partial
from importlib import resources
from typing import Any, Final, cast

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import SyncVectorEnv, VectorEnv
from numpy.typing import NDArray

from mptc_gym.checks import MOST_PLANTS, count, reject, shorten
from mptc_gym.env import MiddlePointEnv
from mptc_gym.parameters import ARGUMENTS, Parameters
from mptc_gym.plant import action_from_command
from mptc_gym.policies import Step, check_fit, rollout, start, training_of
from mptc_gym.presets import IDS, PRESETS
from mptc_gym.training import WINDOWS, entry_point, make_one, wrappers_of
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

# Arguments that change observations or rewards, but not the least possible error.
_NO_MATTER: Final = *WINDOWS, "reward", "error_scale", "move_weight"
_RESAMPLES: Final = 2000  # bootstrap resamples


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
    env: str | EnvSpec | Callable[[], Env] | None = None,
    *,
    episodes: int = EPISODES,
    seed: int = SEED,
    **arguments: Any,
) -> Evaluation:
    """Run a policy on fixed episodes and score it.

    Parameters
    ----------
    policy
        One of the following. It receives float32 observations of shape (episodes, size), one
        row per episode, and returns actions of shape (episodes, 1). All episodes run side by
        side, however many there are. If it has a method `reset`, that is called first, without
        arguments; what a policy without one remembers is not forgotten.

        - a model of Stable-Baselines3, which acts without exploration. Its observations are
          normalised and stacked as in its training, and `env` must have the windows and
          wrappers of its training. It must still have its training environments, or come from
          `mptc_gym.sb3.load`.
        - another object with `predict(observations)`. If that takes them by name or by
          `**kwargs`, it is also given `state`, `episode_start` and `deterministic=True`. It
          returns actions, or actions and state.
        - another object with `act(observations)`, such as the controllers in `agents`.
        - a `torch.nn.Module`, which is called with tensors. With or without `predict` or
          `act`, it is in evaluation mode and computes no gradients.
        - a function of the observations. For what it reads and does, the caller vouches.

        `act`, a module's `forward` and a function are given `deterministic=True`, too, if they
        take it by name.
    env
        An id, such as one of `IDS`; an `EnvSpec`, which may include wrappers, such as that of
        `mptc_gym.sb3.spec_of`; or a function that makes a new environment at each call, which
        must run the episodes of its seeds. By default `MiddlePoint-v0`, for a model with the
        windows and wrappers of its training.
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
        If the environment does not exist, is not one of this package or runs other episodes
        than those of its seeds; if the policy does not fit it, or is a model that does not say
        how it was trained; or if the policy's actions have the wrong shape or are not finite.
    TypeError
        If an argument of the environment is unknown.

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
    make = _maker(policy, env, arguments)
    single = make()
    parameters = _parameters(single)
    with ExitStack() as made:
        made.enter_context(closing(single))
        # Of an id or a spec, all are alike.
        if callable(env) and _parameters(made.enter_context(closing(make()))) != parameters:
            raise ValueError("env must be a function that makes the same plant at each call")
        check_fit(policy, single, parameters, episodes)
        spec = single.spec
        name = spec.id if spec else type(single.unwrapped).__name__
        samples = (spec and spec.max_episode_steps) or SAMPLES
        native: Batch = partial(MiddlePointVectorEnv, **dataclasses.asdict(parameters))
        batch = native_batch(single)
    if batch is not None:
        errors, travels = _run(batch, policy, seeds, samples)
    else:
        errors, travels = _run(_one_by_one(make), policy, seeds, samples, native)
    found = Evaluation(
        name, float(errors.mean()), float(travels.mean()), errors, travels, seeds
    )
    least = least_errors(parameters, samples, seeds)
    if least is None:
        return dataclasses.replace(found, missing=_missing(parameters, samples, seeds))
    rest = action_from_command(0.0, parameters.u_min, parameters.u_max)
    idle, _ = _run(native, lambda seen: np.full((len(seen), 1), rest), seeds, samples)
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


def _maker(policy: Any, env: Any, arguments: dict[str, Any]) -> Callable[[], Env]:
    """Return a function that makes one environment."""
    if env is None:
        training = training_of(policy)
        if training is not None:
            return partial(make_one, training.spec(IDS["paper"], arguments), {})
        env = IDS["paper"]
    if isinstance(env, str | EnvSpec):
        return partial(make_one, env, arguments)
    if not callable(env):
        reject("env", env, "an id, an EnvSpec or a function that makes an environment")
    if arguments:
        raise ValueError(f"{', '.join(arguments)} must be given in the function that is env")
    return cast("Callable[[], Env]", env)


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
    match wrappers_of(single):
        case ():
            return plants
        case (only,) if only.entry_point == entry_point(IncrementalAction):
            moves = only.kwargs or {}
            return lambda n, **modes: VectorIncrementalAction(plants(n, **modes), **moves)
    return None


def _one_by_one(make: Callable[[], Env]) -> Batch:
    """Return a function that makes n environments, to be stepped one after the other."""

    def batch(n: int) -> VectorEnv[Any, Any, Any]:
        plants = SyncVectorEnv([make] * n)
        if len({id(each.unwrapped) for each in plants.envs}) < n:
            raise ValueError("env must be a function that makes a new environment at each call")
        return plants

    return batch


def _run(
    batch: Batch, policy: Any, seeds: range, samples: int, native: Batch | None = None
) -> tuple[Values, Values]:
    """Run one episode of N = `samples` per seed; `batch(n)` makes n environments.

    With `native`, which makes the package's own plants, other episodes than theirs are refused.
    Return the mean |e(k)| over k = 1 to N, degC, and the valve travel, t/h, of each episode.
    """
    n = len(seeds)
    error, travel = np.zeros(n), np.zeros(n)
    with ExitStack() as stack:
        plants = stack.enter_context(closing(batch(n)))
        steps = rollout(plants, start(policy, n), samples, seeds[0])
        if native:
            steps = _same_episodes(steps, stack.enter_context(closing(native(n))), seeds[0])
        for k, (before, after, ended) in enumerate(steps, 1):
            error += np.abs(after["error"])
            travel += np.abs(after["applied"] - before["applied"])
            if k < samples and ended.any():
                raise ValueError(f"env must run episodes of {samples} samples, got {k}")
    return error / samples, travel


def _same_episodes(steps: Iterable[Step], plants: Any, seed: int) -> Iterator[Step]:
    """Yield steps, as long as `plants`, given the same commands, show the same."""
    expected = plants.reset(seed=seed)[1]
    limits = [
        expected.get(each, getattr(plants.parameters, each)) for each in ("u_min", "u_max")
    ]
    for k, step in enumerate(steps):
        if k == 0:
            _check_infos(step.before, expected, k)
        flows = step.after.get("command", np.zeros(plants.num_envs))
        expected = plants.step(action_from_command(flows, *limits)[:, np.newaxis])[-1]
        _check_infos(step.after, expected, k + 1)
        yield step


def _check_infos(infos: dict[str, Any], expected: dict[str, Any], k: int) -> None:
    """Refuse infos at sample k that are not those expected, but for rounding."""
    names = [name for name in expected if not name.startswith("_")]
    values = np.array([expected[name] for name in names])
    found = np.array([infos.get(name, np.full_like(values[0], np.nan)) for name in names])
    right = np.isclose(found, values, 1e-6, 1e-6, equal_nan=True).all(axis=1)
    follow = "output", "error", "command", "applied"  # from the others, which tell more
    for name in sorted(np.array(names)[~right], key=lambda name: name in follow):
        raise ValueError(
            f"env must run the episodes of its seeds, whose {name} by sample {k} is "
            f"{shorten(expected[name])}, got {shorten(infos.get(name))}: it must not reset "
            "with another seed, skip or repeat samples, or change the plant or info"
        )
