"""Watching a controller: films and windows show the run that is asked for."""

from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pygame
import pytest
from gymnasium.utils.env_checker import data_equivalence
from PIL import Image
from scipy import signal

from agents import PIController
from benchmarks.watch import command as watch
from benchmarks.watch import game
from benchmarks.watch.__main__ import main
from mptc_gym import PRESETS, MiddlePointEnv, drawing
from tests.conftest import run, run_closed

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
            picture = Image.fromarray(env.render()[watch.HEADER :]).resize((width, height))
            assert np.abs(shown[i // 5][top : top + height] - picture).mean() < 3
        observation, _, _, _, info = env.step(controller.act(observation))
        errors.append(abs(info["error"]))
    assert f"mean absolute error {np.mean(errors):.3f} °C" in capsys.readouterr().out


def test_where_there_is_no_screen_it_says_so_and_writes_a_film(tmp_path, capsys):
    assert main(["--agent", "smith", "--scenario", "constant"]) == 0  # of the driver "dummy"
    assert (tmp_path / "results" / "watch" / "smith-constant.gif").is_file()
    assert "There is no screen" in capsys.readouterr().out


@pytest.fixture
def window(monkeypatch):
    """Return a function that watches on a screen, and returns what was drawn.

    After picture k it does what it is given as {k: function}.
    """
    monkeypatch.setattr(watch, "_has_screen", lambda: True)

    def watched(*arguments, moves=None, speed=1000):
        drawn, show = [], drawing.show

        def shown(record, fps):
            show(record, fps)
            drawn.append((record.samples[-1], fps))
            (moves or {}).get(len(drawn) - 1, lambda: None)()

        monkeypatch.setattr(drawing, "show", shown)
        assert main([*arguments, "--speed", str(speed)]) == 0
        assert not pygame.display.get_init()
        return drawn

    return watched


def test_interrupted(tmp_path, monkeypatch, capsys):
    (tmp_path / "film.gif").write_bytes(b"earlier")
    monkeypatch.setattr(game, "rollout", Mock(side_effect=KeyboardInterrupt))
    assert main(["--video", "film.gif"]) == 130
    assert "Interrupted" in capsys.readouterr().out
    assert [each.read_bytes() for each in tmp_path.iterdir()] == [b"earlier"]


def post(kind, **about):
    pygame.event.post(pygame.event.Event(kind, **about))


def press(key, unicode=""):
    post(pygame.KEYDOWN, key=key, unicode=unicode, mod=0)


def test_closing_the_window_ends_it(window):
    assert len(window(moves={4: lambda: post(pygame.QUIT)})) == 5


# A bound takes seconds, and is tested where it is made.
@pytest.fixture
def quick_bound(monkeypatch):
    bound = Mock(return_value=SimpleNamespace(value=0.123))
    monkeypatch.setattr(game, "least_possible", bound)
    return bound


def window_point(flow):
    # The lower chart: 12 t/h is 1 at its top, pixel 346, and -12.4 t/h at its bottom, 496.
    return 400, round(421 - flow * 75 / 12.4)


def test_your_hands_are_on_the_valve(window, quick_bound, capsys):
    screen = window(
        *("--agent", "you"),
        moves={
            3: lambda: [press(pygame.K_UP) for _ in range(12)],
            10: lambda: post(pygame.MOUSEBUTTONDOWN, button=1, pos=window_point(-8.0)),
            15: lambda: post(
                pygame.MOUSEMOTION, buttons=(1, 0, 0), pos=window_point(9.0), rel=(0, 0)
            ),
            20: lambda: post(pygame.MOUSEBUTTONDOWN, button=1, pos=(400, 100)),  # no flow
            25: lambda: press(pygame.K_HOME),
            30: lambda: press(pygame.K_DOWN),
        },
    )
    commands = [sample[2] for sample, _ in screen[1:]]
    assert commands[:3] == [0.0] * 3
    assert commands[3:10] == pytest.approx([6.0] * 7, abs=1e-6)
    assert commands[10:15] == pytest.approx([-8.0] * 5, abs=0.1)  # a pixel is 0.17 t/h
    assert commands[15:25] == pytest.approx([9.0] * 10, abs=0.1)
    assert commands[25:30] == [0.0] * 5
    assert commands[30:] == pytest.approx([-0.5] * 10, abs=1e-6)

    shown = capsys.readouterr().out
    errors = [abs(sample[0] - sample[1]) for sample, _ in screen[1:]]
    applied = [sample[3] for sample, _ in screen]
    mine = next(line for line in shown.splitlines() if line.split()[:1] == ["you"])
    travel = np.abs(np.diff(applied)).sum()
    assert mine.split()[1:] == [f"{np.mean(errors):.3f}", f"{travel:.0f}"]
    # Beside the controllers, on the same plant, and the bound.
    errors = np.abs(run_closed(MiddlePointEnv(), PIController(), SAMPLES)["error"][1:])
    (pi,) = (line for line in shown.splitlines() if "PI (1992)" in line)
    assert pi.split()[2] == f"{np.mean(errors):.3f}"
    assert "0.123" in shown
    assert "you on square wave" in shown
    assert "setpoint" not in quick_bound.call_args.kwargs


def test_keys_move_set_point_and_load_under_any_controller(window, quick_bound, capsys):
    screen = window(
        *("--agent", "pi", "--scenario", "constant"),
        moves={
            5: lambda: [press(pygame.K_PAGEUP), press(pygame.K_PAGEUP)],
            12: lambda: press(pygame.K_PAGEDOWN),
        },
    )
    setpoints = [sample[0] for sample, _ in screen]
    assert setpoints == [5.0] * 6 + [7.0] * 7 + [6.0] * (SAMPLES - 12)
    # The controller saw it: it does what it does on a plant with these set points.
    own = run_closed(MiddlePointEnv(setpoint=setpoints), PIController(), SAMPLES)["output"]
    assert [sample[1] for sample, _ in screen] == pytest.approx(own, abs=1e-5)
    assert quick_bound.call_args.kwargs["setpoint"] == setpoints
    assert "Smith" in capsys.readouterr().out


def test_a_load_step_shows_as_in_the_plant_s_equation(window, quick_bound, capsys, tmp_path):
    pressed = {4: lambda: [press(pygame.K_l), press(pygame.K_l), press(pygame.K_k)]}
    given = ("--agent", "nothing", "--scenario", "constant-noise", "--seed", "3")
    screen = window(*given, moves=pressed)
    untouched = run(MiddlePointEnv(noise_variance=0.5), np.zeros(SAMPLES), seed=3)["output"]
    added = np.array([sample[1] for sample, _ in screen]) - untouched
    a = [1.0, -0.45181, -0.47546]  # (28): w adds A(1) w to the right-hand side
    load = np.r_[np.zeros(5), np.ones(SAMPLES - 4)]
    assert added == pytest.approx(signal.lfilter([sum(a)], a, load), abs=1e-9)
    quick_bound.assert_not_called()  # there is no bound for a load by hand
    assert "least possible" not in capsys.readouterr().out
    assert not list(tmp_path.iterdir())  # no film


def test_speed_pause_and_escape(window, monkeypatch):
    waited = []

    def wait(milliseconds):
        waited.append(milliseconds)
        if len(waited) == 5:
            press(pygame.K_SPACE)

    monkeypatch.setattr(pygame.time, "wait", wait)
    moves = {
        2: lambda: press(pygame.K_PLUS, "+"),
        4: lambda: press(pygame.K_MINUS, "-"),
        6: lambda: press(pygame.K_SPACE),
        9: lambda: press(pygame.K_ESCAPE),
    }
    screen = window("--agent", "you", moves=moves, speed=400)
    assert [fps for _, fps in screen[1:7]] == [400, 400, 800, 800, 400, 400]
    assert len(waited) == 5  # it stood still, and went on
    assert len(screen) == 10


@pytest.mark.parametrize("preset", ["disturbed", "hard"])
def test_a_plant_is_itself_until_it_is_disturbed(preset, rng):
    # From sample 5 on it has 2 degC more, against an environment whose own set point changes.
    windows = {"setpoint_window": 2, "error_window": 4, "output_window": 3, "action_window": 1}
    arguments = {**PRESETS[preset], **windows}
    plant = MiddlePointEnv(**{**arguments, "setpoint": 1.0})
    other = MiddlePointEnv(**{**arguments, "setpoint": [1.0] * 6 + [3.0]})
    plant.reset(seed=3), other.reset(seed=3)
    for k, action in enumerate(rng.uniform(-1, 1, (40, 1))):
        plant.disturb(setpoint=2.0 if k >= 5 else 0.0)
        assert data_equivalence(plant.step(action), other.step(action), exact=True)
