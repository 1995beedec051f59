"""Record offline data sets of controlled plants: `python -m benchmarks.datasets`."""

from dataclasses import dataclass, field
from typing import Annotated, Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from benchmarks.lib.command import CommandError, Count, Names, Parameter, command, options
from benchmarks.lib.seeds import SEEDS
from mptc_gym import PRESETS, evaluate
from mptc_gym.rollout import rollout

SAMPLES = 1200  # number of samples in an episode
EPISODES = 100  # default number of episodes in a data set
SEED = SEEDS["data sets"].start  # seed of the first episode of each data set
# Number of episodes on which learners are evaluated; no data set has one of these episodes.
EVALUATION_EPISODES = 50
# For each behaviour, the controllers that control the plant in a data set. Several controllers
# take turns: each of n controllers controls every n-th episode.
BEHAVIOURS = {
    "pi": ("pi",),
    "smith": ("smith",),
    "mixed": ("pi", "pi-simc", "smith", "nn"),
}
# Version of the data sets of each behaviour, which rises when the content changes. Since
# version 1, the Smith predictor has another anti-windup, and the Smith predictor and the PI
# controller `pi-simc` are tuned to an Ms (largest magnitude of the sensitivity function) of
# 1.6.
VERSIONS = {"pi": 0, "smith": 1, "mixed": 1}
# Preset and behaviour of each data set, by the data set's id.
IDS = {
    f"middlepoint/{preset}/{behaviour}-v{VERSIONS[behaviour]}": (preset, behaviour)
    for preset in ("paper", "disturbed", "fouling")
    for behaviour in BEHAVIOURS
}


@dataclass(frozen=True)
class Episode:
    """A recorded episode of N samples, in which a controller controls a plant."""

    controller: str  # name of the controller
    seed: int  # seed of the environment's reset
    observations: NDArray[np.float32]  # shape (N + 1, size)
    actions: NDArray[np.float32]  # within [-1, 1], shape (N, 1)
    rewards: NDArray[np.float64]  # -|e(k+1)|, degC, shape (N,)


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Write offline data sets to Minari's folder, with each plant's least possible error."""

    ids: Annotated[Names, Parameter(choices=IDS)] = field(default=(), kw_only=False)
    """Data sets to write (default: all)."""
    episodes: Count = EPISODES
    """Episodes per data set, of 1,200 transitions each."""


def work(options: Options) -> None:
    """Write data sets, and print the mean errors of each data set."""
    import minari

    ids = list(dict.fromkeys(options.ids or IDS))  # without repeated ids
    existing = [dataset_id for dataset_id in ids if dataset_id in minari.list_local_datasets()]
    if existing:
        listed = " ".join(existing)
        raise CommandError(f"data sets exist; to remove them: minari delete {listed}")
    print("mean |e| (°C)                  data set  least possible  idle valve")
    for dataset_id in ids:
        errors = write(dataset_id, options.episodes)
        print(f"{dataset_id:<31}{errors[0]:8.3f}{errors[1]:16.3f}{errors[2]:12.3f}", flush=True)


def arguments_of(preset: str) -> dict[str, Any]:
    """Return the environment's arguments for the data sets of a preset."""
    return {
        **PRESETS[preset],
        "setpoint": "random",
        "reward": "absolute",  # with `error_scale`, the reward is -|e|, degC
        "error_scale": 1.0,
        # The observation holds more past actions than the delay in samples, and so determines
        # the next output apart from noise, load and drift.
        "action_window": 20,
    }


def record(preset: str, behaviour: str, episodes: int = EPISODES) -> list[Episode]:
    """Return recorded episodes of a preset's plant, with the controllers of a behaviour.

    The controllers in `BEHAVIOURS[behaviour]` take turns. Episode i of the list that `record`
    returns has the seed `SEED + i`.
    """
    controllers = BEHAVIOURS[behaviour][:episodes]
    recorded: list[Episode] = []
    for turn, controller in enumerate(controllers):
        seeds = list(range(SEED + turn, SEED + episodes, len(controllers)))
        recorded += _record_controller(preset, controller, seeds)
    return sorted(recorded, key=lambda episode: episode.seed)


