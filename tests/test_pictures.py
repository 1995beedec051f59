"""Pictures say what their data show, and show all of it."""

from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from matplotlib import rc_context
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from benchmarks.compare import plots
from benchmarks.controllers.roster import GROUPS, ROSTER
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


def test_scores_stand_by_prior_knowledge_and_none_below_0(figures, tmp_path):
    values = {"mpc": [1.2, 0.9], "smith": [0.9, 0.7], "nn": [0.8, 0.6], "pi-simc": [0.5, -3.0]}
    plot_scores(values, tmp_path / "scores.png")
    title = "Best score by prior knowledge: plant 1.050, step test 0.800, simulator 0.700"
    assert figures[0].get_suptitle() == title
    (axes,) = figures[0].axes
    labels = [label.get_text() for label in axes.get_yticklabels()]
    assert labels == ["MPC", "Smith", "PI (SIMC)", "NN (1992)"]
    shown = np.concatenate([line.get_xdata() for line in axes.get_lines()])
    assert shown.min() == 0.0
    assert shown.max() == 1.2
    left, right = axes.get_xlim()
    assert left < 0.0
    assert right > 1.2
    open_markers = [line for line in axes.get_lines() if line.get_markerfacecolor() == "white"]
    assert [line.get_xdata().item() for line in open_markers] == [pytest.approx(0.7)]


def test_colours_of_groups_can_be_told_from_white_and_markers_from_each_other():
    for group in GROUPS.values():
        channels = np.array(to_rgb(group.colour))
        linear = np.where(
            channels <= 0.04, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4
        )
        luminance = np.dot([0.2126, 0.7152, 0.0722], linear)
        assert 1.05 / (luminance + 0.05) >= 3.0, group  # contrast by WCAG 2
    assert len({group.marker for group in GROUPS.values()}) == len(GROUPS)


def test_the_picture_of_scores_says_which_cases_are_missing(figures, tmp_path):
    plot_scores({"mpc": [0.5, 0.5], "pi": [0.5]}, tmp_path / "scores.png")
    labels = [label.get_text() for label in figures[0].axes[0].get_yticklabels()]
    assert labels == ["MPC", "PI (1992) (1 of 2 cases)"]


def test_of_many_controllers_case_pictures_show_a_few():
    names = [
        "mpc",
        "self-tuning",
        "dahlin",
        "ppo",
        "smith",
        "pi-searched",
        "pi",
        "ppo-hard",
        "nn",
    ]
    own = replace(ROSTER["pi"], name="mine", group="own")
    errors = pd.Series({name: float(i) for i, name in enumerate([*names, "mine"])})
    shown = plots.pictured(errors, {**ROSTER, "mine": own})
    assert shown == ["nn", "pi", "self-tuning", "ppo", "mine"]
    few = plots.pictured(errors[names[:7]], ROSTER)
    assert few == ["pi", *names[:6]]


def responses(agent, outputs, spread=0.0):
    """Return responses over 80 minutes."""
    seconds = 8.0 * np.arange(600)
    output = np.resize(outputs, 600).astype(float)
    return pd.DataFrame(
        {
            "agent": agent, "time_s": seconds, "setpoint": 5.0, "output_run": output,
            "output_p10": 5.0 - spread, "output_p90": 5.0 + spread,
            "applied_run": -10.0,
        }
    )  # fmt: skip


def test_the_first_run_is_shown_in_whole_and_as_a_temperature(figures, tmp_path):
    rows = pd.concat([responses("pi", [3.0, 7.0]), responses("smith", [5.0])])
    errors = pd.Series({"pi": 2.0, "smith": 1.0})
    case = SCENARIOS["constant"]
    plots.plot_responses(rows, errors, case, ROSTER, tmp_path / "constant.png")
    pi, _, smith, flow = figures[0].axes
    assert smith.get_title(loc="left") == "Smith: mean error 1.000 °C"
    assert flow.get_title(loc="left") == "knows a step test of the plant"
    colour = GROUPS["paper's PI gains"].colour
    (run,) = [line for line in pi.get_lines() if line.get_color() == colour]
    np.testing.assert_array_equal(run.get_ydata()[-2:], [3.0, 7.0])
    low, high = pi.get_ylim()
    assert low < 3.0 < 7.0 < high
    assert flow.get_xlim() == (0.0, pytest.approx(599 * 8 / 60))
    assert flow.get_xlabel() == "time (min)"
    assert flow.get_lines()[-1].get_xdata()[-1] == pytest.approx(599 * 8 / 60)
    # Thick lines are the flow at each sample, in addition to thin jumps.
    held = [curve for curve in flow.collections if isinstance(curve, LineCollection)]
    assert [len(curve.get_segments()) for curve in held] == [599]
    finding = "PI (1992) has 2.0 times the mean error of Smith"
    assert figures[0].get_suptitle().endswith(finding)
