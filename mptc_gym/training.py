"""Record how a policy was trained, and compare the record with an environment."""

from __future__ import annotations

import dataclasses
import inspect
import json
import pkgutil
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec, WrapperSpec

from mptc_gym.checks import reject, shorten
from mptc_gym.env import MiddlePointEnv
from mptc_gym.parameters import Parameters
from mptc_gym.presets import IDS
from mptc_gym.vector_env import MiddlePointVectorEnv

WINDOWS: Final = "setpoint_window", "error_window", "output_window", "action_window"
MEMBER: Final = "mptc_gym.json"  # of a zip
LARGEST_MEMBER: Final = 2**29  # bytes, unpacked: far more than any policy here needs
VOUCH: Final = (
    "vouch for what it sees and does by a function, lambda observations: "
    "model.predict(observations, deterministic=True)[0]"
)
WAYS_OUT: Final = (
    "save it by mptc_gym.sb3.save and load it by mptc_gym.sb3.load; or load it with the "
    f"environment of its training, PPO.load(path, env=...); or {VOUCH}"
)
# They change neither observations nor actions; a policy that is trained sees no rewards.
_WATCHING: Final = {
    "gymnasium.wrappers.common:OrderEnforcing",
    "gymnasium.wrappers.common:PassiveEnvChecker",
    "gymnasium.wrappers.common:RecordEpisodeStatistics",
    "gymnasium.wrappers.common:TimeLimit",
    "gymnasium.wrappers.rendering:HumanRendering",
    "gymnasium.wrappers.rendering:RecordVideo",
    "gymnasium.wrappers.rendering:RenderCollection",
    "gymnasium.wrappers.stateful_reward:NormalizeReward",
    "gymnasium.wrappers.transform_reward:ClipReward",
    "gymnasium.wrappers.transform_reward:TransformReward",
    "stable_baselines3.common.monitor:Monitor",
}

Wrappers = tuple[WrapperSpec, ...]  # the innermost first


@dataclass(frozen=True)
class Training:
    """What stood between the plant and a policy while it was trained."""

    env: str
    """Id of the environment."""
    plant: str
    """Class of the environment, `module:name`."""
    arguments: Mapping[str, Any]
    """All arguments of the environment. Where plants differ in others than windows, those of
    the first."""
    max_episode_steps: int | None
    """Length of an episode, samples."""
    wrappers: Wrappers
    """Gymnasium's wrappers that act."""
    observations: str
    """Shape and type of an observation of one environment, before `vec_wrappers`."""
    actions: str
    """Action space of one environment."""
    vec_wrappers: tuple[Mapping[str, Any], ...] = ()
    """`VecFrameStack` and `VecNormalize` of Stable-Baselines3, with their numbers; the
    innermost first."""
    algorithm: str = ""
    """Class of the model, `module:name`."""
    n_envs: int = 1
    """Number of environments."""

    @classmethod
    def of(
        cls, core: Any, spec: EnvSpec | None, wrappers: Wrappers, outermost: Any
    ) -> Training:
        """Record an environment, or one out of a batch, from its core and what is around it.

        `outermost` has its spaces.
        """
        if not isinstance(core, MiddlePointEnv | MiddlePointVectorEnv):
            reject("policy", core, "trained on environments of this package")
        batch = type(core) is MiddlePointVectorEnv
        seen = outermost.observation_space
        return cls(
            env=spec.id if spec else IDS["paper"],
            plant=entry_point(MiddlePointEnv if batch else type(core)),
            arguments=dataclasses.asdict(core.parameters),
            max_episode_steps=spec.max_episode_steps if spec else None,
            wrappers=tuple(map(_complete, wrappers)),
            observations=f"{seen.shape} {seen.dtype}",
            actions=repr(outermost.action_space),
        )

    @property
    def windows(self) -> dict[str, int]:
        """The observation windows, by the environment's arguments."""
        return {name: self.arguments[name] for name in WINDOWS}

    def to_json(self) -> str:
        """Return the record as JSON; ValueError if it would not make the same environment."""
        if self.plant != entry_point(MiddlePointEnv):
            raise ValueError(
                f"policy was trained on {self.plant}, which cannot be recorded: put what it "
                "changes into a gymnasium.Wrapper"
            )
        try:
            return json.dumps(_packed(dataclasses.asdict(self)), indent=1)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"an argument of a wrapper cannot be recorded ({error}): write a wrapper whose "
                "arguments are numbers, texts, arrays or lists of these"
            ) from error

    @classmethod
    def read(cls, path: str | Path) -> Training:
        """Return the record in a zip. No code from the zip is run.

        Raises
        ------
        ValueError
            If the file cannot be read, or if it has no record.
        """
        path = zip_path(path)
        try:
            with zipfile.ZipFile(path) as archive:
                for member in archive.infolist():
                    if member.file_size > LARGEST_MEMBER:
                        raise ValueError(
                            f"{path} cannot be read: {member.filename} in it has "
                            f"{member.file_size:,} bytes, and {LARGEST_MEMBER:,} are allowed"
                        )
                text = archive.read(MEMBER) if MEMBER in archive.namelist() else None
        except OSError as error:
            raise ValueError(f"{path} cannot be read: {error.strerror}") from error
        except (zipfile.BadZipFile, zlib.error, RuntimeError) as error:
            raise ValueError(f"{path} must be a zip that Stable-Baselines3 saved") from error
        if text is None:
            raise ValueError(f"{path} does not say how its policy was trained: {WAYS_OUT}")
        try:
            about = json.loads(text, object_hook=_unpacked)
            about["wrappers"] = tuple(WrapperSpec(**each) for each in about["wrappers"])
            found = cls(**about)
            Parameters(**{**found.arguments, **found.windows})
        except (AttributeError, KeyError, TypeError, ValueError, RecursionError) as error:
            raise ValueError(
                f"{path} has a damaged record of its training, or that of another version: "
                f"{error!r}"
            ) from error
        return found

    def spec(self, env: str | EnvSpec, arguments: Mapping[str, Any]) -> EnvSpec:
        """Return the spec of an environment with the windows and wrappers of the training.

        Raises
        ------
        ValueError
            If there is no such environment, or if `arguments` name another window.
        """
        for name, value in self.windows.items():
            if arguments.get(name, value) != value:
                raise ValueError(
                    f"{name} must be that of policy's training, {value}, got {arguments[name]}"
                )
        if isinstance(env, EnvSpec):
            env = dataclasses.replace(env, additional_wrappers=())
        with closing(make_one(env, {**arguments, **self.windows})) as single:
            spec = single.spec
        assert spec is not None  # gymnasium.make sets it
        return dataclasses.replace(spec, additional_wrappers=self.wrappers)

    def check(self, env: gymnasium.Env[Any, Any]) -> None:
        """Refuse an environment other than that of the training with a ValueError.

        Its other arguments may differ, and with the set point the bounds of observations.
        """
        there = Training.of(env.unwrapped, env.spec, wrappers_of(env), env)
        way_out = f"take mptc_gym.sb3.spec_of(policy, {there.env!r})"
        if self.plant != there.plant:
            way_out = f"give a function that makes a {self.plant}"
        for what, own in self._compared().items():
            other = there._compared()[what]
            if own != other:
                raise ValueError(
                    f"env must have the {what} of policy's training, {_listed(own, other)}, "
                    f"got {_listed(other, own)}: {way_out}"
                )

    def _compared(self) -> dict[str, Mapping[str, Any]]:
        """Return what must be the same wherever the policy acts."""
        wrappers = enumerate(self.wrappers, 1)
        return {
            "class": {"env": self.plant},
            "windows": self.windows,
            "wrappers": {f"{i}. {w.entry_point}": _packed(w.kwargs) for i, w in wrappers},
            "observations": {"shape": self.observations},
            "action space": {"space": self.actions},
        }


