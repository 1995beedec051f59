"""Pictures: that they show what happens, in every mode, and change nothing about it."""

import pickle
import sys
from functools import partial
from unittest.mock import Mock, call

import gymnasium
import numpy as np
import pygame
import pytest
from gymnasium.error import DependencyNotInstalled, ResetNeeded
from gymnasium.utils.env_checker import data_equivalence

import mptc_gym
from mptc_gym import MiddlePointEnv, MiddlePointVectorEnv, rendering
from tests.conftest import MODES, NOISY, native_and_sync

UP = np.ones(1, np.float32)
LEFT, TOP, WIDTH, HEIGHT = rendering.FLOWS


def picture_of(actions, **arguments):
    """Return the picture after `actions`, of a plant without noise."""
    env = MiddlePointEnv(render_mode="rgb_array", **arguments)
    env.reset(seed=0)
    for action in actions:
        env.step(np.array([action]))
    return env.render()


@pytest.mark.parametrize(
    ("delay", "dead_zone", "u_max", "span", "earlier_samples"),
    [
        (18, 2.0, 9.0, 200, 0),
        (18, 2.0, 9.0, 200, 80),
        (60, 8.0, 9.0, 240, 0),
        (0, 0.5, 4.0, 200, 0),
    ],
)
def test_curves_and_areas_are_where_the_axes_say(
    delay, dead_zone, u_max, span, earlier_samples
):
    arguments = {"delay": delay, "dead_zone": dead_zone, "u_min": -9.0, "u_max": u_max}
    actions = [0.0] * earlier_samples + [0.9] * 60 + [-3.0] * 90
    picture = picture_of(actions, setpoint=-12.0, b=[0.0], **arguments)
    first = max(0, len(actions) - span)  # the sample at the left edge

    def values(panel, low, high, colour, k):
        """Return the highest and the lowest value with a colour at sample k, in a panel."""
        column = round(LEFT + (k - first) / span * WIDTH)
        pixels = picture[panel.top + 1 : panel.bottom, column]
        rows = np.flatnonzero((pixels == colour).all(axis=1)) + 1
        return high - rows[[0, -1]] / panel.height * (high - low)

    change, now = earlier_samples + 60, earlier_samples + 150
    temperatures = partial(values, rendering.TEMPERATURES, -12.6, 0.6)
    assert temperatures(rendering.SETPOINT, change) == pytest.approx(-12.0, abs=0.2)
    assert temperatures(rendering.TEMPERATURE, change) == pytest.approx(0.0, abs=0.2)
    margin = 0.12 * (u_max + 9.0)
    flows = partial(values, rendering.FLOWS, -9.0 - margin, u_max + margin)
    flow = 0.95 * (u_max + 9.0) - 9.0  # before the change
    for k, command, applied in (-0.5, flow, flow), (0.5, -9.0 - margin, -9.0):
        assert flows(rendering.COMMAND, change + k) == pytest.approx(command, abs=0.5)
        assert flows(rendering.APPLIED, change + k) == pytest.approx(applied, abs=0.5)
    assert np.ptp(flows(rendering.COMMAND, change)) > 2.0  # at once
    assert flows(rendering.LIMIT, first + 1.5) == pytest.approx((u_max, -9.0), abs=0.2)
    edges = dead_zone, -dead_zone
    assert flows(rendering.DEAD_ZONE, first + 1.5) == pytest.approx(edges, abs=0.3)
    in_transit = np.flatnonzero((picture[TOP + 5] == rendering.IN_TRANSIT).all(axis=1))
    assert len(in_transit) == pytest.approx(delay / span * WIDTH, abs=3)
    assert not delay or in_transit[-1] == pytest.approx(
        LEFT + (now - first) / span * WIDTH, abs=2
    )


def test_texts_have_numbers_and_do_not_overlap(monkeypatch):
    places, write = {}, rendering.Panel.write

    def noted(panel, text, *colours, **anchor):
        place = write(panel, text, *colours, **anchor)
        assert pygame.Rect(0, 0, *rendering.SIZE).contains(place)
        assert place.collidelist([*places]) == -1
        places[tuple(place)] = text.strip()
        return place

    monkeypatch.setattr(rendering.Panel, "write", noted)
    picture_of([0.4] * 31 + [-0.0001], sampling_interval=4.0, setpoint=4.875)
    assert {*places.values()} >= {
        "temperature 0.00 °C", "set point 4.88 °C", "error 4.88 °C", "time 2.13 min",
        "applied flow 0.00 t/h", "command 0.00 t/h", "dead zone", "in transit", "5", "-10",
    }  # fmt: skip
    # Ten minutes are 150 samples: under both panels, beside the 10 t/h.
    columns = [pygame.Rect(place).centerx for place, text in places.items() if text == "10"]
    assert [x for x in columns if x > LEFT] == pytest.approx(
        [LEFT + 150 / 200 * WIDTH] * 2, abs=1
    )


