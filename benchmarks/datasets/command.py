"""Record plants under controllers, as a log would, and write data sets of it."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
from numpy.typing import NDArray
from rich.console import Console

import mptc_gym
from benchmarks.controllers.roster import ROSTER
from benchmarks.datasets.__main__ import BEHAVIOURS, EPISODES, IDS, SAMPLES, Options
from benchmarks.lib.command import UsageError, out_folder
from benchmarks.lib.tables import ScreenTable
from benchmarks.loop.rollout import Agent, IdleValve, make_plants
from mptc_gym import PRESETS, Evaluation, Parameters, evaluate
from mptc_gym.policies import rollout

SEED = 9_000_000  # of the first episode; no comparison and no bound uses these seeds
EVALUATIONS = 50  # episodes to evaluate learners on; the data holds none of them

# The past actions make the problem Markov. The reward of a step is -|e| in degC.
ARGUMENTS = {
    "setpoint": "random",
    "reward": "absolute",
    "error_scale": 1.0,
    "action_window": 20,  # delay + 2
}
VARIABLE = "MINARI_DATASETS_PATH"
DESCRIPTION = (
    "Middle-point temperature of a once-through boiler, preset {plant!r}, random set points, "
    "under {controllers}. The reward of a step is -|error| in degC. On the episodes of the "
    "seeds `evaluation_seeds`, `least_possible_error` is the least possible mean |error| and "
    "`idle_error` that of an idle valve; `least_possible_errors` and `idle_errors` "
    "are those of each episode. `mptc_gym.evaluate(policy, dataset.env_spec, episodes=50)` "
    "scores a policy on them."
)


def execute(options: Options, console: Console) -> str:
    """Write data sets and list them."""
    ids = dict.fromkeys(options.ids or IDS)
    import minari  # noqa: F401 (here: the first thing that needs it, which not everyone has)

    root = Path(os.environ.setdefault(VARIABLE, str(Path.home() / ".minari" / "datasets")))
    out_folder(root, VARIABLE)
    for name in ids:
        needed = len(BEHAVIOURS[IDS[name][1]])  # each controller needs one
        if options.episodes < needed:
            raise UsageError(
                f"--episodes: must be at least {needed} for {name}, got {options.episodes}"
            )
    rows = []
    for name in ids:
        history, judged_by = record(*IDS[name], options.episodes), scale(IDS[name][0])
        write(root, name, history, judged_by)
        rows.append(
            {
                "data set": name,
                "transitions": f"{history.rewards.size:,}",
                "mean |e| (°C)": f"{history.error:.3f}",
                "least possible": f"{judged_by.least_possible:.3f}",
                "idle": f"{judged_by.mean_error:.3f}",
                "sha256": history.sha256[:16],
            }
        )
        console.print(f"{name} is written")
    console.print(ScreenTable(pd.DataFrame(rows)))
    return f"The data sets are in {root}"


def write(root: Path, name: str, history: History, judged_by: Evaluation) -> None:
    """Write a complete data set or none, replacing one of the same name.

    The name is its id, `namespace/name-v0`. Its metadata holds the scale of its scores.
    """
    # Minari does not list the contents of hidden folders.
    with tempfile.TemporaryDirectory(prefix=".partial-", dir=root) as partial:
        os.environ[VARIABLE] = partial  # Minari takes no folder as an argument
        try:
            _create(name, history, judged_by)
        finally:
            os.environ[VARIABLE] = str(root)
        place = root / name
        shutil.rmtree(place, ignore_errors=True)
        place.parent.mkdir(parents=True, exist_ok=True)
        (Path(partial) / name).replace(place)


def _create(name: str, history: History, judged_by: Evaluation) -> None:
    import minari
    from minari.data_collector import EpisodeBuffer

    assert judged_by.least is not None
    arguments = arguments_of(history.plant)
    env = gymnasium.make("MiddlePoint-v0", max_episode_steps=SAMPLES, **arguments)
    episodes = [
        EpisodeBuffer(
            seed=seed,
            observations=history.observations[i],
            actions=history.actions[i],
            rewards=history.rewards[i],
            terminations=[False] * SAMPLES,
            truncations=[False] * (SAMPLES - 1) + [True],
            infos={},
        )
        for i, seed in enumerate(history.seeds)
    ]
    controllers = ", ".join(dict.fromkeys(history.controllers))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # about missing metadata: an address
        dataset = minari.create_dataset_from_buffers(
            name,
            episodes,
            env=env,
            eval_env=env,
            algorithm_name=controllers,
            author="The mptc_gym developers",
            description=DESCRIPTION.format(plant=history.plant, controllers=controllers),
            ref_min_score=-judged_by.mean_error * SAMPLES,
            ref_max_score=-float(judged_by.least.mean()) * SAMPLES,
            num_episodes_average_score=len(judged_by.seeds),
            data_format="hdf5",
        )
    env.close()
    about: dict[str, Any] = {
        "sha256": history.sha256,
        "behaviour_error": history.error,
        "least_possible_error": judged_by.least_possible,
        "least_possible_errors": judged_by.least.tolist(),
        "idle_error": judged_by.mean_error,
        "idle_errors": judged_by.errors.tolist(),
        "evaluation_seeds": list(judged_by.seeds),
        "mptc_gym_version": mptc_gym.__version__,
    }
    dataset.storage.update_metadata(about)
    dataset.storage.update_episode_metadata(
        [{"controller": controller} for controller in history.controllers]
    )


@dataclass(frozen=True)
class History:
    """Episodes of one plant, each under one controller."""

    plant: str
    """A name in `PRESETS`."""
    controllers: list[str]
    """Name of the controller of each episode, in the order of `seeds`."""
    seeds: list[int]
    observations: NDArray[np.float32]
    """Shape (episodes, SAMPLES + 1, n_obs), from k = 0 on."""
    actions: NDArray[np.float32]
    """Shape (episodes, SAMPLES, 1), within [-1, 1]."""
    rewards: NDArray[np.float64]
    """-|e(k+1)|, degC, shape (episodes, SAMPLES)."""

    @property
    def error(self) -> float:
        """Mean |e| over k = 1 to SAMPLES, degC."""
        return float(-self.rewards.mean())

    @property
    def sha256(self) -> str:
        """Hash of all the data and of the environment's arguments."""
        about = [arguments_of(self.plant), self.controllers, self.seeds]
        digest = hashlib.sha256(json.dumps(about, sort_keys=True).encode())
        for array in (self.observations, self.actions, self.rewards):
            little = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
            digest.update(repr(array.shape).encode() + little.tobytes())
        return digest.hexdigest()


