"""Write data sets as the options say, and list them."""

from __future__ import annotations

import os
import shutil
import tempfile
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import pandas as pd
from rich.console import Console

import mptc_gym
from benchmarks.datasets.__main__ import BEHAVIOURS, IDS, SAMPLES, Options
from benchmarks.datasets.history import History, arguments_of, record, scale
from benchmarks.lib.command import UsageError, out_folder
from benchmarks.lib.tables import on_screen
from mptc_gym import Evaluation

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
    console.print(on_screen(pd.DataFrame(rows)))
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
