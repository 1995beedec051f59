"""Load and run a user's own controllers.

A factory is a function or a class of the user that returns a policy; a zip file of
Stable-Baselines3 is wrapped in a factory. `benchmarks/compare/README.md` describes what a
factory gets and returns. The code of a user is loaded in the task that runs the controller, so
that an error in the code does not stop other tasks.
"""

import importlib
import inspect
import pkgutil
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

from agents.controller import PAPER_WINDOWS
from agents.networks import WINDOWS
from benchmarks.controllers.spec import ControllerSpec
from benchmarks.lib.errors import UsageError
from benchmarks.lib.provenance import CODE_FOLDERS, ROOT
from benchmarks.loop.rollout import Agent, Trajectory, rollout
from mptc_gym import IDS, Parameters
from mptc_gym.environments.layers import plant_groups
from mptc_gym.evaluation import case_of
from mptc_gym.scoring.fit import check_fit
from mptc_gym.scoring.opening import opened
from mptc_gym.scoring.policies import start

Factory = Callable[..., Any]
# Attributes of a factory with texts for the report: the prior knowledge, the training, and a
# remark.
TEXTS = "knows", "searched", "note"


@dataclass(frozen=True, kw_only=True)
class OwnController(ControllerSpec):
    """The record of a user's own controller, whose errors become sentences.

    Attributes
    ----------
    locations : sequence of str
        Where the factory of each member is: texts MODULE:FACTORY or ALGORITHM:FILE.zip.
    """

    locations: Sequence[str]

    def members(self) -> list[ControllerSpec]:
        """Load the factories, and return a record for each factory, in the order of locations.

        A `UsageError` is raised if a factory cannot be loaded.
        """
        members: list[ControllerSpec] = []
        for location in sorted(set(self.locations)):
            with blame_user(f"{self.name}={location}", "loaded"):
                factory = load_factory(location)
                observation = observation_of(factory)
                texts = {
                    text: str(getattr(factory, text))
                    for text in TEXTS
                    if hasattr(factory, text)
                }
            member = replace(
                self,
                build=partial(self.build, factory=factory),
                observation=observation,
                provenance={"file": location, **texts},
                locations=[location],
            )
            members.append(member)
        return members

    def make(self, plant: Mapping[str, Any], runs: int, seed: int) -> Agent:
        """Return a controller for a batch of runs, as `ControllerSpec.make` does.

        A `UsageError` is raised if the factory cannot be called or raises an error.
        """
        with blame_user(f"{self.name}={self.locations[0]}", "made"):
            return super().make(plant, runs, seed)

    def run(
        self,
        plant: Mapping[str, Any],
        samples: int,
        runs: int,
        seed: int,
        controller: Agent | None = None,
    ) -> Trajectory:
        """Run the controller on a batch of plants, as `ControllerSpec.run` does.

        A `UsageError` is raised if the controller raises an error, returns invalid actions, or
        does not fit the plants.
        """
        agent = controller or self.make(plant, runs, seed)
        with blame_user(f"{self.name}={self.locations[0]}", "run"):
            if isinstance(agent, PolicyAgent):
                with agent.opened(samples, **{**plant, **self.observation}) as plants:
                    return rollout(plants, agent, samples, seed)
            return super().run(plant, samples, runs, seed, agent)


@contextmanager
def blame_user(controller: str, step: str) -> Iterator[None]:
    """Turn an error in the block of a `with` statement into a `UsageError`.

    The message names the user's controller and ends with a traceback, except if a check of this
    project has raised a ValueError, for example for an action that is not finite.

    Parameters
    ----------
    controller
        The value of the option `--agent`, NAME=LOCATION.
    step
        What the block does with the controller: "loaded", "made" or "run".
    """
    try:
        yield
    except UsageError:
        raise
    except (Exception, SystemExit) as error:
        reason = f"{type(error).__name__}: {error}\n\n{traceback.format_exc()}"
        origin = Path(traceback.extract_tb(error.__traceback__)[-1].filename)
        is_ours = any(origin.is_relative_to(ROOT / folder) for folder in CODE_FOLDERS)
        if is_ours and isinstance(error, ValueError):
            reason = str(error)
        raise UsageError(f"--agent: {controller!r} cannot be {step}: {reason}") from error


def load_factory(location: str) -> Factory:
    """Return the factory at the location MODULE:FACTORY or ALGORITHM:FILE.zip.

    Raises
    ------
    ValueError
        If the module has no such factory, or if the factory cannot be called.
    """
    if location.endswith(".zip"):
        return _factory_of_zip(location)
    module_name, _, name = location.partition(":")
    module = importlib.import_module(module_name)
    try:
        factory = attrgetter(name)(module)
    except AttributeError as error:
        raise ValueError(f"the module {module_name!r} has no {name!r}") from error
    if not callable(factory):
        raise ValueError(f"{name!r} must be a function or a class, got {factory!r}")
    return factory  # type: ignore[no-any-return]