def make_one(env: str | EnvSpec, arguments: Mapping[str, Any]) -> gymnasium.Env[Any, Any]:
    """Make an environment from an id or a spec; ValueError if it cannot be found."""
    try:
        for each in env.additional_wrappers if isinstance(env, EnvSpec) else ():
            pkgutil.resolve_name(each.entry_point)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"wrappers of env must be importable: {error}") from error
    try:
        return gymnasium.make(env, disable_env_checker=True, **arguments)
    except (gymnasium.error.UnregisteredEnv, ModuleNotFoundError):
        reject(
            "env", env, f"the id of an environment, such as one of {', '.join(IDS.values())}"
        )


def entry_point(kind: type) -> str:
    """Return `module:name` of a class, as Gymnasium writes it."""
    return f"{kind.__module__}:{kind.__name__}"


def wrappers_of(env: gymnasium.Env[Any, Any]) -> Wrappers:
    """Return the wrappers of an environment that act."""
    if env.spec is not None:
        return acting_wrappers(env.spec.additional_wrappers)
    found: Wrappers = ()
    while isinstance(env, gymnasium.Wrapper):
        found = (WrapperSpec(type(env).__name__, entry_point(type(env)), None), *found)
        env = env.env
    return acting_wrappers(found)


def acting_wrappers(wrappers: Iterable[WrapperSpec]) -> Wrappers:
    """Return the wrappers that change observations or actions."""
    return tuple(each for each in wrappers if each.entry_point not in _WATCHING)


def _complete(wrapper: WrapperSpec) -> WrapperSpec:
    """Return a wrapper with all its arguments; refuse one that hides some, or itself."""
    try:
        kind = pkgutil.resolve_name(wrapper.entry_point)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(
            f"the wrapper {wrapper.entry_point} must be at the top level of its module, where "
            f"it can be told from others of its name; or {VOUCH}"
        ) from error
    _, *arguments = inspect.signature(kind).parameters.values()
    catch_all = inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD
    known = wrapper.kwargs
    if arguments and (
        known is None
        or any(each.name not in known and each.kind not in catch_all for each in arguments)
    ):
        raise ValueError(
            f"the wrapper {wrapper.entry_point} does not record its arguments: let it inherit "
            "from gymnasium.utils.RecordConstructorArgs, give that all of them, and make the "
            f"environment inside it by gymnasium.make; or {VOUCH}"
        )
    return dataclasses.replace(wrapper, kwargs=known or {})


def _packed(value: Any) -> Any:
    """Return a value as JSON values, from which `_unpacked` makes it again."""
    match value:
        case np.ndarray():
            return {"array": value.tolist(), "dtype": str(value.dtype)}
        case np.generic():
            return value.item()
        case tuple():
            return {"tuple": _packed([*value])}
        case list():
            return [*map(_packed, value)]
        case dict():
            return {name: _packed(each) for name, each in value.items()}
    return value


def _unpacked(value: dict[str, Any]) -> Any:
    match value:
        case {"array": numbers, "dtype": dtype}:
            return np.array(numbers, dtype)
        case {"tuple": values}:
            return tuple(values)
    return value


def zip_path(path: str | Path) -> Path:
    """Return the path of a zip, whose ending may be left out, as in Stable-Baselines3."""
    path = Path(path)
    return path if path.suffix else path.with_suffix(".zip")


def _listed(named: Mapping[str, Any], other: Mapping[str, Any]) -> str:
    """Return what is not the same in another mapping as text."""
    differ = {name: value for name, value in named.items() if other.get(name) != value}
    return ", ".join(f"{name}={shorten(value)}" for name, value in differ.items()) or "none"
