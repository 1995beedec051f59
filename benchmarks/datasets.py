"""Write offline data sets of plants under controllers: `python -m benchmarks.datasets`."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import gymnasium
import numpy as np
from cyclopts import Parameter

from benchmarks.lib.command import Count, Names, command, options
from benchmarks.lib.storage import UnfinishedError, UsageError, out_folder
from mptc_gym import PRESETS, Evaluation, __version__, evaluate

SAMPLES, EPISODES = 1200, 100  # per episode, and per data set
SEED = 9_000_000  # of the first episode; no comparison and no bound uses these seeds
EVALUATIONS = 50  # episodes to evaluate learners on; the data holds none of them
BEHAVIOURS = {
    "pi": ("pi",),
    "smith": ("smith",),
    "mixed": ("pi", "pi-simc", "smith", "nn"),  # controllers take turns, episode by episode
}
IDS = {
    f"middlepoint/{plant}/{behaviour}-v0": (plant, behaviour)
    for plant in ("paper", "disturbed", "fouling")
    for behaviour in BEHAVIOURS
}
VARIABLE = "MINARI_DATASETS_PATH"
DESCRIPTION = """\
Middle-point temperature of a once-through boiler, preset {plant!r}, random set points, under
{controllers}. The reward of a step is -|error| in degC. `mptc_gym.evaluate(policy,
dataset.env_spec, episodes=50)` scores a policy on the episodes of `evaluation_seeds`, where
`least_possible_error` is the least possible mean |error|, `idle_error` that without control."""


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
    ids = list(dict.fromkeys(options.ids or IDS))
    for name in ids:
        needed = len(BEHAVIOURS[IDS[name][1]])  # each controller needs one
        if options.episodes < needed:
            raise UsageError(
                f"--episodes: must be at least {needed} for {name}, got {options.episodes}"
            )
    root = _root()
    for name in ids:
        plant, behaviour = IDS[name]
        episodes, judged_by = record(plant, behaviour, options.episodes), scale(plant)
        error = write(root, name, episodes, judged_by)
        print(
            f"{name}: mean |e| {error:.3f} °C, least possible {judged_by.least_possible:.3f}, "
            f"no control {judged_by.mean_error:.3f}",
            flush=True,
        )
    return f"The data sets are in {root}"


def arguments_of(plant: str) -> dict[str, Any]:
    """Return the arguments of the environment that a plant's data sets come from."""
    # The past actions make the problem Markov while the set point holds. The reward is -|e|.
    logged = {"reward": "absolute", "error_scale": 1.0, "action_window": 20}
    return {**PRESETS[plant], "setpoint": "random", **logged}


def record(
    plant: str, behaviour: str, episodes: int = EPISODES, seed: int = SEED
) -> list[dict[str, Any]]:
    """Log a plant of `IDS` under the controllers of one of `BEHAVIOURS`, which take turns.

    Episode i is a dict of its `controller` and its `seed`, which is `seed + i`, and of arrays:
    `observations`, shape (SAMPLES + 1, size); `actions`, shape (SAMPLES, 1), within [-1, 1];
    and `rewards`, -|e(k+1)| in degC, shape (SAMPLES,).
    """
    from benchmarks.controllers.roster import ROSTER

    arguments, names = arguments_of(plant), BEHAVIOURS[behaviour]
    logged: list[dict[str, Any]] = [{}] * episodes
    for turn, name in enumerate(names):
        seeds = list(range(seed + turn, seed + episodes, len(names)))
        (factory,) = ROSTER[name].members()
        controller = factory.in_service(arguments, len(seeds), seed)
        columns = _log(controller, arguments, seeds)
        logged[turn :: len(names)] = [
            {"controller": name, "seed": each, **{key: columns[key][i] for key in columns}}
            for i, each in enumerate(seeds)
        ]
    return logged


def _log(controller: Any, arguments: dict[str, Any], seeds: list[int]) -> dict[str, Any]:
    """Return observations, actions and rewards of a batch of episodes."""
    plants: Any = gymnasium.make_vec(
        "MiddlePoint-v0", len(seeds), max_episode_steps=SAMPLES, **arguments
    )
    seen, _ = plants.reset(seed=seeds)
    observations, actions, errors = [seen], [], []
    controller.reset()
    for _ in range(SAMPLES):
        # Beyond +-1 the actuator saturates, so clipping does not change what the plant does.
        actions.append(np.clip(controller.act(seen), -1.0, 1.0).astype(np.float32))
        seen, _, _, _, info = plants.step(actions[-1])
        observations.append(seen)
        errors.append(info["error"])
    named: dict[str, Any] = {"observations": observations, "actions": actions}
    named["rewards"] = -np.abs(errors)
    return {name: np.stack(rows, axis=1) for name, rows in named.items()}


