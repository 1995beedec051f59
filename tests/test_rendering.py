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

from mptc_gym import MiddlePointEnv, MiddlePointVectorEnv, environments
from mptc_gym.environments import drawing
from mptc_gym.environments.record import Record
from mptc_gym.plant.parameters import Parameters
from tests.conftest import MODES, NOISY, native_and_sync

SHAPE = (540, 960, 3)
UP = np.ones(1, np.float32)
LEFT, TOP, WIDTH, _ = drawing.FLOWS


def record(*samples, sampling_interval=8.0, **numbers):
    """Return a record of samples (y_d, y, u, u_a) of the paper's plant, or one unlike it."""
    paper = Parameters().lowest
    made = Record(replace(paper, **numbers), sampling_interval, 0.0)
    for sample in samples:
        made.add(*sample)
    return made


@pytest.mark.parametrize(
    ("delay", "dead_zone", "u_max"), [(18, 2.0, 10.0), (40, 8.0, 10.0), (0, 0.0, 5.0)]
)
def test_curves_and_marks_are_where_the_axes_say(delay, dead_zone, u_max):
    early, late = (-12.0, 12.0, 4.0, 0.0), (-12.0, -12.0, 100.0, u_max)
    made = record(*[early] * 60, *[late] * 90, delay=delay, dead_zone=dead_zone, u_max=u_max)
    picture = drawing.frame(made)

    def ends(colour, k):
        """Return the highest and the lowest value with a colour, in the axes of its panel."""
        (low, high), panel = made.flow_axis, drawing.FLOWS
        if colour in (drawing.TEMPERATURE, drawing.SETPOINT):
            (low, high), panel = made.temperature_axis, drawing.TEMPERATURES
        found = np.flatnonzero(
            (picture[:, round(LEFT + k / 200 * WIDTH)] == colour).all(axis=1)
        )
        found = found[(found > panel[1]) & (found < panel[1] + panel[3])]
        return high - (found[[0, -1]] - panel[1]) / panel[3] * (high - low)

    for k, sample in ((30.5, early), (100.5, late)):
        colours = drawing.SETPOINT, drawing.TEMPERATURE, drawing.COMMAND, drawing.APPLIED
        for colour, value in zip(colours, sample, strict=True):
            shown = made.flow_axis[1] if value == 100.0 else value  # the edge of the panel
            assert ends(colour, k) == pytest.approx(shown, abs=0.5)
    for colour in (drawing.COMMAND, drawing.APPLIED):
        assert np.ptp(ends(colour, 60)) > 2.0  # from u(59) to u(60), at once
    assert ends(drawing.LIMIT, 195) == pytest.approx((u_max, -10.0), abs=0.2)
    if dead_zone:
        assert ends(drawing.DEAD_ZONE, 195) == pytest.approx((dead_zone, -dead_zone), abs=0.2)
    columns = np.flatnonzero((picture[TOP + 10] == drawing.IN_TRANSIT).all(axis=1))
    assert len(columns) == pytest.approx(delay / 200 * WIDTH, abs=3)
    assert not delay or columns[-1] == pytest.approx(LEFT + 150 / 200 * WIDTH, abs=2)  # now


def test_what_is_written(monkeypatch):
    texts, write = [], drawing.Panel.write

    def noted(panel, text, *colours, **place):
        texts.append((text.strip(), write(panel, text, *colours, **place)))
        return texts[-1][1]

    monkeypatch.setattr(drawing.Panel, "write", noted)
    drawing.draw(record(*[(5.0, -4.875, 4.0, 0.0)] * 32))
    assert {text for text, _ in texts} >= {
        "temperature -4.88 °C", "set point 5.00 °C", "error 9.88 °C", "time 4.27 min",
        "applied flow 0.00 t/h", "command 4.00 t/h", "dead zone", "in transit", "20", "-10",
    }  # fmt: skip
    # Ten minutes are 75 samples: under both panels, beside the 10 t/h.
    places = [place for text, place in texts if text == "10"]
    times = [place.centerx for place in places if place.left > LEFT]
    assert times == [pytest.approx(LEFT + 75 / 200 * WIDTH, abs=1)] * 2
    places = [place.inflate(8, 0) for _, place in texts]
    for i, place in enumerate(places):
        assert pygame.Rect(0, 0, *drawing.SIZE).contains(place)
        assert place.collidelist(places[:i]) == -1


@pytest.mark.parametrize(
    ("low", "high", "ticks"),
    [
        (-10.0, 10.0, [-10.0, -5.0, 0.0, 5.0, 10.0]),
        (0.0, 6.0, [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0]),
        (0.5, 12.5, [2.0, 4.0, 6.0, 8.0, 10.0, 12.0]),
        (0.0, 60.0, [0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0]),
        (0.0, 0.7, [0.0, 0.2, 0.4, 0.6]),
    ],
)
def test_numbers_at_an_axis_are_round_and_few(low, high, ticks):
    assert drawing.ticks(low, high) == pytest.approx(ticks)


def test_a_large_value_is_written_in_few_digits(monkeypatch):
    write = Mock(return_value=pygame.Rect(0, 0, 1, 1))
    monkeypatch.setattr(drawing.Panel, "write", write)
    drawing.draw(record((99999.0, -100000.0, 0.0, 0.0), (1e9, -1e9, -0.001, 0.0)))
    texts = {each.args[0].strip() for each in write.mock_calls}
    assert {"temperature -1e+09 °C", "set point 1e+09 °C", "command 0.00 t/h"} <= texts
    write.reset_mock()
    drawing.draw(record((99999.0, -100000.0, 0.0, 0.0)))
    texts = {each.args[0].strip() for each in write.mock_calls}
    assert {"set point 99999.00 °C", "temperature -1e+05 °C"} <= texts


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
    monkeypatch.delitem(sys.modules, "mptc_gym.environments.drawing")
    monkeypatch.delattr(environments, "drawing")
    for draw in (drawn.render, MiddlePointEnv(render_mode="human").reset):
        with pytest.raises(DependencyNotInstalled, match=r'pip install "mptc_gym\[render\]"'):
            draw()


def test_a_window_is_open_as_long_as_an_environment_shows_its_pictures():
    first, second = (MiddlePointEnv(render_mode="human") for _ in range(2))
    for env in (first, second):
        env.reset(seed=0)
    first.close()
    assert pygame.display.get_surface() is not None
    second.step(np.zeros(1, np.float32))
    second.close()
    assert pygame.display.get_surface() is None


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
    for axis in (made.temperature_axis, made.flow_axis):
        assert 2 <= len(drawing.ticks(*axis)) <= 8
