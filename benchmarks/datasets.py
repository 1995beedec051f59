"""Write offline data sets of plants under controllers: `python -m benchmarks.datasets`."""

import os
import shutil
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from benchmarks.lib.command import Count, Names, Parameter, command, options
from benchmarks.lib.errors import UnfinishedError
from benchmarks.lib.seeds import SEEDS
from benchmarks.lib.storage import out_folder
from mptc_gym import PRESETS, evaluate
from mptc_gym.scoring.rollout import rollout

SAMPLES = 1200  # in an episode
EPISODES = 100  # in a data set
SEED = SEEDS["data sets"].first  # of the first episode
EVALUATIONS = 50  # episodes to evaluate learners on, none of which is in the data
# Names of the controllers of a data set, which take turns, episode by episode.
BEHAVIOURS = {
    "pi": ("pi",),
    "smith": ("smith",),
    "mixed": ("pi", "pi-simc", "smith", "nn"),
}
# A data set gets a new version when its content changes. In v1 the Smith predictor has another
# anti-windup than in v0, and the Smith predictor and PI (SIMC) are tuned to an Ms of 1.6.
VERSIONS = {"pi": 0, "smith": 1, "mixed": 1}
IDS = {
    f"middlepoint/{plant}/{behaviour}-v{VERSIONS[behaviour]}": (plant, behaviour)
    for plant in ("paper", "disturbed", "fouling")
    for behaviour in BEHAVIOURS
}
VARIABLE = "MINARI_DATASETS_PATH"  # the environment variable with Minari's folder
HOME = "~/.minari/datasets"  # Minari's folder if this variable is not set


@dataclass(frozen=True)
class Episode:
    """A logged episode of N samples."""

    controller: str
    seed: int
    observations: NDArray[np.float32]  # shape (N + 1, size)
    actions: NDArray[np.float32]  # within [-1, 1], shape (N, 1)
    rewards: NDArray[np.float64]  # -|e(k+1)|, degC, shape (N,)


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Write offline data sets to Minari's folder.

    Each includes the least possible error of its plant.
    """

    ids: Annotated[Names, Parameter(choices=IDS)] = field(default=(), kw_only=False)
    """Data sets to write (default: all)."""
    episodes: Count = EPISODES
    """Episodes per data set, of 1,200 transitions each."""


def work(options: Options) -> str:
    """Write data sets, and print the mean errors of each."""
    root = out_folder(Path(os.environ.get(VARIABLE) or HOME).expanduser().absolute(), VARIABLE)
    for name in dict.fromkeys(options.ids or IDS):
        print(f"{name}: {write(root, name, options.episodes)}", flush=True)
    return f"The data sets are in {root}"


def arguments_of(plant: str) -> dict[str, Any]:
    """Return the arguments of the environment that a plant's data sets come from."""
    return {
        **PRESETS[plant],
        "setpoint": "random",
        "reward": "absolute",  # with this scale, -|e|
        "error_scale": 1.0,
        "action_window": 20,  # which makes the problem Markov while the set point holds
    }


def record(plant: str, behaviour: str, episodes: int = EPISODES) -> list[Episode]:
    """Return episodes of a plant under the controllers of one of `BEHAVIOURS`.

    The controllers take turns. Episode i has the seed `SEED + i`.
    """
    names = BEHAVIOURS[behaviour][:episodes]
    recorded: list[Episode] = []
    for turn, name in enumerate(names):
        seeds = list(range(SEED + turn, SEED + episodes, len(names)))
        recorded += _record_controller(plant, name, seeds)
    return sorted(recorded, key=lambda episode: episode.seed)


