"""Pictures say what their data show, and show all of it."""

from contextlib import contextmanager

import numpy as np
import pandas as pd
import pytest
from matplotlib import rc_context
from matplotlib.figure import Figure

from benchmarks.compare import plots
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.pictures import STYLE
from benchmarks.lib.statistics import Estimate
from benchmarks.loop.scenarios import SCENARIOS


@pytest.fixture
def figures(monkeypatch):
    """Return the figures that are made, in place of files."""
    figures = []

    @contextmanager
    def open_picture(path, height, title):
        with rc_context(STYLE):
            figures.append(Figure())
            figures[-1].suptitle(title)
            yield figures[-1]

    monkeypatch.setattr(plots, "open_picture", open_picture)
    return figures


def plot_scores(values, path):
    """Draw the scores of controllers, by name, in the cases a and b or in the first alone."""
    rows = [
        {"scenario": case, "agent": agent, "scores": np.array([[score]])}
        for agent, scores in values.items()
        for case, score in zip("ab", scores, strict=False)
    ]
    means = {agent: Estimate(*[np.mean(scores)] * 3, 2) for agent, scores in values.items()}
    plots.plot_scores(means, pd.DataFrame(rows), ROSTER, path)


def test_scores_beyond_the_axis_stand_at_its_ends(figures, tmp_path):
    plot_scores({"mpc": [1.2, 0.9], "pi": [0.5, -3.0]}, tmp_path / "scores.png")
    (axes,) = figures[0].axes
    labels = axes.xaxis.get_ticklabels()
    assert [labels[i].get_text() for i in (0, -1)] == ["≤ 0", "≥ 0.999"]
    shown = np.concatenate([line.get_xdata() for line in axes.get_lines()])
    right, left = sorted(axes.get_xlim())
    assert ((right < shown) & (shown < left)).all()
    assert len(shown) == 2 * (2 + 1)


def test_the_picture_of_scores_says_which_cases_are_missing(figures, tmp_path):
    plot_scores({"mpc": [0.5, 0.5], "pi": [0.5]}, tmp_path / "scores.png")
    labels = [label.get_text() for label in figures[0].axes[0].get_yticklabels()]
    assert labels == ["MPC", "PI (1992)\n(1 of 2 cases)"]


def responses(agent, outputs, spread=0.0):
    """Return responses over 80 minutes."""
    seconds = 8.0 * np.arange(600)
    output = np.resize(outputs, 600).astype(float)
    return pd.DataFrame(
        {
            "agent": agent, "time_s": seconds, "setpoint": 5.0, "output_run": output,
            "output_median": 5.0, "output_p10": 5.0 - spread, "output_p90": 5.0 + spread,
            "applied_run": -10.0,
        }
    )  # fmt: skip


def test_the_first_run_is_shown_in_whole_and_as_a_temperature(figures, tmp_path):
    rows = pd.concat([responses("pi", [3.0, 7.0]), responses("smith", [5.0])])
    errors = pd.Series({"pi": 2.0, "smith": 1.0})
    case = SCENARIOS["constant"]
    plots.plot_responses(rows, errors, case, ROSTER, tmp_path / "constant.png")
    smith, _, pi, flow = figures[0].axes
    assert smith.get_title(loc="left") == "Smith: mean error 1.000 °C"
    colour, _ = ROSTER["pi"].look
    (run,) = [line for line in pi.get_lines() if line.get_color() == colour]
    np.testing.assert_array_equal(run.get_ydata()[-2:], [3.0, 7.0])
    low, high = pi.get_ylim()
    assert low < 3.0 < 7.0 < high
    assert flow.get_xlim() == (0.0, pytest.approx(599 * 8 / 60))
    assert flow.get_xlabel() == "time (min)"
    assert flow.get_lines()[-1].get_xdata()[-1] == pytest.approx(599 * 8 / 60)
    finding = "PI (1992) has 2.0 times the mean error of Smith"
    assert figures[0].get_suptitle().endswith(finding)
