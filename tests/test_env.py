"""Check the environment against its specification, also what is off by default."""

import inspect
import pickle
import warnings
from functools import partial

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from mptc_gym import PRESETS, MiddlePointEnv, Parameters
from mptc_gym.plant.parameters import WINDOWS, argument_table
from tests.conftest import ROOT, run, valid_arguments

INFO = {"output", "setpoint", "error", "command", "applied", "noise"}


@pytest.mark.parametrize("library", ["gymnasium.utils", "stable_baselines3.common"])
@settings(max_examples=8, deadline=None)
@given(arguments=valid_arguments)
def test_the_checker_of_a_library_is_content_with_any_valid_arguments(library, arguments):
    checker = pytest.importorskip(f"{library}.env_checker", reason="the library's own checks")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(gymnasium.make("MiddlePoint-v0", **arguments).unwrapped)


@settings(max_examples=30, deadline=None)
@given(
    arguments=valid_arguments,
    actions=st.lists(st.floats(-1e3, 1e3, width=32), min_size=1, max_size=60),
    seed=st.integers(0, 2**31),
)
@example({"a": [1.0, -3.0, 4.0], "output_window": 1}, [1.0] * 1500, 0)  # outputs overflow
def test_observations_stay_in_their_space_whatever_the_actions(arguments, actions, seed):
    env = MiddlePointEnv(**arguments)
    record = run(env, np.array(actions, dtype=np.float32), seed)
    for observation in record["observation"]:
        assert env.observation_space.contains(observation)


def test_spaces_whose_bounds_are_those_of_the_span():
    for setpoint in ("square", "random", 5.0, [1.0, -3.0]):
        env = MiddlePointEnv(setpoint=setpoint, **dict.fromkeys(WINDOWS, 1))
        assert list(env.observation_space.high) == [50, 100, 50, 1]
        assert list(env.observation_space.low) == [-50, -100, -50, -1]
        assert env.action_space == gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    wide = MiddlePointEnv(setpoint=60.0, temperature_span=60.0)
    assert list(wide.observation_space.high) == [60] * 3 + [120] * 3


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("setpoint", {"setpoint": [5.0, -60.0]}),
        ("setpoint", {"setpoint": 50.5}),
        ("setpoint_amplitude", {"setpoint_amplitude": 60.0}),
        ("setpoint_amplitude", {"setpoint": "random", "temperature_span": 4.0}),
    ],
)
def test_a_set_point_beyond_the_transmitter_names_both(name, arguments):
    with pytest.raises(ValueError, match=rf"^{name} must be .*temperature_span = "):
        MiddlePointEnv(**arguments)
    # An amplitude that is not in use is not limited.
    MiddlePointEnv(**{**arguments, "setpoint": 1.0})


def test_reset_is_at_rest():
    env = MiddlePointEnv(noise_variance=0.5, output_window=2, action_window=3)
    observation, info = env.reset(seed=0)
    assert list(observation) == [5, 0, 0, 5, 0, 0, 0, 0, 0, 0, 0]
    rest = {"output": 0.0, "command": 0.0, "applied": 0.0, "noise": 0.0}
    assert info == {"setpoint": 5.0, "error": 5.0, **rest}
    # With these unsymmetric limits, a flow of 0 lies a quarter of the range above u_min.
    env = MiddlePointEnv(u_min=-5.0, u_max=15.0, action_window=2, move_weight=1.0)
    observation, _ = env.reset(seed=0)
    assert list(observation[-2:]) == [-0.5, -0.5]
    _, reward, *_ = env.step(np.array([-0.5], np.float32))
    assert reward == -0.5  # of the error alone, as the action has not changed


def test_timeline_by_hand():
    # y(k+1) = 0.5 y(k) - u_a(k - 1): a pole at 0.5, one sample of delay.
    env = MiddlePointEnv(
        a=[1, -0.5], b=[-1.0], delay=1, dead_zone=1.0, u_min=-4.0, u_max=4.0,
        setpoint=[3.0, 2.0, 1.0], output_window=2, action_window=2,
        reward="absolute", error_scale=2.0, move_weight=0.5,
    )  # fmt: skip
    record = run(env, np.array([0.5, -0.125, -2.0, 0.0]))
    assert list(record["command"]) == [0, 2.0, -0.5, -8.0, 0.0]
    assert list(record["applied"]) == [0, 2.0, 0.0, -4.0, 0.0]  # dead zone, then saturation
    # y(1) = 0, y(2) = -2, y(3) = -1 - 0, y(4) = -0.5 + 4
    assert list(record["output"]) == [0, 0, -2, -1, 3.5]
    assert list(record["setpoint"]) == [3, 2, 1, 1, 1]
    assert list(record["error"]) == [3, 2, 3, 2, -2.5]
    # |e(k+1)| / 2 + 0.5 |a(k) - a(k-1)|: 1 + 0.25, 1.5 + 0.3125, 1 + 0.9375, 1.25 + 1
    assert list(record["reward"]) == [-1.25, -1.8125, -1.9375, -2.25]
    square = MiddlePointEnv(setpoint_amplitude=2.0, setpoint_period=6)
    assert list(run(square, np.zeros(8))["setpoint"]) == [2, 2, 2, -2, -2, -2, 2, 2, 2]
    # y_d newest first, e, y, and actions as the actuator limits them
    assert list(record["observation"][4]) == [1, 1, 1, -2.5, 2, 3, 3.5, -1, 0, -1]


