"""Pictures: that they show what happens, in every mode, and change nothing about it."""

import copy
import pickle
import sys
from dataclasses import replace
from functools import partial

import gymnasium
import numpy as np
import pygame
import pytest
from gymnasium.error import DependencyNotInstalled, ResetNeeded
from gymnasium.utils.env_checker import data_equivalence
from hypothesis import given, settings
from hypothesis import strategies as st

from mptc_gym import MiddlePointEnv, MiddlePointVectorEnv, drawing, rendering
from mptc_gym.parameters import Parameters
from mptc_gym.ranges import Ranges
from mptc_gym.record import Record
from tests.arguments import MODES, NOISY
from tests.conftest import native_and_sync, run

SHAPE = (540, 960, 3)
UP = np.ones(1, np.float32)


def assert_same(ours, theirs):
    """Two pictures are the same, but for single pixels of a smooth line.

    Now and then pygame gives one of them another shade.
    """
    assert ours.shape == theirs.shape
    assert np.count_nonzero((ours != theirs).any(axis=-1)) <= 3


def record(*samples, setpoint=0.0, sampling_interval=8.0, **numbers):
    """Return a record of samples (y_d, y, u, u_a) of the paper's plant, or one unlike it."""
    paper = Ranges(Parameters()).given
    made = Record(replace(paper, **numbers), sampling_interval, setpoint)
    for sample in samples:
        made.add(*sample)
    return made


def places(picture, colour, tolerance=0):
    """Return the rows and the columns where a colour is."""
    return np.nonzero((np.abs(picture.astype(int) - colour) <= tolerance).all(axis=2))


def height(picture, colour, k, *, top):
    """Return the middle row of a line between samples k and k + 1, below a row."""
    rows, columns = places(picture[top:], colour, tolerance=60)
    return top + rows[columns == round(column(k + 0.5))].mean()


def column(k):
    """Return where sample k lies, as long as the picture has not begun to move."""
    return 72 + k / 200 * 770


def test_the_line_of_the_temperature_is_where_the_temperature_is():
    levels = (12.0,) * 60 + (0.0,) * 60 + (-12.0,) * 60
    picture = rendering.frame(record(*[(level / 2, level, 0.0, 0.0) for level in levels]))
    rows = [height(picture, drawing.TEMPERATURE, k, top=80) for k in (30, 90, 150)]
    # From -12 - 5 % of the range to 12 + 5 %, on to full 2 degC, in a panel of 218 pixels.
    assert np.diff(rows) == pytest.approx([12 / 28 * 218] * 2, abs=1)
    setpoint, _ = places(picture[:, round(column(20)) : round(column(40))], drawing.SETPOINT)
    assert np.mean(setpoint[setpoint > 80]) == pytest.approx(np.mean(rows[:2]), abs=1.5)


def test_the_lines_of_the_flows_are_where_the_flows_are():
    inside, beyond = (0.0, 0.0, 4.0, 0.0), (0.0, 0.0, 100.0, 10.0)
    picture = rendering.frame(record(*[inside] * 50, *[beyond] * 100))
    zero, limit = (height(picture, drawing.APPLIED, k, top=342) for k in (25, 100))
    assert zero - limit == pytest.approx(10 / 24.8 * 150, abs=1)
    command = height(picture, drawing.COMMAND, 25, top=342)
    assert zero - command == pytest.approx(4 / 24.8 * 150, abs=1)
    assert height(picture, drawing.COMMAND, 100, top=342) < limit - 5  # at the edge


@pytest.mark.parametrize("dead_zone", [0.0, 2.0, 4.0, 8.0])
def test_the_shade_of_the_dead_zone_is_as_high_as_it_is_wide(dead_zone):
    _, columns = places(rendering.frame(record(dead_zone=dead_zone)), drawing.DEAD_ZONE)
    shaded = np.count_nonzero(columns == 800)  # where nothing else is drawn
    # The panel of 150 pixels shows 24.8 t/h; the line of no flow takes one row.
    assert shaded == pytest.approx(2 * dead_zone / 24.8 * 150, abs=2)


