"""Write offline data sets of plants under controllers: `python -m benchmarks.datasets`."""

import os
import shutil
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import gymnasium
import numpy as np

from benchmarks.lib.command import Count, Names, Parameter, command, options
from benchmarks.lib.storage import UnfinishedError, out_folder
from mptc_gym import PRESETS, evaluate

SAMPLES, EPISODES = 1200, 100  # per episode, and per data set
SEED = 9_000_000  # of the first episode; no comparison and no bound uses these seeds
EVALUATIONS = 50  # episodes to evaluate learners on; the data holds none of them
BEHAVIOURS = {
    "pi": ("pi",),
    "smith": ("smith",),
    "mixed": ("pi", "pi-simc", "smith", "nn"),  # controllers take turns, episode by episode
}
# A set gets a new version where what it records changes. Since v1 the Smith predictor has
# another anti-windup, and it and PI (SIMC) are tuned to an Ms of 1.6.
VERSIONS = {"pi": 0, "smith": 1, "mixed": 1}
IDS = {
    f"middlepoint/{plant}/{behaviour}-v{VERSIONS[behaviour]}": (plant, behaviour)
    for plant in ("paper", "disturbed", "fouling")
    for behaviour in BEHAVIOURS
}
COLUMNS = "controller", "seed", "observations", "actions", "rewards"  # of an episode
VARIABLE, HOME = "MINARI_DATASETS_PATH", "~/.minari/datasets"


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
    """Write data sets."""
    root = out_folder(Path(os.environ.get(VARIABLE) or HOME).expanduser().absolute(), VARIABLE)
    for name in dict.fromkeys(options.ids or IDS):
        print(f"{name}: {write(root, name, options.episodes)}", flush=True)
    return f"The data sets are in {root}"


def arguments_of(plant: str) -> dict[str, Any]:
    """Return the arguments of the environment that a plant's data sets come from."""
    # The past actions make the problem Markov while the set point holds. The reward is -|e|.
    logged = {"reward": "absolute", "error_scale": 1.0, "action_window": 20}
    return {**PRESETS[plant], "setpoint": "random", **logged}


def record(plant: str, behaviour: str, episodes: int = EPISODES) -> list[dict[str, Any]]:
    """Log a plant of `IDS` under the controllers of one of `BEHAVIOURS`, which take turns.

    Episode i is a dict of `COLUMNS`: its controller, its seed, which is `SEED + i`, and arrays
    of observations, actions within [-1, 1], and rewards, -|e(k+1)| in degC.
    """
    from benchmarks.controllers.roster import ROSTER
    from benchmarks.loop.rollout import make_plants

    arguments, names = arguments_of(plant), BEHAVIOURS[behaviour][:episodes]
    logged: list[dict[str, Any]] = [{}] * episodes
    for turn, name in enumerate(names):
        seeds = list(range(SEED + turn, SEED + episodes, len(names)))
        controller: Any = ROSTER[name].in_service(arguments, len(seeds), SEED)
        controller.reset()
        plants: Any = make_plants(len(seeds), SAMPLES, **arguments)
        seen, _ = plants.reset(seed=seeds)
        observations, actions, errors = [seen], [], []
        for _ in range(SAMPLES):
            # Beyond +-1 the actuator saturates: clipping does not change what the plant does.
            actions.append(np.clip(controller.act(seen), -1.0, 1.0).astype(np.float32))
            seen, _, _, _, info = plants.step(actions[-1])
            observations.append(seen)
            errors.append(info["error"])
        rewards: Any = -np.abs(errors)
        arrays = (np.stack(each, axis=1) for each in (observations, actions, rewards))
        rows = zip([name] * len(seeds), seeds, *arrays, strict=True)
        logged[turn :: len(names)] = [dict(zip(COLUMNS, row, strict=True)) for row in rows]
    return logged


def write(root: Path, name: str, episodes: int) -> str:
    """Write a complete data set or none, replacing that of this id; return its mean errors."""
    place, logged = root / name, record(*IDS[name], episodes)
    try:
        # Minari does not list the contents of hidden folders.
        with tempfile.TemporaryDirectory(prefix=".partial-", dir=root) as partial:
            # HDF5 crashes where a disk is full. So as much as a set takes is written before.
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


def _create(name: str, episodes: list[dict[str, Any]]) -> str:
    """Write a data set to Minari's folder, and return its mean errors."""
    import minari
    from minari.data_collector import EpisodeBuffer

    plant, behaviour = IDS[name]
    arguments, controllers = arguments_of(plant), ", ".join(BEHAVIOURS[behaviour])
    idle = evaluate(lambda seen: np.zeros((len(seen), 1)), episodes=EVALUATIONS, **arguments)
    least = float(np.asarray(idle.least).mean())
    error = float(-np.mean([each["rewards"] for each in episodes]))
    ends = {"terminations": [False] * SAMPLES, "truncations": [*[False] * (SAMPLES - 1), True]}
    env = gymnasium.make("MiddlePoint-v0", max_episode_steps=SAMPLES, **arguments)
    dataset = minari.create_dataset_from_buffers(
        name,
        [EpisodeBuffer(**{key: each[key] for key in COLUMNS[1:]}, **ends) for each in episodes],
        env=env,
        eval_env=env,
        algorithm_name=controllers,
        author="The mptc_gym developers",
        author_email="",  # None would be a warning, here and below
        code_permalink="",
        description=f"Preset {plant} with random set points. The reward is -|error| in degC.",
        ref_min_score=-idle.mean_error * SAMPLES,
        ref_max_score=-least * SAMPLES,
        num_episodes_average_score=EVALUATIONS,
        data_format="hdf5",
    )
    about = {
        "behaviour_error": error,
        "least_possible_error": least,
        "idle_error": idle.mean_error,
        "evaluation_seeds": list(idle.seeds),
    }
    dataset.storage.update_metadata(about)
    controllers_of = [{"controller": each["controller"]} for each in episodes]
    dataset.storage.update_episode_metadata(controllers_of)
    bounds = f"least possible {least:.3f}, no control {idle.mean_error:.3f}"
    return f"mean |e| {error:.3f} °C, {bounds}"


main = command("datasets", Options, work)

if __name__ == "__main__":
    raise SystemExit(main(None))
