"""Films of a controller show the run that is asked for."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image

from agents import PIController
from benchmarks import watch
from benchmarks.controllers.roster import ROSTER, looks
from benchmarks.plots import film
from benchmarks.plots.film import equal_steps
from benchmarks.watch import main
from mptc_gym import MiddlePointEnv
from tests.conftest import run, trajectory

SAMPLES = 60


@pytest.fixture(autouse=True)
def short(monkeypatch, tmp_path):
    """Make the cases short, and keep what is written out of the checkout."""
    made = {name: replace(each, samples=SAMPLES) for name, each in watch.SCENARIOS.items()}
    monkeypatch.setattr(watch, "SCENARIOS", made)
    monkeypatch.setattr(film, "PICTURES", 4)
    monkeypatch.chdir(tmp_path)


def test_equal_steps_by_hand():
    levels = [0.0, 5.0, -5.0, 5.0, -5.0, 5.0, 5.0, -5.0]
    found = equal_steps(np.repeat(levels, [4, 6, 6, 6, 6, 3, 3, 5]))
    assert found == [(10, 16), (22, 28)]  # from 5 to -5 for 6 samples; the last is shorter
    assert equal_steps(np.repeat([5.0], 7)) == [(0, 7)]


@pytest.mark.parametrize(
    ("given", "plant", "steps", "written"),
    [
        (
            ["--set", "setpoint_period=400", "--scenario", "run", "--video", "new/film.gif"],
            {"setpoint_period": 400}, [(200, 400), (1000, 1200)], "new",
        ),
        # Without equal steps.
        (["--scenario", "constant"], {"setpoint": 5.0}, [(0, SAMPLES)], "results/watch"),
    ],
)  # fmt: skip
def test_a_film_shows_steps_side_by_side(given, plant, steps, written, tmp_path, capsys):
    assert main(["--agent", "pi", *given]) == 0
    (video,) = (tmp_path / written).iterdir()
    with Image.open(video) as pictures:
        assert pictures.n_frames == 1 + 4
        inked = {"pi": [], watch.REFERENCE.name: []}
        for i in range(pictures.n_frames):
            pictures.seek(i)
            pixels = np.array(pictures.convert("RGB"))[100:440].astype(float)
            for agent in inked:
                colour = np.array(to_rgb(looks([agent])[agent][0])) * 255.0
                inked[agent].append(np.abs(pixels - colour).max(axis=2) < 20)
    total = [pixels.sum() for pixels in inked["pi"]]
    # The first picture is the whole, as is the last; those between grow, and none is blank.
    assert total[0] == pytest.approx(total[-1], rel=0.02)
    assert 0 < total[1] < total[2] < total[3] < total[0]
    whole = inked["pi"][0]
    assert min(whole[:, :375].sum(), whole[:, 375:].sum()) > 0.3 * whole.sum()
    # The reference has its own colour; a run above it may hide the most of it.
    assert inked[watch.REFERENCE.name][0].sum() > 0
    # Errors are compared with the reference's on the same step.
    samples = steps[-1][1]
    ours = run(MiddlePointEnv(**plant), [PIController().act] * samples)["error"][1:]
    theirs = watch.REFERENCE.members()[0].run(plant, samples, 1, 0).next_error[:, 0]
    texts = []
    for start, stop in steps:
        ratio = np.abs(ours[start:stop]).mean() / np.abs(theirs[start:stop]).mean()
        when = f" at {start * 8 / 60:.0f} min" if len(steps) > 1 else ""
        texts.append(f"{100 * (ratio - 1):.0f} % larger{when}")
    finding = f"the error of PI (1992) is {' and '.join(texts)}."
    assert finding in capsys.readouterr().out


@pytest.mark.parametrize(
    ("agent", "errors", "finding"),
    [
        (
            "nn", (1.5, 0.9),
            "NN (1992) improves with practice: compared with neural Smith, its error is 50 % "
            "larger at 2 min and 10 % smaller at 6 min",
        ),
        (
            "nn", (1.0, 1.5),
            "Compared with neural Smith, the error of NN (1992) is equal at 2 min and 50 % "
            "larger at 6 min",
        ),
        # What does not learn has not improved with practice.
        (
            "pi", (1.5, 1.4),
            "Compared with neural Smith, the error of PI (1992) is 50 % larger at 2 min and "
            "40 % larger at 6 min",
        ),
    ],
)  # fmt: skip
def test_the_finding_by_hand(agent, errors, finding):
    levels = np.repeat([1.0, 0.0, 1.0, 0.0], 15)
    signals = []
    for of_steps in (errors, (-1.0, 1.0)):
        run_errors = np.repeat([9.0, of_steps[0], 9.0, of_steps[1]], 15)
        signals.append(trajectory(levels, levels - run_errors))
    made = film.Film(
        watch.SCENARIOS["square"],
        run=film.FilmedRun(ROSTER[agent], signals[0]),
        reference=film.FilmedRun(watch.REFERENCE, signals[1]),
        steps=[film.Step(15, 30), film.Step(45, 60)],  # 8 s a sample
        dead_zone=5.0,
        limits=(-10.0, 10.0),
    )
    assert made.finding == finding


def test_a_film_stays_in_its_folder_whatever_the_name_of_the_controller(tmp_path, monkeypatch):
    (tmp_path / "a/b").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "a/b")
    assert main(["--agent", "../../$x=agents:PIController", "--scenario", "constant"]) == 0
    (film,) = tmp_path.rglob("*.gif")
    assert film == tmp_path / "a/b/results/watch/_______x-constant.gif"


def test_a_plant_with_set_points_of_its_own_needs_no_scenario(monkeypatch, capsys):
    monkeypatch.setattr(watch, "write_film", lambda *_: None)
    assert main(["--agent", "pi", "--set", "setpoint=random"]) == 0
    assert "run.gif" in capsys.readouterr().out


def test_what_cannot_be_written_is_said_before_anything_is_run(refused, monkeypatch):
    monkeypatch.setattr(type(watch.REFERENCE), "run", None)
    assert "--video: " in refused(main, ["--video", "/proc/x.gif"])