def _record_controller(preset: str, controller_name: str, seeds: list[int]) -> list[Episode]:
    """Return recorded episodes, one for each seed, of a controller with a preset's plant."""
    from benchmarks.controllers.roster import ROSTER
    from benchmarks.loop.runs import make_plants

    arguments = arguments_of(preset)
    controller: Any = ROSTER[controller_name].in_service(arguments, len(seeds), SEED)
    controller.reset()
    actions: list[NDArray[np.float32]] = []  # actions of each sample, shape (episodes, 1)

    def act(observations: Any) -> NDArray[np.float32]:
        """Return the controller's actions, clipped to [-1, 1], and record the actions."""
        # Clipping does not change the plant's output, as the actuator saturates at -1 and 1.
        actions.append(np.clip(controller.act(observations), -1.0, 1.0).astype(np.float32))
        return actions[-1]

    plants = make_plants(len(seeds), SAMPLES, **arguments)
    samples = list(rollout(plants, act, SAMPLES, seeds))
    observations = np.stack([sample.observations for sample in samples])
    errors = np.array([sample.infos["error"] for sample in samples[1:]])
    rewards = -np.abs(errors)
    actions_of_all = np.stack(actions)
    # The first axis of each array is the sample, and the second axis is the episode.
    return [
        Episode(controller_name, seed, observations[:, i], actions_of_all[:, i], rewards[:, i])
        for i, seed in enumerate(seeds)
    ]


def write(dataset_id: str, episodes: int) -> tuple[float, float, float]:
    """Record a data set, write it to Minari's folder, and return mean errors, degC.

    The returned errors are those of the data set, the least possible error, and the error of an
    idle valve.
    """
    import minari
    from minari.data_collector import EpisodeBuffer

    preset, behaviour = IDS[dataset_id]
    arguments = arguments_of(preset)
    recorded = record(preset, behaviour, episodes)
    idle = evaluate(
        lambda observations: np.zeros((len(observations), 1)),
        episodes=EVALUATION_EPISODES,
        **arguments,
    )
    assert idle.least_possible is not None  # the package has bounds of these plants
    mean_error = float(-np.mean([episode.rewards for episode in recorded]))
    buffers = [
        EpisodeBuffer(
            seed=episode.seed,
            observations=episode.observations,
            actions=episode.actions,
            rewards=episode.rewards,
            terminations=[False] * SAMPLES,
            truncations=[*[False] * (SAMPLES - 1), True],
        )
        for episode in recorded
    ]
    env = gymnasium.make("MiddlePoint-v0", max_episode_steps=SAMPLES, **arguments)
    dataset = minari.create_dataset_from_buffers(
        dataset_id,
        buffers,
        env=env,
        eval_env=env,
        algorithm_name=", ".join(BEHAVIOURS[behaviour]),
        author="The mptc_gym developers",
        author_email="",  # Minari warns if this argument or the next one is None
        code_permalink="",
        description=f"Preset {preset} with random set points. The reward is -|error| in degC.",
        ref_min_score=-idle.mean_error * SAMPLES,
        ref_max_score=-idle.least_possible * SAMPLES,
        num_episodes_average_score=EVALUATION_EPISODES,
        data_format="hdf5",
    )
    dataset.storage.update_metadata(
        {
            "behaviour_error": mean_error,
            "least_possible_error": idle.least_possible,
            "idle_error": idle.mean_error,
            "evaluation_seeds": list(idle.seeds),
        }
    )
    dataset.storage.update_episode_metadata(
        [{"controller": episode.controller} for episode in recorded]
    )
    return mean_error, idle.least_possible, idle.mean_error


main = command("datasets", Options, work)

if __name__ == "__main__":
    raise SystemExit(main())