def test_the_limits_are_marked():
    rows = {}
    for u_max in (5.0, 10.0):
        picture = rendering.frame(record(u_max=u_max, dead_zone=0.0))
        rows[u_max], _ = places(picture[:, 800:801], drawing.LIMIT)  # where there is a dash
    # Of 150 pixels, from -10 - 12 % of the range to u_max + 12 %.
    assert np.diff(rows[10.0]) == pytest.approx([20 / 24.8 * 150], abs=1)
    assert np.diff(rows[5.0]) == pytest.approx([15 / 18.6 * 150], abs=1)


def test_no_line_runs_through_the_names_of_shade_and_limits(rng):
    waves = [(0.0, 0.0, 20.0 * wave, 10.0 * wave) for wave in rng.uniform(-1, 1, 200)]
    calm, busy = (rendering.frame(record(*samples)).copy() for samples in ([], waves))
    names = np.s_[521:540, 72:300]  # below the panels and their tick labels
    np.testing.assert_array_equal(calm[names], busy[names])
    for colour in (drawing.DEAD_ZONE, drawing.LIMIT, drawing.FAINT):
        assert len(places(busy[names], colour)[0]) > 10
    within = np.s_[347:495, 80:840]
    assert len(places(calm[within], drawing.FAINT)[0]) == 0  # no words there


@pytest.mark.parametrize(("k", "delay", "expected"), [
    (10, 18, 10), (18, 18, 18), (60, 18, 18), (60, 40, 40), (60, 0, 0),
])  # fmt: skip
def test_what_is_in_transit_is_shaded(k, delay, expected):
    made = record(*[(0.0, 0.0, 0.0, 0.0)] * k, delay=delay, dead_zone=0.0)
    _, columns = places(rendering.frame(made), drawing.IN_TRANSIT)
    width = np.ptp(columns) + 1 if len(columns) else 0
    assert width == pytest.approx(expected / 200 * 770, abs=3)
    if expected:
        assert columns.max() == pytest.approx(column(k), abs=2)  # up to now


def test_the_readings():
    samples = [(5.0, -4.875, 4.0, 0.0)] * 31
    assert record(*samples).readings == {
        "time": "4.1 min", "set point": "5.00 °C", "temperature": "-4.88 °C",
        "error": "9.88 °C", "command": "4.00 t/h", "applied": "0.00 t/h",
    }  # fmt: skip
    quick = record(*samples, sampling_interval=2.0)
    assert quick.readings["time"] == "1.03 min"
    assert quick.minutes.high == pytest.approx(200 * 2 / 60)


def test_frames_do_not_change_afterwards():
    env = MiddlePointEnv(render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    kept = first.copy()
    env.step(UP)
    assert first.shape == SHAPE
    assert first.dtype == np.uint8
    assert not np.array_equal(first, env.render())
    np.testing.assert_array_equal(first, kept)


@pytest.mark.parametrize("mode", ["rgb_array", "human"])
def test_nothing_else_changes(mode, rng):
    actions = rng.uniform(-1.5, 1.5, 40)
    plain = run(MiddlePointEnv(**NOISY), actions)
    env = MiddlePointEnv(render_mode=mode, **NOISY)
    env.metadata = {**env.metadata, "render_fps": 1000}
    drawn = run(env, actions)
    env.close()
    assert data_equivalence(plain, drawn, exact=True)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_copies_in_the_middle_of_an_episode_draw_alike(copied):
    env = MiddlePointEnv(render_mode="rgb_array", **NOISY)
    env.reset(seed=0)
    env.step(UP)
    before, twin = env.render(), copied(env)
    env.step(UP)
    assert_same(twin.render(), before)  # a record of its own
    twin.step(UP)
    assert_same(twin.render(), env.render())


@pytest.mark.parametrize("mode", MODES)
def test_frames_of_a_batch_are_those_of_one_after_the_other(mode, rng):
    native, sync = native_and_sync(2, mode, 12, render_mode="rgb_array", **NOISY)
    for envs in (native, sync):
        envs.reset(seed=5)
    for k in range(30):
        actions = rng.uniform(-1, 1, (2, 1)).astype(np.float32)
        _, _, _, ended, _ = native.step(actions)
        sync.step(actions)
        ours, theirs = native.render(), sync.render()
        assert type(ours) is tuple
        for one, other in zip(ours, theirs, strict=True):
            assert_same(one, other)
        mask = ended if mode == "Disabled" else np.array([k == 4, False])
        if mask.any():  # one of them starts before the other
            for envs in (native, sync):
                envs.reset(options={"reset_mask": mask.copy()})


def test_a_window_shows_what_a_frame_does_at_reset_and_at_each_step():
    env = gymnasium.make("MiddlePoint-v0", render_mode="human", **NOISY)
    twin = gymnasium.make("MiddlePoint-v0", render_mode="rgb_array", **NOISY)
    for each in (env, twin):
        each.reset(seed=0)
    for _ in range(3):
        shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
        assert_same(shown, twin.render())
        env.step(UP)
        twin.step(UP)
    assert env.render() is None
    env.close()
    assert not pygame.display.get_init()
    env.close()


def test_a_window_keeps_time(monkeypatch):
    paces = []

    class Clock:
        def tick(self, fps):
            paces.append(fps)

    monkeypatch.setattr(drawing, "clock", Clock)
    env = MiddlePointEnv(render_mode="human")
    env.reset(seed=0)
    env.metadata = {**env.metadata, "render_fps": 7}
    env.step(UP)
    env.close()
    assert paces == [30, 7]


def test_close_without_window_is_a_no_op():
    env = MiddlePointEnv(render_mode="human")
    env.reset(seed=0)
    for mode in (None, "rgb_array", "human"):
        MiddlePointEnv(render_mode=mode).close()
    assert pygame.display.get_init()
    env.close()


@pytest.mark.parametrize("made", [MiddlePointEnv, partial(MiddlePointVectorEnv, 2)])
def test_what_cannot_be_drawn_is_said(made):
    for mode in ("depth_array", "", 3):
        with pytest.raises(ValueError, match=rf"render_mode must be None or .*, got {mode!r}"):
            made(render_mode=mode)
    with pytest.raises(ResetNeeded, match="before render"):
        made(render_mode="rgb_array").render()
    env = made()
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="render mode"):
        assert env.render() is None