@pytest.mark.parametrize(
    ("low", "high", "ticks"),
    [
        (-10.0, 10.0, [-10.0, -5.0, 0.0, 5.0, 10.0]),
        (0.5, 12.5, [2.0, 4.0, 6.0, 8.0, 10.0, 12.0]),
        (0.0, 60.0, [0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0]),
        (0.0, 0.7, [0.0, 0.2, 0.4, 0.6]),
    ],
)
def test_numbers_at_an_axis_are_round_and_few(low, high, ticks):
    assert rendering.ticks(low, high) == pytest.approx(ticks)


def test_pictures_stay_and_copies_in_the_middle_of_an_episode_draw_alike():
    env = MiddlePointEnv(render_mode="rgb_array", **NOISY)
    env.reset(seed=0)
    *_, info = env.step(UP)
    before = env.render()
    info["output"] = 1000.0  # the caller may do what it likes with the info
    twin = pickle.loads(pickle.dumps(env))
    unchanged = before.copy()
    assert before.dtype == np.uint8
    env.step(UP)
    assert not np.array_equal(env.render(), before)
    np.testing.assert_array_equal(before, unchanged)
    np.testing.assert_array_equal(twin.render(), before)  # a record of its own
    twin.step(UP)
    np.testing.assert_array_equal(twin.render(), env.render())


def test_a_list_has_the_pictures_since_the_latest_call():
    modes = "rgb_array_list", "rgb_array"
    collecting, env = (gymnasium.make("MiddlePoint-v0", render_mode=mode) for mode in modes)
    collecting.reset(seed=0), env.reset(seed=0)
    for _ in range(2):
        pictures = []
        for _ in range(2):
            collecting.step(UP), env.step(UP)
            pictures.append(env.render())
        np.testing.assert_array_equal(collecting.render()[-2:], pictures)
    assert collecting.render() == []


@pytest.mark.parametrize("mode", MODES)
def test_pictures_of_a_batch_are_those_of_one_after_the_other(mode, rng):
    batches = native_and_sync(2, mode, 6, render_mode="rgb_array", **NOISY)
    for envs in batches:
        envs.reset(seed=5)
        envs.reset(options={"reset_mask": np.array([True, False])})
    for _ in range(8):
        actions = rng.uniform(-1, 1, (2, 1)).astype(np.float32)
        for envs in batches:
            _, _, _, ended, _ = envs.step(actions)
        native, sync = (envs.render() for envs in batches)
        assert type(native) is tuple
        np.testing.assert_array_equal(native, sync)
        if mode == "Disabled" and ended.any():
            for envs in batches:
                envs.reset(options={"reset_mask": ended.copy()})


def test_a_window_shows_the_picture_in_time_and_nothing_else_changes(monkeypatch, rng):
    clock = Mock()
    monkeypatch.setattr(rendering, "clock", clock)
    modes = "human", "rgb_array", None
    envs = [gymnasium.make("MiddlePoint-v0", render_mode=mode, **NOISY) for mode in modes]
    returned = [env.reset(seed=0) for env in envs]
    for action in rng.uniform(-1.5, 1.5, (6, 1)):
        assert all(data_equivalence(result, returned[2], exact=True) for result in returned)
        window = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
        np.testing.assert_array_equal(window, envs[1].render())
        returned = [env.step(action) for env in envs]
    assert clock.tick.mock_calls == [call(30)] * 7
    assert envs[0].render() is None
    for other in (envs[1], *(MiddlePointEnv(render_mode=mode) for mode in modes)):
        other.close()  # has no window
    assert pygame.display.get_init()
    envs[0].close()
    assert not pygame.display.get_init()
    envs[0].close()


@pytest.mark.parametrize("make", [MiddlePointEnv, partial(MiddlePointVectorEnv, 2)])
def test_what_cannot_be_drawn_is_said(make, monkeypatch):
    env = make(render_mode="rgb_array")
    with pytest.raises(ResetNeeded, match="before render"):
        env.render()
    without_mode = make()
    without_mode.reset(seed=0)
    with pytest.warns(UserWarning, match="render mode"):
        assert without_mode.render() is None
    monkeypatch.setitem(sys.modules, "pygame", None)  # not installed
    monkeypatch.delitem(sys.modules, "mptc_gym.rendering")
    monkeypatch.delattr(mptc_gym, "rendering")
    env.reset(seed=0)  # as in Stable-Baselines3's make_vec_env, which asks for pictures
    with pytest.raises(DependencyNotInstalled, match=r'pip install "mptc_gym\[render\]"'):
        env.render()
