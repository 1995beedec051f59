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
from benchmarks.loop.scenarios import SCENARIOS, Scenario


def ticks(axis):
    return [tick.get_text() for tick in axis.get_ticklabels()]


class TestFindings:
    def test_of_scores(self):
        scores = {"MPC": 0.998, "Smith": 0.9971, "mine": 0.9, "PI (1992)": -0.0001}
        assert plots.scores_finding(scores) == (
            "MPC has the highest score (0.998), Smith the second highest (0.997), "
            "and PI (1992) the lowest (0.000)"
        )
        assert plots.scores_finding({"mine": 0.9}) == "mine has a score of 0.900"

    def test_of_responses(self):
        finding = plots.responses_finding({"MPC": 0.5, "NN (1992)": 1.0, "PI (1992)": 1.27})
        assert finding == "PI (1992) has 2.5 times the mean error of MPC"


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


def test_scores_beyond_the_axis_stand_at_its_ends(figures, tmp_path):
    values = {"mpc": [1.2, 0.9], "pi": [0.5, -3.0]}
    rows = [
        {"scenario": case, "agent": agent, "scores": np.array([[score]])}
        for agent, scores in values.items()
        for case, score in zip(["a", "b"], scores, strict=True)
    ]
    means = {agent: np.mean(scores) for agent, scores in values.items()}
    scores = {agent: Estimate(mean, mean, mean, 2) for agent, mean in means.items()}
    plots.plot_scores(scores, pd.DataFrame(rows), ROSTER, tmp_path / "scores.png")
    (axes,) = figures[0].axes
    labels = ticks(axes.xaxis)
    assert (labels[0], labels[-1]) == ("≤ -0.5", "≥ 0.999")
    shown = np.concatenate([line.get_xdata() for line in axes.get_lines()])
    right, left = sorted(axes.get_xlim())
    assert ((right < shown) & (shown < left)).all()
    assert len(shown) == 2 * (2 + 1)


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


class TestResponses:
    def test_the_first_run_is_shown_in_whole_and_as_a_temperature(self, figures, tmp_path):
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
        assert "2.0 times the mean error of Smith" in figures[0].get_suptitle()

    @pytest.mark.parametrize(
        ("spread", "plant", "texts"),
        [
            (0.0, {}, ["set point", "dead zone", "flow limits"]),
            (
                1.0, {"dead_zone": [3, 7]},
                [
                    "set point", "line: first run; band: 10th to 90th percentile",
                    "smallest dead zone", "flow limits",
                ],
            ),
            (
                0.0, {"setpoint": "random"},
                ["set point", "first run", "dead zone", "flow limits"],
            ),
        ],
    )  # fmt: skip
    def test_the_legend_names_what_is_there(self, spread, plant, texts, figures, tmp_path):
        rows = responses("pi", [5.0], spread)
        case = Scenario("case", "a case", 600, plant)
        errors = pd.Series({"pi": 1.0})
        plots.plot_responses(rows, errors, case, ROSTER, tmp_path / "case.png")
        (legend,) = figures[0].legends
        assert [text.get_text() for text in legend.get_texts()] == texts
