"""Pictures: that they show what happens, in every mode, and change nothing about it."""

import pickle
import sys
from dataclasses import replace
from functools import partial
from unittest.mock import Mock, call

import gymnasium
import numpy as np
import pygame
import pytest
from gymnasium.error import DependencyNotInstalled, ResetNeeded
from gymnasium.utils.env_checker import data_equivalence
from hypothesis import given, settings
from hypothesis import strategies as st

import mptc_gym
from mptc_gym import MiddlePointEnv, MiddlePointVectorEnv, drawing
from mptc_gym.parameters import Parameters
from mptc_gym.record import Record
from mptc_gym.signals import Ranges
from tests.arguments import MODES, NOISY
from tests.conftest import native_and_sync

SHAPE = (540, 960, 3)
UP = np.ones(1, np.float32)
LEFT, TOP, WIDTH, HEIGHT = drawing.FLOWS


def record(*samples, setpoint=0.0, sampling_interval=8.0, **numbers):
    """Return a record of samples (y_d, y, u, u_a) of the paper's plant, or one unlike it."""
    paper = Ranges(Parameters()).given
    made = Record(replace(paper, **numbers), sampling_interval, setpoint)
    for sample in samples:
        made.add(*sample)
    return made


def rows(picture, colour, x):
    """Return where a colour is in a column, below the headings."""
    found = np.flatnonzero((picture[:, round(x)] == colour).all(axis=1))
    return found[(found > 40) & ((found < 280) | (found > 320))]


def column(k):
    """Return where sample k lies, as long as the picture has not begun to move."""
    return LEFT + k / 200 * WIDTH


def test_temperatures_are_where_they_are_and_the_set_point_shows_above_them():
    levels = (12.0,) * 60 + (0.0,) * 60 + (-12.0,) * 60
    picture = drawing.frame(record(*[(-12.0, level, 0.0, 0.0) for level in levels]))
    found = [rows(picture, drawing.TEMPERATURE, column(k)) for k in (30, 90, 150)]
    setpoint = rows(picture, drawing.SETPOINT, column(30.5)).mean()
    # From -12 - 5 % of the range to 12 + 5 %, in a panel of 214 pixels.
    height = 12 / 26.4 * drawing.TEMPERATURES[3]
    apart = np.diff([found[0].mean(), found[1].mean(), setpoint])
    assert apart == pytest.approx([height] * 2, abs=1)
    both = rows(picture, drawing.SETPOINT, column(150.5))
    assert both.mean() == setpoint  # in front of the temperature, which is seen behind it
    assert len(found[2]) == len(found[0]) - len(both) > 0


def test_flows_are_where_they_are_and_a_command_beyond_the_limit_is_in_the_panel():
    inside, beyond = (0.0, 0.0, 4.0, 0.0), (0.0, 0.0, 100.0, 10.0)
    picture = drawing.frame(record(*[inside] * 50, *[beyond] * 100))
    scale = HEIGHT / 24.8  # pixels per t/h: 12 % of the range above it and below
    zero, limit = (rows(picture, drawing.APPLIED, column(k + 0.5)).mean() for k in (25, 100))
    assert zero - limit == pytest.approx(10 * scale, abs=1)
    command = rows(picture, drawing.COMMAND, column(25.5)).mean()
    assert zero - command == pytest.approx(4 * scale, abs=1)
    assert TOP < rows(picture, drawing.COMMAND, column(100.5)).mean() < limit - 5
    # u(49) to u(50): the vertical line is at k = 50.
    heights = [len(rows(picture, drawing.COMMAND, column(k))) for k in (49, 50, 51)]
    assert np.greater(heights, 9).tolist() == [False, True, False]


@pytest.mark.parametrize(("k", "delay", "dead_zone", "u_max"), [
    (10, 18, 0.0, 10.0), (60, 18, 2.0, 10.0), (60, 40, 8.0, 10.0), (300, 0, 4.0, 5.0),
])  # fmt: skip
def test_dead_zone_limits_and_what_is_in_transit_are_marked(k, delay, dead_zone, u_max):
    still = [(0.0,) * 4] * k
    picture = drawing.frame(record(*still, delay=delay, dead_zone=dead_zone, u_max=u_max))
    scale = HEIGHT / (1.24 * (10.0 + u_max))
    marks = rows(picture, drawing.LIMIT, 300)
    marks = marks[(marks > TOP) & (marks < TOP + HEIGHT)]
    assert np.ptp(marks) == pytest.approx((10.0 + u_max) * scale, abs=1)
    if k < 200:  # no curve is drawn at the right edge yet
        shaded = (picture[TOP:, LEFT + WIDTH - 2] == drawing.DEAD_ZONE).all(axis=1).nonzero()[0]
        height = pytest.approx(2 * dead_zone * scale, abs=2)
        assert np.ptp([*shaded, *shaded + 1] or [0]) == height
    columns = np.flatnonzero((picture[TOP + 10] == drawing.IN_TRANSIT).all(axis=1))
    assert len(columns) == pytest.approx(min(k, delay) / 200 * WIDTH, abs=3)
    if delay:
        assert columns[-1] == pytest.approx(column(k), abs=2)  # up to now


