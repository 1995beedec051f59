"""Films of a controller show the run that is asked for, as the environment draws it."""

from collections import deque
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from PIL import Image

from agents import PIController
from benchmarks import watch
from benchmarks.controllers.roster import ROSTER
from benchmarks.watch import main

SAMPLES = 60


@pytest.fixture(autouse=True)
def short(monkeypatch, tmp_path):
    """Make the cases short, and keep what is written out of the checkout."""
    cases = {name: replace(case, samples=SAMPLES) for name, case in watch.SCENARIOS.items()}
    monkeypatch.setattr(watch, "SCENARIOS", cases)
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    ("given", "arguments", "samples", "folder"),
    [
        (
            "--scenario constant-noise",
            {"setpoint": 5.0, "noise_variance": 0.5},
            SAMPLES,
            "results/watch",
        ),
        (
            "--set setpoint_period=400 --set dead_zone=[2,4] --video new/film.gif",
            {"setpoint_period": 400, "dead_zone": [2, 4]},
            1200,
            "new",
        ),
    ],
)
def test_a_film_shows_what_the_environment_draws(
    given, arguments, samples, folder, tmp_path, monkeypatch, capsys
):
    frames = []

    def record_frames(*run, make=watch.frames):
        for picture in make(*run):
            frames.append(np.asarray(picture))
            yield picture

    monkeypatch.setattr(watch, "frames", record_frames)
    assert main(["--agent", "pi", "--seed", "3", *given.split()]) == 0
    env = gymnasium.make("MiddlePoint-v0", render_mode="rgb_array", **arguments)
    observation, _ = env.reset(seed=3)
    controller = PIController()
    errors, pictures = [], []
    record = env.unwrapped._record
    record.span = samples  # The film shows the whole run.
    record.samples = deque(record.samples)
    for k in range(samples):
        observation, _, _, _, info = env.step(controller.act(observation))
        errors.append(abs(info["error"]))
        if (k + 2) % watch.SAMPLES_PER_FRAME == 0:
            pictures.append(env.render())
    np.testing.assert_array_equal(frames, pictures)
    mean = f"the mean error of PI (1992) is {np.mean(errors):.3f} °C"
    assert mean in capsys.readouterr().out
    (file,) = (tmp_path / folder).iterdir()
    with Image.open(file) as film:
        assert film.n_frames == len(pictures)
        film.seek(len(pictures) - 1)
        last = np.asarray(film.convert("RGB")).astype(float)
    # The file has fewer colours than the pictures, but the last one is the last one in it.
    distances = [np.abs(last - picture).mean() for picture in pictures]
    assert np.argmin(distances) == len(pictures) - 1


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
    monkeypatch.setattr(type(ROSTER["nn"]), "run", None)
    assert "--video: " in refused(main, ["--video", "/proc/x.gif"])
