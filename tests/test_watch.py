"""Watching a controller: films and windows show the run that is asked for."""

from dataclasses import replace

import numpy as np
import pygame
import pytest
from moviepy import VideoFileClip
from PIL import Image

from agents import PIController
from benchmarks import watch
from benchmarks.train import ppo
from mptc_gym import MiddlePointEnv, drawing
from tests.conftest import run
from tests.small_training import SMALL

SAMPLES = 40


@pytest.fixture(autouse=True)
def short(monkeypatch, tmp_path):
    """Make the scenarios short, and keep what is written out of the checkout."""
    made = {name: replace(each, samples=SAMPLES) for name, each in watch.SCENARIOS.items()}
    monkeypatch.setattr(watch, "SCENARIOS", made)
    monkeypatch.chdir(tmp_path)


def pictures(path):
    with Image.open(path) as film:
        for i in range(film.n_frames):
            film.seek(i)
            yield np.array(film.convert("RGB")).astype(int)


def test_a_gif_shows_the_run(tmp_path, capsys):
    path = tmp_path / "new" / "film.gif"
    arguments = ["--agent", "pi", "--scenario", "square-noise", "--seed", "7", "--speed", "50"]
    assert watch.main([*arguments, "--video", str(path)]) == 0
    assert [each.name for each in path.parent.iterdir()] == ["film.gif"]
    assert path.stat().st_size < 200_000
    with Image.open(path) as film:
        assert film.size == drawing.SIZE
        assert film.info["duration"] == 100  # ms; 10 pictures a second, of each fifth sample
        assert film.info["loop"] == 0
    shown = list(pictures(path))
    assert len(shown) == SAMPLES / 5

    env, controller = (
        MiddlePointEnv(noise_variance=0.5, render_mode="rgb_array"),
        PIController(),
    )
    observation, info = env.reset(seed=7)
    errors = []
    for k in range(SAMPLES):
        if k % 5 == 0:
            assert np.abs(shown[k // 5] - env.render()).mean() < 0.5  # it has fewer colours
        errors.append(abs(info["error"]))
        observation, _, _, _, info = env.step(controller.act(observation))
    assert f"mean absolute error {np.mean(errors):.3f} °C" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("speed", "pictures", "fps"), [(10, 40, 10), (30, 40, 30), (75, 14, 25)]
)
def test_an_mp4_has_the_speed_asked_for(speed, pictures, fps, tmp_path):
    path = tmp_path / "film.mp4"
    assert watch.main(["--speed", str(speed), "--video", str(path)]) == 0
    with VideoFileClip(str(path)) as clip:
        assert clip.size == list(drawing.SIZE)
        assert (round(clip.duration * clip.fps), clip.fps) == (pictures, fps)


def test_where_there_is_no_screen_it_says_so_and_writes_a_film(tmp_path, capsys):
    assert (
        watch.main(["--agent", "smith", "--scenario", "constant"]) == 0
    )  # of the driver "dummy"
    assert (tmp_path / "results" / "watch" / "smith-constant.mp4").is_file()
    assert "There is no screen" in capsys.readouterr().out


@pytest.fixture
def screen(monkeypatch):
    """Offer a screen, and count what is drawn on it."""
    monkeypatch.setattr(watch, "_has_screen", lambda: True)
    drawn = []
    show = drawing.show

    def counted(record, fps):
        show(record, fps)
        drawn.append((record.samples[-1], fps))

    monkeypatch.setattr(drawing, "show", counted)
    return drawn


def test_a_window_shows_the_run(screen, tmp_path):
    arguments = ["--agent", "pi", "--scenario", "constant-noise", "--seed", "3"]
    assert watch.main([*arguments, "--speed", "500"]) == 0
    noise = {"noise_variance": 0.5, "setpoint": 5.0}
    # The first 18 outputs are those of noise alone.
    outputs = run(MiddlePointEnv(**noise), np.zeros(18), seed=3)["output"]
    assert [sample[1] for sample, _ in screen[:19]] == list(outputs)
    assert len(screen) == SAMPLES + 1
    assert [fps for _, fps in screen[1:]] == [500] * SAMPLES
    assert not pygame.display.get_init()
    assert not list(tmp_path.iterdir())


def test_closing_the_window_ends_it(screen, monkeypatch):
    show = drawing.show

    def closed_at_the_fifth(record, fps):
        show(record, fps)
        if len(screen) == 5:
            pygame.event.post(pygame.event.Event(pygame.QUIT))

    monkeypatch.setattr(drawing, "show", closed_at_the_fifth)
    assert watch.main(["--speed", "500"]) == 0
    assert len(screen) == 5
    assert not pygame.display.get_init()


def test_interrupted(tmp_path, monkeypatch, capsys):
    def stop(*_):
        raise KeyboardInterrupt

    (tmp_path / "film.gif").write_bytes(b"earlier")
    monkeypatch.setattr(watch, "rollout", stop)
    assert watch.main(["--video", "film.gif"]) == 130
    assert "Interrupted" in capsys.readouterr().out
    assert [each.read_bytes() for each in tmp_path.iterdir()] == [b"earlier"]


def test_a_controller_of_one_s_own(capsys):
    assert watch.main(["--agent", "agents:PIController", "--video", "film.gif"]) == 0
    own = capsys.readouterr().out
    assert watch.main(["--agent", "pi", "--video", "other.gif"]) == 0
    assert own.split("error ")[1][:5] == capsys.readouterr().out.split("error ")[1][:5]


def test_a_policy(monkeypatch, capsys):
    monkeypatch.setattr(ppo, "PPOArguments", lambda: SMALL)
    assert watch.main(["--agent", "ppo", "--video", "film.gif"]) == 0
    assert "PPO on square wave" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("option", "value", "named"),
    [
        ("--agent", "lqr", "no 'lqr'; there are nothing, nn"),
        ("--agent", "agents:Nobody", "Nobody"),
        ("--scenario", "triangle", "constant-noise"),
        ("--video", "film.avi", ".mp4 or .gif"),
        ("--seed", "-1", "at least 0"),
        ("--speed", "0", "at least 1"),
    ],
)
def test_bad_options_are_named(option, value, named, capsys):
    with pytest.raises(SystemExit):
        watch.main([option, value])
    shown = capsys.readouterr().err
    assert option in shown
    assert named in shown