def scale(plant: str, episodes: int = EVALUATIONS) -> Evaluation:
    """Return the evaluation of no control, whose mean error scores 0, on fixed episodes."""
    arguments = arguments_of(plant)
    return evaluate(lambda seen: np.zeros((len(seen), 1)), episodes=episodes, **arguments)


def _root() -> Path:
    """Return the folder where Minari keeps data sets, without what killed runs have left."""
    try:
        given = Path(os.environ.get(VARIABLE) or Path.home() / ".minari" / "datasets")
    except RuntimeError as error:  # there is no HOME
        raise UsageError(f"{VARIABLE} must name a folder: {error}") from error
    root = out_folder(given.absolute(), VARIABLE)
    for left in root.glob(".partial-*"):
        if time.time() - left.stat().st_mtime > 600:  # s; no data set takes as long to write
            shutil.rmtree(left, ignore_errors=True)
    return root


def write(
    root: Path, name: str, episodes: list[dict[str, Any]], judged_by: Evaluation
) -> float:
    """Write a complete data set or none, replacing one of the same name.

    The name is its id, `namespace/name-v0`. Return the mean |e| of its episodes, degC.
    """
    place = root / name
    try:
        # Minari does not list the contents of hidden folders.
        with tempfile.TemporaryDirectory(prefix=".partial-", dir=root) as partial:
            # HDF5 crashes where a disk is full. So as much as a set takes is written before.
            room = Path(partial, "room")
            room.write_bytes(bytes(1_000_000 + len(episodes) * 250_000))
            room.unlink()
            os.environ[VARIABLE] = partial  # Minari takes no folder as an argument
            error = _create(name, episodes, judged_by)
            shutil.rmtree(place, ignore_errors=True)
            place.parent.mkdir(parents=True, exist_ok=True)
            Path(partial, name).replace(place)
    except OSError as fault:
        raise UnfinishedError(f"{place} could not be written: {fault}") from fault
    finally:
        os.environ[VARIABLE] = str(root)
    return error


def _create(name: str, episodes: list[dict[str, Any]], judged_by: Evaluation) -> float:
    import minari
    from minari.data_collector import EpisodeBuffer

    plant, least = IDS[name][0], np.asarray(judged_by.least)
    error = float(-np.mean([each["rewards"] for each in episodes]))
    logged = "seed", "observations", "actions", "rewards"
    ends = {"terminations": [False] * SAMPLES, "truncations": [*[False] * (SAMPLES - 1), True]}
    controllers = ", ".join(dict.fromkeys(each["controller"] for each in episodes))
    env = gymnasium.make("MiddlePoint-v0", max_episode_steps=SAMPLES, **arguments_of(plant))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # about missing metadata: an address
        dataset = minari.create_dataset_from_buffers(
            name,
            [EpisodeBuffer(**{key: each[key] for key in logged}, **ends) for each in episodes],
            env=env,
            eval_env=env,
            algorithm_name=controllers,
            author="The mptc_gym developers",
            description=DESCRIPTION.format(plant=plant, controllers=controllers),
            ref_min_score=-judged_by.mean_error * SAMPLES,
            ref_max_score=-float(least.mean()) * SAMPLES,
            num_episodes_average_score=len(judged_by.seeds),
            data_format="hdf5",
        )
    env.close()
    dataset.storage.update_metadata(
        {
            "behaviour_error": error,
            "least_possible_error": judged_by.least_possible,
            "least_possible_errors": least.tolist(),
            "idle_error": judged_by.mean_error,
            "idle_errors": judged_by.errors.tolist(),
            "evaluation_seeds": list(judged_by.seeds),
            "mptc_gym_version": __version__,
        }
    )
    dataset.storage.update_episode_metadata(
        [{"controller": each["controller"]} for each in episodes]
    )
    return error


main = command("datasets", Options, work)

if __name__ == "__main__":
    raise SystemExit(main(None))