@pytest.mark.parametrize(("others", "alone"), [
    ({"setpoint": 0.0}, ["noise"]), ({"noise_variance": 0.0}, ["setpoint"]),
    ({"disturbance_amplitude": 4.0}, ["noise", "setpoint"]),
])  # fmt: skip
def test_noise_and_set_point_come_from_the_seed_alone_in_separate_streams(others, alone, rng):
    arguments = {"noise_variance": 0.5, "setpoint": "random"}
    first = run(MiddlePointEnv(**arguments), rng.uniform(-1, 1, 600))
    second = run(MiddlePointEnv(**arguments | others), rng.uniform(-1, 1, 600))
    for key in alone:
        np.testing.assert_array_equal(first[key], second[key])


def test_info_is_made_of_floats_and_counts_of_ints():
    env = MiddlePointEnv(noise_variance=[0.5, 0.7], delay=[3, 9])
    _, info = env.reset(seed=0)
    *_, after = env.step(np.ones(1, np.float32))
    types = {name: type(value) for name, value in info.items()}
    assert types == {**dict.fromkeys(INFO | {"noise_variance"}, float), "delay": int}
    assert {name: type(value) for name, value in after.items()} == dict.fromkeys(INFO, float)


NAN, INF = float("nan"), float("inf")
BAD = {
    "delay": [1.5, -1, "18", True, 10**12, [3, 2]],
    "dead_zone": [-0.1, 10.1, NAN, "5", [1, 2, 3], (0.0, 11.0)],
    "u_min": [10.0, 11.0, -INF, [-12.0, -10.0]], "u_max": [INF], "gain_factor": [0.0],
    "noise_variance": [-0.5, INF, None], "disturbance_interval": [0.9],
    "time_constant_factor": [0.01],
    "a": [[2.0, 0.5], [], [1.0, NAN], 1.0, "1"],
    "b": [[], [INF], [None]], "c": [[0.9], {}, [1.0] * 900 + [NAN]],
    "drift_samples": [10**10, 0], "sampling_interval": [0.0, -8.0],
    "setpoint": ["triangle", [], [1.0, NAN], NAN, None, 10**400, 1e300],
    "setpoint_amplitude": [-1.0], "setpoint_period": [0, 2.5, 10**400],
    "setpoint_window": [-1], "error_window": [1.0], "output_window": ["2"],
    "action_window": [-3, 10**10], "temperature_span": [0.0, INF],
    "reward": ["cubic", 2], "error_scale": [0.0, -5.0, 1e-100], "move_weight": [-1.0, NAN],
    "action": ["position", None], "max_move": [0.0, 2.1, NAN, "x", True],
    "compensated_dead_zone": [-1.0, INF, True, None, [3.0, 5.0]],
    "render_mode": ["depth_array", "", 3],
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_arguments_are_named(name):
    for value in BAD[name]:
        with pytest.raises(ValueError, match=rf"{name}.* must be .*got") as error:
            MiddlePointEnv(**{name: value})
        elements = value if isinstance(value, list | tuple) else ()
        assert any(repr(each)[:80] in str(error.value) for each in (value, *elements))
        assert len(str(error.value)) < 300


def test_what_does_not_fit_together_is_named():
    for arguments, message in [
        ({"dead_zone": [5, 8], "u_min": -6, "u_max": 7}, "dead_zone must be at most 7"),
        ({"time_constant_factor": 2, "a": [1.0]}, r"slowest pole .* p = 0\+0j"),
        ({"time_constant_factor": 2, "a": [1.0, -1.0, 0.5]}, r"pole .* p = 0\.5.*j"),
        ({"time_constant_factor": 2, "a": [1.0, -1.0]}, r"pole .* p = 1\+0j"),
        ({"time_constant_drift": 0.4, "a": [1.0, -0.5]}, r"never below 1 - p,.* p = 0\.5"),
        ({"disturbance_amplitude": 1, "a": [1.0, -1.0]}, "a must be stable"),
        ({"delay": [3.5, 4]}, "delay must be an integer"),
        ({"dead_zone": [0, NAN]}, "dead_zone must be a number"),
        ({"setpoint_window": 0, "error_window": 0}, "error_window"),
    ]:
        with pytest.raises(ValueError, match=message):
            MiddlePointEnv(**arguments)


@pytest.mark.parametrize("make", [gymnasium.make, partial(gymnasium.make_vec, num_envs=2)])
def test_a_misspelt_argument_is_named(make):
    with pytest.raises(TypeError, match="got an unexpected keyword argument 'dead_zon'"):
        make("MiddlePoint-v0", dead_zon=5.0)


@pytest.mark.parametrize(
    "lists",
    [
        {"a": [1.0, -0.5], "b": [0.5], "c": [1.0, 0.25], "delay": [12, 24], "setpoint": [1, 2]},
        {"delay": 7, "dead_zone": 2.0, "setpoint": 1.0, "noise_variance": [0.5, 1.0]},
    ],
)
def test_arrays_are_taken_where_lists_are_and_are_lists_in_the_spec(lists):
    parameters = MiddlePointEnv(**lists).parameters
    arrays = {name: np.array(value) for name, value in lists.items()}
    if "dead_zone" in lists:
        arrays["dead_zone"] = np.float32(2)
    env = gymnasium.make("MiddlePoint-v0", **arrays)
    copied_env = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    assert env.unwrapped.parameters == copied_env.unwrapped.parameters == parameters
    envs = gymnasium.make_vec("MiddlePoint-v0", 2, **arrays)
    arguments = EnvSpec.from_json(envs.spec.to_json()).kwargs
    assert Parameters(**{name: arguments[name] for name in lists}) == parameters


@pytest.mark.parametrize(
    ("given", "samples"), [({}, 1200), ({"max_episode_steps": None}, 1200),
                           ({"max_episode_steps": 5}, 5), ({"max_episode_steps": -1}, None)],
)  # fmt: skip
def test_the_spec_of_a_batch_makes_its_plants_one_by_one_or_together(given, samples):
    plant = {"delay": np.int64(5), "action": "change", "max_move": np.float32(0.25)}
    mode = AutoresetMode.SAME_STEP
    envs = gymnasium.make_vec("MiddlePoint-v0", 2, autoreset_mode=mode, **plant, **given)
    spec = EnvSpec.from_json(envs.spec.to_json())
    again, one = gymnasium.make_vec(spec), gymnasium.make(spec)
    assert (again.num_envs, again.autoreset_mode) == (2, mode)
    assert again.parameters == one.unwrapped.parameters == envs.parameters
    assert one.spec.max_episode_steps == again.spec.max_episode_steps == samples


BAD_ACTIONS = [
    np.array([np.nan]), np.array([np.inf]), np.zeros(2), np.zeros(0), None, "up", "0.3", b"0.3",
    np.str_("0.3"), np.bytes_(b"0.3"), np.array(["0.3"]), ["0.3"], [10**400], 0.3 + 0j,
]  # fmt: skip


def test_bad_action_leaves_the_plant_untouched():
    reference = run(MiddlePointEnv(noise_variance=0.5), np.ones(40))
    env = MiddlePointEnv(noise_variance=0.5)
    env.reset(seed=0)
    for k in range(40):
        for action in BAD_ACTIONS:
            with pytest.raises(ValueError, match="action"):
                env.step(action)
        _, _, _, _, info = env.step(np.ones(1, np.float32))
        assert info["output"] == reference["output"][k + 1]


def test_help_shows_every_argument_and_the_page_every_preset():
    assert "`render_mode`" in MiddlePointEnv.__doc__
    for documented in (MiddlePointEnv, Parameters):
        text = inspect.getdoc(documented)
        assert f"\n\n{argument_table()}\n" in text
        assert "\n| `delay` | 18* | samples | transport delay d in equation (28) |\n" in text
    page = (ROOT / "mptc_gym/README.md").read_text(encoding="utf-8")
    assert all(f"`{name}`" in page for name in PRESETS)


@pytest.mark.parametrize(
    ("arguments", "outputs", "setpoint"),
    [
        ({}, [0.65682536, -0.6115650288267045, 0.15795357524280013], -5.0),
        (
            {"noise_variance": 0.5, "setpoint": "random"},
            [1.4136041356100852, 0.05882366982027529, -0.545379463066878],
            -3.9272474884252997,
        ),
    ],
)
def test_stored_trajectory(arguments, outputs, setpoint):
    # These numbers were computed by this code: the test notices if v0 changes.
    record = run(MiddlePointEnv(**arguments), (np.arange(400) % 21 - 10) / 10, seed=42)
    assert record["output"][[20, 100, 400]] == pytest.approx(outputs, rel=1e-12)
    assert record["setpoint"][400] == pytest.approx(setpoint, rel=1e-12)


GAIN = -0.04964 / 0.07273  # B(1) / A(1), degC per t/h
POLE = 0.45181 / 2 + np.sqrt(0.45181**2 / 4 + 0.47546)  # of z^2 - 0.45181 z - 0.47546
EVERYTHING = {
    "noise_variance": [0.2, 0.8], "measurement_noise_variance": [0.1, 0.2],
    "disturbance_amplitude": [1.0, 3.0], "disturbance_interval": [20, 60],
    "disturbance_walk_variance": [0.001, 0.01], "gain_factor": [0.7, 1.4],
    "time_constant_factor": [0.7, 1.4], "gain_drift": [0.7, 1.4],
    "time_constant_drift": [0.7, 1.4], "drift_samples": 300, "delay": [3, 25],
    "dead_zone": [3, 7], "setpoint": "random",
    "output_window": 2, "action_window": 2,
}  # fmt: skip


def test_plant_numbers_of_a_seed_never_change():
    # The plant numbers take the random numbers of the seed's third stream, in this order.
    released = (
        "delay", "dead_zone", "u_min", "u_max", "noise_variance", "measurement_noise_variance",
        "disturbance_amplitude", "disturbance_interval", "disturbance_walk_variance",
        "gain_factor", "time_constant_factor", "gain_drift", "time_constant_drift",
    )  # fmt: skip
    _, info = MiddlePointEnv(**EVERYTHING).reset(seed=7)
    stream = np.random.SeedSequence(7).spawn(4)[2]
    uniform = np.random.Generator(np.random.PCG64(stream)).random(len(released))
    shares = dict(zip(released, uniform, strict=True))
    del shares["u_min"], shares["u_max"]  # their random numbers are reserved
    assert info["delay"] == 3 + int(23 * shares.pop("delay"))
    for name, share in shares.items():
        low, high = EVERYTHING[name]
        assert info[name] == pytest.approx(low + (high - low) * share, rel=1e-12), name


def test_the_observation_sees_its_noise_and_nothing_else_does(rng):
    actions = rng.uniform(-1, 1, 5_000)
    plant = {"noise_variance": 0.5, "output_window": 1}
    silent = run(MiddlePointEnv(**plant), actions)
    noisy = run(MiddlePointEnv(measurement_noise_variance=0.09, **plant), actions)
    for name in ("output", "error", "reward", "noise"):
        np.testing.assert_array_equal(noisy[name], silent[name])
    readings = noisy["observation"][:, -1]
    noise = readings - noisy["output"]
    assert noise[0] == 0.0
    assert noise.var() == pytest.approx(0.09, rel=0.1)
    assert abs(np.corrcoef(noise[1:], noisy["noise"][1:])[0, 1]) < 0.06
    observed_errors = noisy["observation"][:, 3]
    np.testing.assert_allclose(observed_errors, noisy["setpoint"] - readings, atol=1e-5)


def test_the_reading_saturates_and_the_truth_does_not():
    record = run(MiddlePointEnv(output_window=1, temperature_span=5.0), -np.ones(300))
    assert record["observation"][-1, -1] == 5.0
    assert record["output"][-1] > 6.8


@pytest.mark.parametrize("slower", [1.0, 2.0])
def test_the_load_passes_through_the_dynamics_and_its_gain_is_1(slower):
    signals = {"disturbance_amplitude": 4.0, "disturbance_walk_variance": 0.01}
    env = MiddlePointEnv(time_constant_factor=slower, noise_variance=0.5, **signals)
    record = run(env, np.zeros(1000))
    assert np.ptp(record["disturbance"]) > 4.0
    # The other pole of the paper's plant, 0.45181 - POLE, stays where it is.
    a = np.convolve([1, (1 - POLE) / slower - 1], [1, POLE - 0.45181])
    driven = a.sum() * record["disturbance"] + record["noise"]
    np.testing.assert_allclose(record["output"], lfilter([1], a, driven), atol=1e-10)


def test_drift_ends_at_the_plant_that_factors_give():
    drifting = MiddlePointEnv(
        gain_factor=0.8, gain_drift=1.5, time_constant_drift=2.0, drift_samples=200
    )
    record = run(drifting, np.ones(3000))
    k = np.arange(3001)
    share = np.minimum(k // 10 * 10 / 200, 1.0)  # linear, every 10 samples
    np.testing.assert_allclose(record["gain_factor"], 0.8 * (1 + 0.5 * share), rtol=1e-12)
    np.testing.assert_allclose(record["time_constant_factor"], 1 + share, rtol=1e-12)
    assert record["output"][-1] == pytest.approx(10 * 0.8 * 1.5 * GAIN, rel=1e-9)


def test_a_sampled_plant_is_the_plant_with_these_numbers_to_the_bit(rng):
    sampled_plant = MiddlePointEnv(**EVERYTHING)
    ranges = {name for name, value in EVERYTHING.items() if isinstance(value, list)}
    actions = rng.uniform(-1.2, 1.2, 700)
    for seed in range(5):
        _, info = sampled_plant.reset(seed=seed)
        sampled_numbers = {name: info[name] for name in ranges}
        fixed_plant = MiddlePointEnv(**EVERYTHING | sampled_numbers)
        assert_equal_records(run(sampled_plant, actions, seed), run(fixed_plant, actions, seed))


def test_random_numbers_depend_on_the_seed_and_the_episode_alone():
    first = MiddlePointEnv(**EVERYTHING)
    second = MiddlePointEnv(**EVERYTHING)
    first_episode = run(first, np.ones(1500), seed=5)
    run(second, -np.ones(2), seed=5)
    second_episode = run(first, np.zeros(300), seed=None)
    assert_equal_records(second_episode, run(second, np.zeros(300), seed=None))
    for name in ("noise", "setpoint", "disturbance", "gain_factor"):
        assert not np.array_equal(first_episode[name][:301], second_episode[name])


def assert_equal_records(record, other):
    assert set(record) == set(other)
    for name in record:
        np.testing.assert_array_equal(record[name], other[name])


CHANGE = {"action": "change", "compensated_dead_zone": 5.0, "action_window": 3}


@pytest.mark.parametrize("arguments", [{}, PRESETS["hard"], {**PRESETS["hard"], **CHANGE}])
@pytest.mark.parametrize("steps", [0, 43, 599])  # 600 samples are generated at a time
def test_after_set_state_steps_and_episodes_are_as_if_nothing_had_been_tried(
    arguments, steps, rng
):
    actions = rng.uniform(-1.2, 1.2, 1500)
    env, untouched = MiddlePointEnv(**arguments), MiddlePointEnv(**arguments)
    env.reset(seed=3)
    untouched.reset(seed=3)
    for a in actions[:steps]:
        env.step(np.array([a]))
        untouched.step(np.array([a]))
    state = env.get_state()
    tried = []
    for _ in range(2):  # the second time from the same state
        tried.append(_continue(env, actions[:700]))  # also resets
        env.set_state(state)
    assert tried[0] == tried[1]
    env.reset(seed=8)
    env.np_random.random()
    elsewhere = MiddlePointEnv(**arguments)
    elsewhere.set_state(state)  # while the episode of `env` goes on
    env.set_state(state)
    expected = _continue(untouched, actions[700:])
    assert _continue(env, actions[700:]) == expected
    env.reset(seed=9)
    assert _continue(elsewhere, actions[700:]) == expected
    assert elsewhere.np_random_seed == untouched.np_random_seed == 3
    elsewhere.set_state(pickle.loads(pickle.dumps(state)))
    assert _continue(elsewhere, actions[700:]) == expected


def _continue(env, actions):
    """Step, begin another episode, and return all that was seen and the next random number."""
    seen = []
    for a in actions:
        observation, reward, _, _, info = env.step(np.array([a]))
        seen.append((observation.tolist(), reward, info))
    observation, info = env.reset()
    seen.append((observation.tolist(), info))
    for a in actions[:50]:
        observation = env.step(np.array([a]))[0]
        seen.append((observation.tolist(), env.np_random.random()))
    return seen


def test_states_need_an_episode_and_equal_arguments():
    env = MiddlePointEnv()
    with pytest.raises(ResetNeeded):
        env.get_state()
    env.reset(seed=0)
    MiddlePointEnv(noise_variance=0.0).set_state(env.get_state())  # the default
    with pytest.raises(ValueError, match="other arguments"):
        MiddlePointEnv(delay=3).set_state(env.get_state())
