"""Watching a controller: films and windows show the run that is asked for."""

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pygame
import pytest
from PIL import Image

from agents import PIController
from benchmarks.watch import command as watch
from benchmarks.watch.__main__ import main
from mptc_gym import MiddlePointEnv, drawing

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
    assert main([*arguments, "--video", str(path)]) == 0
    assert [each.name for each in path.parent.iterdir()] == ["film.gif"]
    assert path.stat().st_size < 200_000
    with Image.open(path) as film:
        assert film.info["duration"] == 100  # ms; 10 pictures a second, of each fifth sample
        assert film.info["loop"] == 0
    shown = list(pictures(path))
    assert len(shown) == SAMPLES / 2 / 5

    env = MiddlePointEnv(noise_variance=0.5, render_mode="rgb_array")
    controller = PIController()
    observation, info = env.reset(seed=7)
    errors = []
    width, height = watch.SHOWN
    for k in range(SAMPLES):
        if k % 5 == 0:
            half, i = divmod(k, SAMPLES // 2)
            top = watch.CAPTION + half * (height + watch.CAPTION)
            picture = Image.fromarray(env.render()).resize((width, height))
            assert np.abs(shown[i // 5][top : top + height] - picture).mean() < 3
        observation, _, _, _, info = env.step(controller.act(observation))
        errors.append(abs(info["error"]))
    assert f"mean absolute error {np.mean(errors):.3f} °C" in capsys.readouterr().out


def test_where_there_is_no_screen_it_says_so_and_writes_a_film(tmp_path, capsys):
    assert main(["--agent", "smith", "--scenario", "constant"]) == 0  # of the driver "dummy"
    assert (tmp_path / "results" / "watch" / "smith-constant.gif").is_file()
    assert "There is no screen" in capsys.readouterr().out


def test_interrupted(tmp_path, monkeypatch, capsys):
    (tmp_path / "film.gif").write_bytes(b"earlier")
    monkeypatch.setattr(watch, "rollout", Mock(side_effect=KeyboardInterrupt))
    assert main(["--video", "film.gif"]) == 130
    assert "Interrupted" in capsys.readouterr().out
    assert [each.read_bytes() for each in tmp_path.iterdir()] == [b"earlier"]


@pytest.mark.parametrize("closed_at", [4, None])
def test_a_window_shows_the_run_until_it_is_closed(monkeypatch, capsys, closed_at):
    monkeypatch.setattr(watch, "_has_screen", lambda: True)
    drawn, show = [], drawing.show

    def shown(record, fps):
        show(record, fps)
        drawn.append(fps)
        if len(drawn) - 1 == closed_at:
            pygame.event.post(pygame.event.Event(pygame.QUIT))

    monkeypatch.setattr(drawing, "show", shown)
    assert main(["--speed", "1000"]) == 0
    assert not pygame.display.get_init()
    assert ("The window was closed." in capsys.readouterr().out) == (closed_at is not None)
    assert drawn[1:] == [1000] * (SAMPLES if closed_at is None else closed_at)
