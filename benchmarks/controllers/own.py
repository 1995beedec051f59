"""Load and run a user's own controllers.

A *factory* is a user's function or class that returns a policy. The page
`benchmarks/compare/README.md` describes the arguments and the result of a factory. A user's
code is loaded in the task that runs the controller, so that an error in the code does not stop
other tasks.
"""

import importlib
import inspect
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

from agents.controller import PAPER_WINDOWS
from agents.networks import WINDOWS
from benchmarks.controllers.spec import ControllerSpec
from benchmarks.lib.command import CommandError
from benchmarks.lib.outputs import ROOT
from benchmarks.loop.rollout import Agent, Trajectory, make_plants, rollout
from mptc_gym.rollout import start

Factory = Callable[..., Any]
CODE_FOLDERS = "mptc_gym", "agents", "benchmarks"  # folders with code of this project
# Optional attributes of a factory, texts for the report: the prior knowledge of the controller,
# the training of the controller, and a remark.
TEXTS = "knows", "searched", "note"


@dataclass(frozen=True, kw_only=True)
class OwnController(ControllerSpec):
    """A user's own controller, whose exceptions are reported as a `CommandError`.

    Attributes
    ----------
    locations : sequence of str
        Locations of the user's factories, in the form MODULE:FACTORY.
    """

    locations: Sequence[str]

    def members(self) -> list[ControllerSpec]:
        """Load the user's factories, and return a `ControllerSpec` for each factory.

        A `CommandError` is raised if a user's factory cannot be loaded.
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
        """Return a controller for a batch of `runs` runs, as `ControllerSpec.make` does.

        A `CommandError` is raised if the user's factory cannot be called or raises an error.
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

        A `CommandError` is raised if the user's controller raises an error, returns invalid
        actions, or does not fit the plants.
        """
        agent = controller or self.make(plant, runs, seed)
        with blame_user(f"{self.name}={self.locations[0]}", "run"):
            if isinstance(agent, PolicyAgent):
                plant = {**plant, **self.observation, **agent.interface}
                return rollout(make_plants(runs, samples, **plant), agent, samples, seed)
            return super().run(plant, samples, runs, seed, agent)


@contextmanager
def blame_user(controller: str, step: str) -> Iterator[None]:
    """Turn an exception in the block of a `with` statement into a `CommandError`.

    The message of the `CommandError` names the user's controller and ends with a traceback. The
    traceback is left out if code of this project has raised a ValueError, for example because
    an action is not finite.

    Parameters
    ----------
    controller
        Value of the option `--agent`, in the form NAME=LOCATION.
    step
        What failed, for the message: "loaded", "made" or "run".
    """
    try:
        yield
    except CommandError:
        raise
    except (Exception, SystemExit) as error:
        reason = f"{type(error).__name__}: {error}\n\n{traceback.format_exc()}"
        origin = Path(traceback.extract_tb(error.__traceback__)[-1].filename)
        is_ours = any(origin.is_relative_to(ROOT / folder) for folder in CODE_FOLDERS)
        if is_ours and isinstance(error, ValueError):
            reason = str(error)
        raise CommandError(f"--agent: {controller!r} cannot be {step}: {reason}") from error


def load_factory(location: str) -> Factory:
    """Return the user's factory at the location MODULE:FACTORY.

    Raises
    ------
    ValueError
        If the module MODULE has no attribute FACTORY, or if FACTORY is not callable.
    """
    module_name, _, name = location.partition(":")
    module = importlib.import_module(module_name)
    try:
        factory = attrgetter(name)(module)
    except AttributeError as error:
        raise ValueError(f"the module {module_name!r} has no {name!r}") from error
    if not callable(factory):
        raise ValueError(f"{name!r} must be a function or a class, got {factory!r}")
    return factory  # type: ignore[no-any-return]


def observation_of(factory: Factory) -> Mapping[str, int]:
    """Return how many samples of each signal the policies of a factory observe.

    The keys of the result are arguments of the environment, such as "error_window". If the
    factory has no attribute `observation`, the policies observe as many samples of each signal
    as the controllers of the paper.

    Raises
    ------
    ValueError
        If the attribute `observation` of the factory is not a dict, or if a key of the dict is
        not in `WINDOWS`.
    """
    observation = getattr(factory, "observation", PAPER_WINDOWS)
    if not isinstance(observation, Mapping) or not set(observation) <= set(WINDOWS):
        allowed = ", ".join(WINDOWS)
        raise ValueError(
            f"the attribute observation must be a dict with keys from {allowed}, "
            f"got {observation!r}"
        )
    return observation


def make_controller(*, factory: Factory, **prior_knowledge: Any) -> Agent:
    """Call a user's factory, and return the controller that the factory makes.

    `prior_knowledge` has the quantities of the plant that the controller may know, by name. A
    factory gets the quantities that are named in its signature, or all quantities if the
    signature has `**kwargs`. A ValueError is raised if the factory needs an argument that is
    not in `prior_knowledge`.
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
        policy, interface = product
        return PolicyAgent(policy, prior_knowledge["num_envs"], interface)
    if hasattr(product, "reset") and hasattr(product, "act"):
        return product  # type: ignore[no-any-return]
    return PolicyAgent(product, prior_knowledge["num_envs"])


@dataclass
class PolicyAgent:
    """A controller of `runs` runs that uses a policy in any form that `evaluate` accepts."""

    policy: Any
    runs: int
    # Arguments of the environment in which the policy acts, such as `action_window`, by name.
    interface: Mapping[str, Any] = field(default_factory=dict)

    def reset(self) -> None:
        """Prepare for a new episode."""
        self._act = start(self.policy, self.runs)

    def act(self, observation: Any) -> Any:
        """Return the actions for an observation with a row for each run, shape (runs, 1)."""
        return self._act(observation)