def _record_controller(plant: str, name: str, seeds: list[int]) -> list[Episode]:
    """Return one episode of a plant under a controller for each seed, all run side by side."""
    from benchmarks.controllers.roster import ROSTER
    from benchmarks.loop.rollout import make_plants

    arguments = arguments_of(plant)
    controller: Any = ROSTER[name].in_service(arguments, len(seeds), SEED)
    controller.reset()
    actions: list[NDArray[np.float32]] = []  # of each sample, shape (episodes, 1)

    def act(observations: Any) -> NDArray[np.float32]:
        # Beyond +-1 the actuator saturates: clipping does not change what the plant does.
        actions.append(np.clip(controller.act(observations), -1.0, 1.0).astype(np.float32))
        return actions[-1]

    plants = make_plants(len(seeds), SAMPLES, **arguments)
    samples = list(rollout(plants, act, SAMPLES, seeds))
    observations_of_all = np.stack([sample.observations for sample in samples], axis=1)
    actions_of_all = np.stack(actions, axis=1)
    rewards_of_all = -np.abs([sample.infos["error"] for sample in samples[1:]]).T
    return [
        Episode(name, seed, observations_of_all[i], actions_of_all[i], rewards_of_all[i])
        for i, seed in enumerate(seeds)
    ]


def write(root: Path, name: str, episodes: int) -> str:
    """Write a complete data set or none, replacing the data set of this id.

    `root` is Minari's folder. The mean errors are returned as text. An `UnfinishedError` is
    raised if the files cannot be written.
    """
    place = root / name
    logged = record(*IDS[name], episodes)
    try:
        # Minari does not list the contents of hidden folders.
        with tempfile.TemporaryDirectory(prefix=".partial-", dir=root) as partial:
            # HDF5 crashes where a disk is full. So a file as large as a data set is written
            # before, and removed.
            room = Path(partial, "room")
            room.write_bytes(bytes(1_000_000 + episodes * 250_000))
            room.unlink()
            os.environ[VARIABLE] = partial  # Minari takes no folder as an argument
            errors = _create(name, logged)
            shutil.rmtree(place, ignore_errors=True)
            place.parent.mkdir(parents=True, exist_ok=True)
            Path(partial, name).replace(place)
    except OSError as fault:
        raise UnfinishedError(f"{place} could not be written: {fault}") from fault
    finally:
        os.environ[VARIABLE] = str(root)
    return errors


def _create(name: str, episodes: list[Episode]) -> str:
    """Write a data set to Minari's folder, and return its mean errors as text."""
    import minari
    from minari.data_collector import EpisodeBuffer

    plant, behaviour = IDS[name]
    arguments = arguments_of(plant)
    idle = evaluate(
        lambda observations: np.zeros((len(observations), 1)), episodes=EVALUATIONS, **arguments
    )
    least_error = float(np.asarray(idle.least).mean())
    mean_error = float(-np.mean([episode.rewards for episode in episodes]))
    buffers = [
        EpisodeBuffer(
            seed=episode.seed,
            observations=episode.observations,
            actions=episode.actions,
            rewards=episode.rewards,
            terminations=[False] * SAMPLES,
            truncations=[*[False] * (SAMPLES - 1), True],
        )
        for episode in episodes
    ]
    env = gymnasium.make("MiddlePoint-v0", max_episode_steps=SAMPLES, **arguments)
    dataset = minari.create_dataset_from_buffers(
        name,
        buffers,
        env=env,
        eval_env=env,
        algorithm_name=", ".join(BEHAVIOURS[behaviour]),
        author="The mptc_gym developers",
        author_email="",  # Minari warns of None, here and in the next argument.
        code_permalink="",
        description=f"Preset {plant} with random set points. The reward is -|error| in degC.",
        ref_min_score=-idle.mean_error * SAMPLES,
        ref_max_score=-least_error * SAMPLES,
        num_episodes_average_score=EVALUATIONS,
        data_format="hdf5",
    )
    metadata = {
        "behaviour_error": mean_error,
        "least_possible_error": least_error,
        "idle_error": idle.mean_error,
        "evaluation_seeds": list(idle.seeds),
    }
    controllers = [{"controller": episode.controller} for episode in episodes]
    dataset.storage.update_metadata(metadata)
    dataset.storage.update_episode_metadata(controllers)
    return (
        f"mean |e| {mean_error:.3f} °C, least possible {least_error:.3f}, "
        f"idle valve {idle.mean_error:.3f}"
    )


main = command("datasets", Options, work)

if __name__ == "__main__":
    raise SystemExit(main(None))