def arguments_of(plant: str) -> dict[str, Any]:
    """Return the arguments of the environment that a plant's data sets come from."""
    return {**PRESETS[plant], **ARGUMENTS}


def record(plant: str, behaviour: str, episodes: int = EPISODES, seed: int = SEED) -> History:
    """Log one of `PLANTS` under the controllers of one of `BEHAVIOURS`.

    The environment draws episode i with seed `seed + i`. Each controller needs at least one
    episode.
    """
    names, arguments = BEHAVIOURS[behaviour], arguments_of(plant)
    size = Parameters(**arguments).observation_size
    history = History(
        plant,
        [names[i % len(names)] for i in range(episodes)],
        [seed + i for i in range(episodes)],
        np.empty((episodes, SAMPLES + 1, size), np.float32),
        np.empty((episodes, SAMPLES, 1), np.float32),
        np.empty((episodes, SAMPLES)),
    )
    for j, name in enumerate(names):
        own = slice(j, episodes, len(names))
        seeds = history.seeds[own]
        (factory,) = ROSTER[name].members()
        controller = factory.in_service(arguments, len(seeds), seed)
        logged = _log(controller, arguments, seeds)
        history.observations[own], history.actions[own], history.rewards[own] = logged
    return history


def _log(controller: Agent, arguments: dict[str, Any], seeds: list[int]) -> tuple[Any, ...]:
    """Return the observations, actions and rewards of a batch of episodes; see `History`."""
    observations: list[NDArray[np.float32]] = []
    actions: list[NDArray[np.float32]] = []

    def act(observation: NDArray[np.float32]) -> NDArray[np.float32]:
        observations.append(observation)
        # Beyond +-1 the actuator saturates, so clipping does not change what the plant does.
        action = np.clip(controller.act(observation), -1.0, 1.0)
        actions.append(action.astype(np.float32))
        return actions[-1]

    # One more sample, for the final observation.
    plants = make_plants(len(seeds), SAMPLES + 1, **arguments)
    controller.reset()
    steps = rollout(plants, act, SAMPLES + 1, seeds)
    errors = [after["error"] for _, after, _ in steps]
    plants.close()
    return np.stack(observations, 1), np.stack(actions[:-1], 1), -np.abs(errors[:-1]).T


def scale(plant: str, episodes: int = EVALUATIONS) -> Evaluation:
    """Return the scale for offline learners: an idle valve evaluated on fixed episodes.

    Its `mean_error` scores 0 and its `least_possible` scores 1, as in `mptc_gym.evaluate` of
    any policy on the same environment.
    """
    return evaluate(IdleValve(), episodes=episodes, **arguments_of(plant))
