"""Read the options that choose controllers: of the roster, or a user's own.

The code of a user's own runs in the tasks that need it: what is wrong with it costs no other.
"""

import importlib.util
import inspect
import pkgutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from agents.controller import PAPER_WINDOWS
from agents.networks import WINDOWS
from benchmarks.controllers.roster import EVERYTHING, LIMITS, OWN, ROSTER, Controller
from benchmarks.lib.command import FanOut, Names, Parameter, blame, options
from benchmarks.lib.storage import UsageError
from mptc_gym import IDS, Parameters
from mptc_gym.acting import opened
from mptc_gym.evaluation import case_of
from mptc_gym.fit import check_fit
from mptc_gym.policies import start

AgentNames = Annotated[Names, Parameter(help="Controllers to run.", choices=ROSTER)]


@options
@dataclass(frozen=True, kw_only=True)
class ControllerOptions:
    """A user's own controllers, and where controllers run."""

    agent: Names = ()
    """A controller of your own in addition to those of --agents, NAME=MODULE:FACTORY or
    NAME=PPO:FILE.zip, of Stable-Baselines3; loading a zip runs the code in it. The same name
    again adds another training of it."""
    fan_out: FanOut = field(default_factory=FanOut)


def chosen(names: Sequence[str], own: Sequence[str] = ()) -> dict[str, Controller]:
    """Return controllers of the roster by name, then a user's own, as given to `--agent`.

    These have a member for each location. `members` raises a `UsageError` if one is faulty.
    """
    locations: dict[str, tuple[str, ...]] = {}
    for text in own:
        name, _, location = text.partition("=")
        taken = f"; {name!r} is taken" if name.lower() in ROSTER else ""
        module, colon, file = location.partition(":")
        is_zip, package = location.endswith(".zip"), module.partition(".")[0] or "-"
        there = Path(file).is_file() if is_zip else importlib.util.find_spec(package)
        if taken or not (name and colon and there):
            raise UsageError(
                f"--agent: {text!r} must be NEW_NAME=MODULE:FACTORY or NEW_NAME=PPO:FILE.zip, "
                f"of a module or a file that is there{taken}"
            )
        locations[name] = *locations.get(name, ()), location
    if not (names or own):
        raise UsageError("--agents, --agent: no controller to run")
    about: Any = {"told": (*EVERYTHING, *LIMITS), "random": True, "drawn": True}
    return {name: ROSTER[name] for name in names} | {
        name: Controller(name, name, OWN[0], _make, networks=partial(_found, each), **about)
        for name, each in locations.items()
    }


@dataclass(frozen=True)
class Own:
    """What is found at a location."""

    factory: Callable[..., Any]  # returns a policy, or it and the environment that it acts in
    observation: Mapping[str, int] = field(default_factory=lambda: PAPER_WINDOWS)
    provenance: Mapping[str, Any] = field(default_factory=dict)


def _found(locations: Sequence[str]) -> dict[str, Own]:
    return {each: _loaded(each) for each in locations}


def _loaded(location: str) -> Own:
    try:
        return _saved(location) if location.endswith(".zip") else _imported(location)
    except (Exception, SystemExit) as error:  # whatever a user's code or file raises
        text = f"{location!r} cannot be loaded: {type(error).__name__}: {error}"
        raise UsageError(f"--agent: {text}") from error


def _imported(location: str) -> Own:
    """Import a user's factory; the README of `benchmarks.compare` says what it may have."""
    factory: Any = pkgutil.resolve_name(location)
    observation = dict(getattr(factory, "observation", PAPER_WINDOWS))
    if not set(observation) <= set(WINDOWS):
        allowed = ", ".join(WINDOWS)
        raise ValueError(f"observation must have names out of {allowed}, got {observation}")
    about = {name: str(getattr(factory, name, "")) for name in ("knows", "searched")}
    return Own(factory, observation, about)


def _saved(location: str) -> Own:
    """Load a model, which acts as its file says, or else in the plain environment."""
    import stable_baselines3  # here: PyTorch takes seconds to load

    from mptc_gym.sb3 import load

    (algorithm, _, file), about = location.partition(":"), {}
    try:
        model: Any = load(file, device="cpu")
    except ValueError:  # not of `mptc_gym.sb3.save`
        kind: Any = getattr(stable_baselines3, algorithm, None)
        kind = kind or pkgutil.resolve_name(f"sb3_contrib:{algorithm}")
        model = kind.load(file, device="cpu")
        about["note"] = f"{file} names no environment: run in the plain one, without wrappers."
    weights = sum(weight.numel() for weight in model.policy.parameters())
    samples = f"{model.num_timesteps / 1e6:.3g} M samples a policy"
    about["searched"] = f"{weights:,} weights: {samples}"
    return Own(lambda: model, provenance=about)


def _make(*, network: Own, **told: Any) -> Any:
    """Call a user's factory with the arguments that it accepts, by name."""
    accepted = inspect.signature(network.factory).parameters
    takes_all = any(each.kind is each.VAR_KEYWORD for each in accepted.values())
    made = network.factory(
        **{name: told[name] for name in told if takes_all or name in accepted}
    )
    if hasattr(made, "reset") and hasattr(made, "act"):
        return made
    policy, env = made if isinstance(made, tuple) else (made, None)
    return Policy(policy, env, told["num_envs"])


@dataclass
class Policy:
    """A policy in any form that `mptc_gym.evaluate` takes, and what it acts in."""

    policy: Any
    # Environment, or what makes one; None for that saved with the model, or else the plain one.
    env: Any
    runs: int

    def reset(self) -> None:
        """Start an episode."""
        self.act = start(self.policy, self.runs)

    @contextmanager
    def opened(self, samples: int, **arguments: Any) -> Iterator[Any]:
        """Yield the plants that it acts in, with these arguments or refused."""
        env, more = self.env, {}
        if env is None:
            env, more = IDS["paper"], {**arguments, "max_episode_steps": samples}
            if getattr(self.policy, "get_env", lambda: None)() is not None:
                from mptc_gym.sb3 import spec_of

                plant = {each: more[each] for each in more if each not in WINDOWS}
                env, more = spec_of(self.policy, **plant), {}
        with opened(env, self.runs, self.policy, **more) as given:
            with blame("--agent"):
                case = case_of(Parameters(**arguments))
                if any(case_of(group.parameters) != case for group in given.groups):
                    raise ValueError("the environment must have the parameters of the case")
                check_fit(self.policy, given)
            yield given
