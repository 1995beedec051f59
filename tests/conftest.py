"""Fixtures and helpers that several test files use."""

import os
import subprocess
import sys
from pathlib import Path

# NumPy and PyTorch read these variables when they are imported below. The tests' processes
# already share the cores, so that further threads would only slow the tests down.
os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
os.environ["SDL_VIDEODRIVER"] = "dummy"  # pygame then opens no window

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from hypothesis import settings
from hypothesis import strategies as st

from benchmarks.loop.runs import Trajectory
from mptc_gym import MiddlePointVectorEnv
from mptc_gym.plant import checks
from mptc_gym.plant.parameters import ARGUMENTS, CAN_BE_RANGES, WINDOWS

ROOT = Path(__file__).parent.parent
if not os.access(ROOT, os.W_OK):
    # Hypothesis keeps failing examples in the checkout, and warns where it cannot.
    settings.register_profile("read-only", database=None)
    settings.load_profile("read-only")
# What a step test shows of the paper's plant, which is nearly of first order. Some controllers
# have no other prior knowledge. The units are degC per t/h and s.
STEP_TEST = {"gain": -0.6825, "time_constant": 161.0, "delay": 152.0}

small_numbers = st.floats(-0.3, 0.3)
polynomials = st.lists(small_numbers, max_size=3).map(lambda tail: [1.0, *tail])
setpoints = st.floats(-5, 5)
# The strategy of an argument, by the check of the argument.
BY_CHECK = {
    checks.number: small_numbers,
    checks.count_from_0: st.integers(0, 30),
    checks.count_from_1: st.integers(1, 100),
    checks.not_negative: st.floats(0, 4),
    checks.at_least_1: st.floats(1, 100),
    checks.positive: st.floats(0.5, 4),
    checks.polynomial: polynomials,
    checks.number_list: st.lists(small_numbers, min_size=1, max_size=5),
    checks.reward: st.sampled_from(checks.REWARDS),
    checks.action: st.sampled_from(checks.ACTIONS),
    checks.share_of_range: st.floats(0.01, 2),
    checks.setpoint: st.sampled_from(checks.SETPOINTS)
    | setpoints
    | st.lists(setpoints, min_size=1, max_size=5),
}
# Values of the actuator that fit together, and spans that readings often do not exceed, and set
# points never.
BY_NAME = {
    "dead_zone": st.floats(0, 10),
    "u_min": st.floats(-20, -10),
    "u_max": st.floats(0, 20),
    "temperature_span": st.floats(5, 200),
}
STRATEGIES = BY_NAME | {
    name: BY_CHECK[argument.metadata["check"]]
    for name, argument in ARGUMENTS.items()
    if name not in BY_NAME
}
for name in sorted(CAN_BE_RANGES):
    STRATEGIES[name] |= st.lists(STRATEGIES[name], min_size=2, max_size=2).map(sorted)


def _arguments_without(*names):
    """Return a strategy of dicts with any arguments of the environment, except these names."""
    strategies = {name: STRATEGIES[name] for name in STRATEGIES if name not in names}
    return st.fixed_dictionaries({}, optional=strategies)


def _has_observation(arguments):
    return any(arguments.get(name, ARGUMENTS[name].default) for name in WINDOWS)


# Not every polynomial A has a time constant that can be changed, but the default A has.
valid_arguments = _arguments_without("a") | _arguments_without(
    "time_constant_factor", "time_constant_drift"
)
valid_arguments = valid_arguments.filter(_has_observation)
MODES = [mode.value for mode in AutoresetMode]
NOISY = {"noise_variance": 0.5, "setpoint": "random", "setpoint_period": 60}


def run(env, actions, seed=0):
    """Run an episode, and return observations, rewards and infos by name, k = 0 first.

    An action may be a function of the observation.
    """
    observation, info = env.reset(seed=seed)
    observations, rewards, infos = [observation], [], [info]
    for action in actions:
        taken = action(observation) if callable(action) else np.asarray([action])
        observation, reward, terminated, truncated, info = env.step(taken)
        assert not terminated
        assert not truncated
        observations.append(observation)
        rewards.append(reward)
        infos.append(info)
    record = {key: np.array([info[key] for info in infos]) for key in info}
    return {"observation": np.array(observations), "reward": np.array(rewards)} | record


def native_and_sync(num_envs, mode, limit=None, wrappers=(), **arguments):
    """Return the native vector environment, and a SyncVectorEnv of scalar environments."""
    native = gymnasium.make_vec(
        "MiddlePoint-v0", num_envs, max_episode_steps=limit, autoreset_mode=mode, **arguments
    )
    sync = gymnasium.make_vec(
        "MiddlePoint-v0", num_envs, max_episode_steps=-1 if limit is None else limit,
        vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}, wrappers=wrappers,
        **arguments,
    )  # fmt: skip
    assert type(native) is MiddlePointVectorEnv
    return native, sync


def python(*arguments, **options):
    """Run Python with these arguments in the checkout, and return the completed process."""
    command = [sys.executable, *arguments]
    options = {"cwd": ROOT, "capture_output": True, "text": True, "timeout": 300.0, **options}
    return subprocess.run(command, **options)


def random_actions(rng, n):
    """Return actions of n plants, some of them huge or on the edge of the dead zone."""
    actions = rng.normal(0, 1, (n, 1)).astype(np.float32)
    actions[rng.random(n) < 0.1] *= 1e6
    actions[rng.random(n) < 0.1] = rng.choice([0.5, -0.5])
    return actions


def assert_the_seed_is_all_that_differs(make):
    """Check that `make(seed)` returns equal arrays for equal seeds alone."""
    array = make(1)
    np.testing.assert_array_equal(array, make(1))
    assert not np.array_equal(array, make(2))


def trajectory(setpoint, output, command=None, applied=None):
    """Return the trajectory of one run, whose next set points are the present ones."""
    command = np.zeros(len(setpoint)) if command is None else command
    applied = command if applied is None else applied
    columns = setpoint, output, command, applied, np.subtract(setpoint, output), setpoint
    return Trajectory(*(np.array(column, dtype=float)[:, np.newaxis] for column in columns))


@pytest.fixture
def rng():
    return np.random.default_rng(20261121)


@pytest.fixture
def refused(capsys):
    """Return a function that runs a command, and returns the message with which it refuses."""

    def message(main, arguments):
        capsys.readouterr()  # drops what was printed before
        assert main([str(argument) for argument in arguments]) == 2
        printed = capsys.readouterr()
        assert printed.out == ""
        return printed.err

    return message