def _factory_of_zip(location: str) -> Factory:
    """Return a factory of the model of Stable-Baselines3 at ALGORITHM:FILE.zip.

    If `mptc_gym.sb3.save` wrote the file, the file describes the environment that the model
    acts in. Otherwise, the model acts in `MiddlePoint-v0` without wrappers.
    """
    import stable_baselines3  # imported here, as PyTorch takes seconds to load

    from mptc_gym.sb3 import load

    algorithm, _, file = location.partition(":")
    note = ""
    try:
        model: Any = load(file, device="cpu")
    except ValueError:  # The file is not one of `mptc_gym.sb3.save`.
        kind: Any = getattr(stable_baselines3, algorithm, None)
        kind = kind or pkgutil.resolve_name(f"sb3_contrib:{algorithm}")
        model = kind.load(file, device="cpu")
        note = f"{file} names no environment: run in the plain one, without wrappers."

    def factory() -> Any:
        return model

    # Texts for the report, as a user's factory can have them.
    weights = sum(weight.numel() for weight in model.policy.parameters())
    samples = f"{model.num_timesteps / 1e6:.3g} M samples a policy"
    factory.searched = f"{weights:,} weights: {samples}"  # type: ignore[attr-defined]
    if note:
        factory.note = note  # type: ignore[attr-defined]
    return factory


def observation_of(factory: Factory) -> Mapping[str, int]:
    """Return how many samples of each signal the policies of a factory observe.

    The keys are arguments of the environment, such as "error_window". The default of the
    factory's attribute `observation` is the observation of the paper.

    Raises
    ------
    ValueError
        If `observation` is not a dict of such arguments.
    """
    observation = getattr(factory, "observation", PAPER_WINDOWS)
    if not isinstance(observation, Mapping) or not set(observation) <= set(WINDOWS):
        allowed = ", ".join(WINDOWS)
        raise ValueError(
            f"observation must be a dict with keys out of {allowed}, got {observation!r}"
        )
    return observation


def make_controller(*, factory: Factory, **prior_knowledge: Any) -> Agent:
    """Call a user's factory, and return the controller that the factory makes.

    `prior_knowledge` is what the controller may know about the plant, by name. The factory gets
    what its parameters name, or everything if it has `**kwargs`. A ValueError is raised if the
    factory needs another argument.
    """
    signature = inspect.signature(factory)
    parameters = signature.parameters
    takes_all = any(argument.kind is argument.VAR_KEYWORD for argument in parameters.values())
    arguments = {
        name: value
        for name, value in prior_knowledge.items()
        if takes_all or name in parameters
    }
    try:
        signature.bind(**arguments)
    except TypeError as error:
        raise ValueError(
            f"{error}: a factory gets only {', '.join(prior_knowledge)}, so each other "
            "parameter needs a default"
        ) from error
    product = factory(**arguments)
    if isinstance(product, tuple):
        policy, env = product
        return PolicyAgent(policy, env, prior_knowledge["num_envs"])
    if hasattr(product, "reset") and hasattr(product, "act"):
        return product  # type: ignore[no-any-return]
    return PolicyAgent(product, None, prior_knowledge["num_envs"])


@dataclass
class PolicyAgent:
    """A policy in any form that `mptc_gym.evaluate` takes, as a controller of the benchmarks.

    Attributes
    ----------
    policy
        The policy.
    env
        The environment that the policy acts in, or a function that makes an environment. None
        stands for the environment that was saved with a model of Stable-Baselines3, or for
        `MiddlePoint-v0` without wrappers if no environment was saved.
    runs : int
        Number of runs in a batch.
    """

    policy: Any
    env: Any
    runs: int

    def reset(self) -> None:
        """Prepare for a new episode."""
        self._act = start(self.policy, self.runs)

    def act(self, observation: Any) -> Any:
        """Return the actions for observations with a row for each run, shape (runs, 1)."""
        return self._act(observation)

    @contextmanager
    def opened(self, samples: int, **arguments: Any) -> Iterator[Any]:
        """Yield a vector environment of `runs` plants with the wrappers that the policy needs.

        Episodes have `samples` samples, and `arguments` are the arguments of the environment
        that define the case. A ValueError is raised if the policy brings its own environment
        for another case, or if the policy does not fit the observations.
        """
        case = case_of(Parameters(**arguments))
        with self._open({**arguments, "max_episode_steps": samples}) as plants:
            if any(case_of(group.parameters) != case for group in plant_groups(plants)):
                raise ValueError("the environment must have the parameters of the case")
            check_fit(self.policy, plants)
            yield plants

    def _open(self, arguments: Mapping[str, Any]) -> AbstractContextManager[Any]:
        """Return a context with a vector environment of `runs` plants.

        `arguments` are the keyword arguments of `gymnasium.make` for the case, which an
        environment that the policy brings does not need.
        """
        if self.env is not None:
            return opened(self.env, self.runs, self.policy)
        if not hasattr(self.policy, "get_env") or self.policy.get_env() is None:
            return opened(IDS["paper"], self.runs, self.policy, **arguments)
        from mptc_gym.sb3 import spec_of

        # A saved model has the windows and wrappers of its training.
        without_windows = {name: arguments[name] for name in arguments if name not in WINDOWS}
        spec = spec_of(self.policy, **without_windows)
        return opened(spec, self.runs, self.policy)
