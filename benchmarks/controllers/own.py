"""Load and run a user's own controllers.

A *factory* is a user's function or class that returns a policy. The page
`benchmarks/compare/README.md` describes the arguments and the result of a factory. A user's
code is loaded in the task that runs the controller, so that an error in the code does not stop
other tasks.
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
# Optional attributes of a factory, texts for the report: the prior knowledge of the controller,
# the training of the controller, and a remark.
TEXTS = "knows", "searched", "note"


@dataclass(frozen=True, kw_only=True)
class OwnController(ControllerSpec):
    """A user's own controller, whose exceptions are reported as a `UsageError`.

    Attributes
    ----------
    locations : sequence of str
        Locations of the user's factories, in the form MODULE:FACTORY or ALGORITHM:FILE.zip.
    """

    locations: Sequence[str]

    def members(self) -> list[ControllerSpec]:
        """Load the user's factories, and return a `ControllerSpec` for each factory.

        A `UsageError` is raised if a user's factory cannot be loaded.
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

        A `UsageError` is raised if the user's factory cannot be called or raises an error.
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

        A `UsageError` is raised if the user's controller raises an error, returns invalid
        actions, or does not fit the plants.
        """
        agent = controller or self.make(plant, runs, seed)
        with blame_user(f"{self.name}={self.locations[0]}", "run"):
            if isinstance(agent, PolicyAgent):
                with agent.opened(samples, **{**plant, **self.observation}) as plants:
                    return rollout(plants, agent, samples, seed)
            return super().run(plant, samples, runs, seed, agent)


@contextmanager
def blame_user(controller: str, step: str) -> Iterator[None]:
    """Turn an exception in the block of a `with` statement into a `UsageError`.

    The message of the `UsageError` names the user's controller and ends with a traceback. The
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
    """Return the user's factory at the location MODULE:FACTORY or ALGORITHM:FILE.zip.

    Raises
    ------
    ValueError
        If the module MODULE has no attribute FACTORY, or if FACTORY is not callable.
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
    """Return a factory that returns the Stable-Baselines3 model at ALGORITHM:FILE.zip.

    A file that `mptc_gym.sb3.save` wrote describes the environment that the model acts in. If
    another function wrote the zip file, the model acts in `MiddlePoint-v0` without wrappers.
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

    # Some of the attributes in `TEXTS`, which the report prints.
    weights = sum(weight.numel() for weight in model.policy.parameters())
    samples = f"{model.num_timesteps / 1e6:.3g} M samples a policy"
    factory.searched = f"{weights:,} weights: {samples}"  # type: ignore[attr-defined]
    if note:
        factory.note = note  # type: ignore[attr-defined]
    return factory


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
        policy, env = product
        return PolicyAgent(policy, env, prior_knowledge["num_envs"])
    if hasattr(product, "reset") and hasattr(product, "act"):
        return product  # type: ignore[no-any-return]
    return PolicyAgent(product, None, prior_knowledge["num_envs"])


@dataclass
class PolicyAgent:
    """A controller that uses a policy in any form that `mptc_gym.evaluate` accepts.

    Attributes
    ----------
    policy
        The policy.
    env
        Environment that the policy acts in, or a function that makes the environment. If `env`
        is None, the policy acts in the environment that was saved with a Stable-Baselines3
        model, or in `MiddlePoint-v0` without wrappers if no environment was saved.
    runs : int
        Number of runs that the policy controls at once.
    """

    policy: Any
    env: Any
    runs: int

    def reset(self) -> None:
        """Prepare for a new episode."""
        self._act = start(self.policy, self.runs)

    def act(self, observation: Any) -> Any:
        """Return the actions for an observation with a row for each run, shape (runs, 1)."""
        return self._act(observation)

    @contextmanager
    def opened(self, samples: int, **arguments: Any) -> Iterator[Any]:
        """Yield a vector environment of `runs` plants with the wrappers that the policy needs.

        An episode has `samples` samples. `arguments` are arguments of `MiddlePoint-v0`, which
        define the plant and the set point. A ValueError is raised if the policy's own
        environment has a different plant or set point, or if the policy does not fit the
        observations.
        """
        case = case_of(Parameters(**arguments))
        with self._open({**arguments, "max_episode_steps": samples}) as plants:
            if any(case_of(group.parameters) != case for group in plant_groups(plants)):
                raise ValueError(
                    "the policy's environment must have the case's plant and set point"
                )
            check_fit(self.policy, plants)
            yield plants

    def _open(self, arguments: Mapping[str, Any]) -> AbstractContextManager[Any]:
        """Return a context manager of a vector environment with `runs` plants.

        `arguments` are keyword arguments of `gymnasium.make`. If `env` is not None, `arguments`
        are not used.
        """
        if self.env is not None:
            return opened(self.env, self.runs, self.policy)
        if not hasattr(self.policy, "get_env") or self.policy.get_env() is None:
            return opened(IDS["paper"], self.runs, self.policy, **arguments)
        from mptc_gym.sb3 import spec_of

        # The windows and the wrappers are those in which the saved model was trained.
        without_windows = {name: arguments[name] for name in arguments if name not in WINDOWS}
        spec = spec_of(self.policy, **without_windows)
        return opened(spec, self.runs, self.policy)
