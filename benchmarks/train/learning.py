"""Write learning curves: scores of policies over training samples, and of other controllers.

If the reference error of the plants is unknown, a mean error takes the place of a score.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from agents import PolicyNetwork
from benchmarks.controllers.roster import GROUPS, ROSTER
from benchmarks.lib.pictures import open_picture
from benchmarks.train.recipe import Recipe
from mptc_gym import evaluate
from mptc_gym.evaluation import VALIDATION_SEED

EPISODES = 20  # validation episodes of each score
# Matplotlib's line style for each controller with which policies are compared.
COMPARED = {"mpc": "-", "self-tuning": "--", "pi-simc": "-.", "nn": ":"}
LABELS = {
    "score": "score on validation episodes",
    "mean_error": "mean error on validation episodes (°C)",
}


def score(policy: Any, arguments: Mapping[str, Any]) -> dict[str, float | None]:
    """Return the mean error, degC, and the score of a policy, by the names of the columns.

    The score is None if the reference error is unknown. `arguments` are those of the
    environment.
    """
    result = evaluate(policy, episodes=EPISODES, seed=VALIDATION_SEED, **arguments)
    return {"mean_error": result.mean_error, "score": result.score}


def score_controller(name: str, recipe: Recipe) -> dict[str, float | None]:
    """Return the mean error, degC, and the score of a controller where policies are scored."""
    return score(*ROSTER[name].start(recipe.scored_on, EPISODES, VALIDATION_SEED))


def write(
    networks: Mapping[int, PolicyNetwork],
    others: Mapping[str, Mapping[str, float | None]],
    folder: Path,
) -> None:
    """Write the files `learning.csv` and `learning.png` to a folder.

    Parameters
    ----------
    networks
        Trained policies by the seed of the training run.
    others
        Mean error and score of other controllers, from `score_controller`, by name.
    folder
        Folder of the files.
    """
    runs = [
        pd.DataFrame(network.provenance["learning"]).assign(policy=f"seed {seed}")
        for seed, network in networks.items()
    ]
    # The rows of the other controllers have no number of samples.
    lines = pd.DataFrame([{"policy": name, **scores} for name, scores in others.items()])
    table = pd.concat([*runs, lines])[["policy", "samples", "mean_error", "score"]]
    table.to_csv(folder / "learning.csv", index=False)
    has_scores = bool(table["score"].notna().all())
    draw(table, "score" if has_scores else "mean_error", folder / "learning.png")


def draw(table: pd.DataFrame, column: str, path: Path) -> None:
    """Draw each training run, the median of the runs, and a line for each other controller.

    Parameters
    ----------
    table
        Table with the columns of the file `learning.csv`.
    column
        Column to draw: "score" or "mean_error".
    path
        The PNG file.
    """
    is_run = table["samples"].notna()
    curves = table[is_run].pivot(index="samples", columns="policy", values=column)
    curves.index /= 1e6
    median = curves.median(axis=1)
    lines = table[~is_run].set_index("policy")[column]
    title = (
        f"After {curves.index[-1]:.3g} M samples, the median {column.replace('_', ' ')} of the "
        f"training runs is {median.iloc[-1]:.3f}"
    )
    with open_picture(path, 4.0, title) as figure:
        axes = figure.subplots()
        colour = GROUPS[ROSTER["ppo"].group].colour
        axes.plot(curves, color=colour, linewidth=0.7, alpha=0.6)
        axes.plot(median, color=colour, linewidth=2.0, label="PPO, median")
        # Two controllers of a group have the same colour, but no two have the same dashes.
        for name, value in lines.items():
            spec = ROSTER[str(name)]
            colour = GROUPS[spec.group].colour
            axes.axhline(value, color=colour, linestyle=COMPARED[spec.name], label=spec.label)
        # What is far worse than the other controllers, as before the training, is not shown.
        shown = [*lines, median.iloc[-1]]
        margin = 0.2 * (max(shown) - min(shown))
        axes.set_ylim(min(shown) - margin, max(shown) + margin)
        axes.set_xlabel("training samples (millions)")
        axes.set_ylabel(LABELS[column])
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