def test_without_pygame_the_first_picture_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    env = MiddlePointEnv(render_mode="rgb_array")
    envs = MiddlePointVectorEnv(2, render_mode="rgb_array")
    window = MiddlePointEnv(render_mode="human")
    env.reset(seed=0), envs.reset(seed=0)
    for draw in (env.render, envs.render, window.reset):
        with pytest.raises(DependencyNotInstalled, match=r'pip install "mptc_gym\[render\]"'):
            draw()


def test_fonts_outlive_another_s_end_of_pygame():
    rendering.frame(record())
    pygame.quit()
    pygame.init()
    new = rendering.frame(record((0.0, 9753.1, 0.0, 0.0)))  # ticks that no other test writes
    assert len(places(new[100:300, :72], drawing.FAINT, tolerance=60)[0]) > 100


anything = st.floats() | st.floats(-20, 20)


@settings(max_examples=60, deadline=None)
@given(
    samples=st.lists(st.tuples(anything, anything, anything, anything), max_size=12),
    delay=st.integers(0, 10) | st.sampled_from([10**3, 10**9]),
    dead_zone=st.floats(0, 10),
    limits=st.lists(st.floats(-1e9, 1e9), min_size=2, max_size=2, unique=True).map(sorted),
    sampling_interval=st.floats(1e-3, 1e9),
)
def test_anything_can_be_drawn(samples, delay, dead_zone, limits, sampling_interval):
    low, high = limits
    if high - low < 1e-6:
        high = low + 1.0
    made = record(
        *samples, delay=delay, dead_zone=dead_zone, u_min=low, u_max=high,
        sampling_interval=sampling_interval,
    )  # fmt: skip
    assert rendering.frame(made).shape == SHAPE
    for axis in (made.minutes, made.temperatures, made.flows):
        assert 2 <= len(list(axis.ticks())) <= 12


def test_a_record_stays_small():
    made = record(*[(0.0, 0.0, 0.0, 0.0)] * 5000, delay=100)
    assert (len(made.samples), made.first, made.k) == (401, 4600, 5000)
    assert record(delay=10**9).span == 2000


def test_the_axis_holds_all_of_the_episode():
    made = record((30.0, 0.0, 0.0, 0.0), (0.0, -12.0, 0.0, 0.0), *[(0.0,) * 4] * 500)
    axis = made.temperatures
    assert axis.low < -12.0
    assert axis.high > 30.0
    assert record(setpoint=30.0).temperatures.high > 30.0
