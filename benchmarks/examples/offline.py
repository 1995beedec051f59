"""Record a controller as a Minari data set, from which policies can be learnt offline.

    pip install -e ".[bench,data]"      # Minari needs Python 3.11
    python -m benchmarks.examples.offline smith disturbed

The second command records 100 episodes of the controller `smith` on the plant of the preset
`disturbed`, with random set points. It writes the data set `middlepoint/disturbed/smith-v0`,
which a program loads by `minari.load_dataset`, and prints the mean error of the controller and
the reference error.

The data set also has the infos of the environment, such as the temperature without measurement
noise. `dataset.recover_environment()` returns the environment; with the seed of an episode and
the recorded actions, it gives the recorded observations.

The reward is -|e| in degC, so the return of an episode is -1,200 times its mean error.
`minari.get_normalized_score` converts the return of a policy, averaged over the default
episodes of `mptc_gym.evaluate`, to the policy's score. No data set has these episodes.
"""

from typing import Annotated, Any, Literal

import cyclopts
import gymnasium
import minari
import numpy as np
from minari.data_collector import EpisodeBuffer

from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.seeds import SEEDS
from mptc_gym import PRESETS, evaluate
from mptc_gym.plant.parameters import EPISODE_STEPS
from mptc_gym.rollout import rollout

SEED = SEEDS["data sets"].start  # seed of the first episode; episode i has the seed SEED + i


def record(agent: Any, arguments: dict[str, Any], episodes: int) -> list[EpisodeBuffer]:
    """Return episodes of plants with these arguments, all controlled at once by `agent`."""
    actions = []  # of each sample, shape (episodes, 1)

    def act(observations: Any) -> Any:
        """Return the actions of the controller, clipped to [-1, 1], and keep them."""
        # The actuator saturates at -1 and 1, so clipping does not change what the plant does.
        actions.append(np.clip(agent.act(observations), -1.0, 1.0).astype(np.float32))
        return actions[-1]

    plants = gymnasium.make_vec("MiddlePoint-v0", episodes, **arguments)
    # The sample k = 0 follows no step, and so has no reward.
    samples = [*rollout(plants, act, EPISODE_STEPS, range(SEED, SEED + episodes))]
    return [
        EpisodeBuffer(
            seed=SEED + i,
            observations=[sample.observations[i] for sample in samples],
            actions=[row[i] for row in actions],
            rewards=[-abs(sample.infos["error"][i]) for sample in samples[1:]],
            terminations=[False] * EPISODE_STEPS,
            truncations=[sample.ended[i] for sample in samples[1:]],
            # The first sample also has what is drawn at the reset. A name with a "_" before it
            # has a mask of the plants that have the info: all have.
            infos={
                name: [sample.infos[name][i] for sample in samples]
                for name in samples[-1].infos
                if name[0] != "_"
            },
        )
        for i in range(episodes)
    ]


def main(
    controller: Annotated[str, cyclopts.Parameter(choices=ROSTER)],
    # The presets whose reference error with random set points is known.
    preset: Literal["paper", "disturbed", "fouling", "hard"],
    *,
    episodes: int = 100,
) -> None:
    """Write a data set of a controller on the plants of a preset, and print its mean error."""
    plant = {
        **PRESETS[preset],
        "setpoint": "random",
        "reward": "absolute",
        "error_scale": 1.0,  # so that the reward is -|e|, degC
        # More past actions than the longest delay in samples, so that an observation determines
        # the next output apart from noise, load and drift.
        "action_window": 30,
    }
    # Of PPO, the first of the five networks controls the plants.
    agent, arguments = ROSTER[controller].members()[0].start(plant, episodes, SEED)
    env = gymnasium.make("MiddlePoint-v0", **arguments)
    idle = evaluate(lambda observations: np.zeros((len(observations), 1)), env.spec)
    assert idle.reference is not None  # the package knows it for these presets
    dataset = minari.create_dataset_from_buffers(
        f"middlepoint/{preset}/{controller}-v0",
        record(agent, arguments, episodes),
        env=env,
        eval_env=env,
        algorithm_name=controller,
        author="",  # Minari warns if this argument or one of the next two is None
        author_email="",
        code_permalink="",
        description=f"Preset {preset} with random set points. The reward is -|error| in degC.",
        ref_min_score=-EPISODE_STEPS * idle.mean_error,
        ref_max_score=-EPISODE_STEPS * idle.reference,
    )
    error = -np.mean([episode.rewards for episode in dataset])
    print(f"{dataset.id}: mean error {error:.3f} (reference {idle.reference:.3f}) degC")


if __name__ == "__main__":
    cyclopts.run(main)