def test_what_is_written(monkeypatch):
    texts, write = [], drawing.Panel.write

    def written(made):
        texts.clear()
        drawing.draw(made)
        return {text for text, _ in texts}

    def noted(panel, text, *colours, **place):
        texts.append((text.strip(), write(panel, text, *colours, **place)))
        return texts[-1][1]

    monkeypatch.setattr(drawing.Panel, "write", noted)
    assert written(record(*[(5.0, -4.875, 4.0, 0.0)] * 32)) >= {
        "temperature -4.88 °C", "set point 5.00 °C", "error 9.88 °C", "time 4.27 min",
        "applied flow 0.00 t/h", "command 4.00 t/h", "dead zone", "in transit", "20", "-10",
    }  # fmt: skip
    # Ten minutes are 75 samples: under both panels, beside the 10 t/h.
    places = [place for text, place in texts if text == "10"]
    times = [place.centerx for place in places if place.left > LEFT]
    assert times == [pytest.approx(column(75), abs=1)] * 2
    (high,) = (place.centery for place in places if place.right < LEFT)
    (low,) = (place.centery for text, place in texts if text == "-10")
    assert low - high == pytest.approx(20 / 24.8 * HEIGHT, abs=1)
    places = [place.inflate(8, 0) for _, place in texts]
    for i, place in enumerate(places):
        assert pygame.Rect(0, 0, *drawing.SIZE).contains(place)
        assert place.collidelist(places[:i]) == -1
    quick = record(*[(1e9, np.nan, 0.0, 0.0)] * 31, sampling_interval=2.0)
    assert written(quick) >= {"time 1.03 min", "set point 1e+09 °C"}


def test_frames_stay_and_copies_in_the_middle_of_an_episode_draw_alike():
    env = MiddlePointEnv(render_mode="rgb_array", **NOISY)
    env.reset(seed=0)
    env.step(UP)
    before, twin = env.render(), pickle.loads(pickle.dumps(env))
    kept = before.copy()
    assert (before.shape, before.dtype) == (SHAPE, np.uint8)
    env.step(UP)
    assert not np.array_equal(env.render(), before)
    np.testing.assert_array_equal(before, kept)
    np.testing.assert_array_equal(twin.render(), before)  # a record of its own
    twin.step(UP)
    np.testing.assert_array_equal(twin.render(), env.render())


@pytest.mark.parametrize("mode", MODES)
def test_frames_of_a_batch_are_those_of_one_after_the_other(mode, rng):
    native, sync = native_and_sync(2, mode, 6, render_mode="rgb_array", **NOISY)
    for envs in (native, sync):
        envs.reset(seed=5)
    for k in range(9):
        actions = rng.uniform(-1, 1, (2, 1)).astype(np.float32)
        _, _, _, ended, _ = native.step(actions)
        sync.step(actions)
        ours, theirs = native.render(), sync.render()
        assert type(ours) is tuple
        np.testing.assert_array_equal(ours, theirs)
        mask = ended if mode == "Disabled" else np.array([k == 2, False])
        if mask.any():  # one of them starts before the other
            for envs in (native, sync):
                envs.reset(options={"reset_mask": mask.copy()})


def test_a_window_shows_what_a_frame_does_in_time_and_nothing_else_changes(monkeypatch, rng):
    clock = Mock()
    monkeypatch.setattr(drawing, "clock", clock)
    modes = "human", "rgb_array", None
    envs = [gymnasium.make("MiddlePoint-v0", render_mode=mode, **NOISY) for mode in modes]
    returned = [each.reset(seed=0) for each in envs]
    for action in rng.uniform(-1.5, 1.5, (6, 1)):
        assert all(data_equivalence(each, returned[2], exact=True) for each in returned)
        shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
        np.testing.assert_array_equal(shown, envs[1].render())
        returned = [each.step(action) for each in envs]
    assert clock.tick.mock_calls == [call(30)] * 7
    assert envs[0].render() is None
    for other in (envs[1], *(MiddlePointEnv(render_mode=mode) for mode in modes)):
        other.close()  # has no window
    assert pygame.display.get_init()
    envs[0].close()
    assert not pygame.display.get_init()
    envs[0].close()


@pytest.mark.parametrize("made", [MiddlePointEnv, partial(MiddlePointVectorEnv, 2)])
def test_what_cannot_be_drawn_is_said(made, monkeypatch):
    drawn = made(render_mode="rgb_array")
    with pytest.raises(ResetNeeded, match="before render"):
        drawn.render()
    env = made()
    env.reset(seed=0), drawn.reset(seed=0)
    with pytest.warns(UserWarning, match="render mode"):
        assert env.render() is None
    monkeypatch.setitem(sys.modules, "pygame", None)  # not installed
    monkeypatch.delitem(sys.modules, "mptc_gym.drawing")
    monkeypatch.delattr(mptc_gym, "drawing")
    for draw in (drawn.render, MiddlePointEnv(render_mode="human").reset):
        with pytest.raises(DependencyNotInstalled, match=r'pip install "mptc_gym\[render\]"'):
            draw()


anything = st.floats() | st.floats(-20, 20)


@settings(max_examples=25, deadline=None)
@given(
    samples=st.lists(st.tuples(anything, anything, anything, anything), max_size=12),
    delay=st.integers(0, 10) | st.sampled_from([10**3, 10**9]),
    dead_zone=st.floats(0, 10),
    limits=st.lists(st.floats(-1e9, 1e9), min_size=2, max_size=2, unique=True).map(sorted),
    sampling_interval=st.floats(1e-3, 1e9),
)
def test_anything_can_be_drawn(samples, delay, dead_zone, limits, sampling_interval):
    low, high = limits
    made = record(
        *samples, delay=delay, dead_zone=dead_zone, u_min=low, u_max=max(high, low + 1.0),
        sampling_interval=sampling_interval,
    )  # fmt: skip
    assert drawing.frame(made).shape == SHAPE
    for axis in (made.temperatures, made.flows):
        assert 2 <= len(drawing.ticks(*axis)) <= 8
