"""Fixtures and helpers that several test files use."""

import os
import re
import subprocess
import sys
from pathlib import Path

# Before NumPy and PyTorch are loaded: the processes of the tests share the cores already.
os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
os.environ["SDL_VIDEODRIVER"] = "dummy"  # windows that nobody sees

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from hypothesis import settings
from hypothesis import strategies as st

from benchmarks.loop.rollout import Trajectory
from mptc_gym import MiddlePointVectorEnv
from mptc_gym.evaluation import WINDOWS
from mptc_gym.plant import checks
from mptc_gym.plant.parameters import ARGUMENTS, PLANT_NUMBERS

ROOT = Path(__file__).parent.parent
if not os.access(ROOT, os.W_OK):
    # Hypothesis keeps failing examples in the checkout, and warns where it cannot.
    settings.register_profile("read-only", database=None)
    settings.load_profile("read-only")
# What a step test shows of the paper's plant, nearly of first order: all that some are told.
STEP_TEST = {"gain": -0.6825, "time_constant": 161.0, "delay": 152.0}

few = st.floats(-0.3, 0.3)
tails = st.lists(few, max_size=3).map(lambda tail: [1.0, *tail])
levels = st.floats(-100, 100)
BY_CHECK = {
    checks.number: few,
    checks.samples: st.integers(0, 30),
    checks.duration: st.integers(1, 100),
    checks.not_negative: st.floats(0, 4),
    checks.at_least_1: st.floats(1, 100),
    checks.positive: st.floats(0.5, 4),
    checks.polynomial: tails,
    checks.numbers: st.lists(few, min_size=1, max_size=5),
    checks.reward: st.sampled_from(checks.REWARDS),
    checks.setpoint: st.sampled_from(checks.SETPOINTS)
    | levels
    | st.lists(levels, min_size=1, max_size=5),
}
BY_NAME = {  # what fits together, and readings that are not always at the end of the span
    "dead_zone": st.floats(0, 10),
    "u_min": st.floats(-20, -10),
    "u_max": st.floats(0, 20),
    "temperature_span": st.floats(0.5, 200),
}
STRATEGIES = {
    name: BY_NAME.get(name, BY_CHECK[each.metadata["check"]])
    for name, each in ARGUMENTS.items()
}
for name in PLANT_NUMBERS:
    STRATEGIES[name] |= st.lists(STRATEGIES[name], min_size=2, max_size=2).map(sorted)


def _without(refused):
    chosen = {name: each for name, each in STRATEGIES.items() if not re.match(refused, name)}
    return st.fixed_dictionaries({}, optional=chosen)


# Of all that is valid: another A, or other time constants of the paper's A, as not every A has
# one to change; and an observation with at least one element.
valid_arguments = (_without("a$") | _without("time_constant")).filter(
    lambda arguments: any(arguments.get(name, ARGUMENTS[name].default) for name in WINDOWS)
)
MODES = [mode.value for mode in AutoresetMode]
NOISY = {"noise_variance": 0.5, "setpoint": "random", "setpoint_period": 60}


def run(env, actions, seed=0):
    """Reset, take all actions, and return observations, rewards and infos, k = 0 first.

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
    """Return the vector environment, and Gymnasium's of one (wrapped) after the other."""
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


def python(*words, **options):
    """Run Python with these words, in the checkout."""
    command = [sys.executable, *words]
    options = {"cwd": ROOT, "capture_output": True, "text": True, "timeout": 300.0, **options}
    return subprocess.run(command, **options)


def random_actions(rng, n):
    """Return actions of n plants, some of them huge or on the edge of the dead zone."""
    actions = rng.normal(0, 1, (n, 1)).astype(np.float32)
    actions[rng.random(n) < 0.1] *= 1e6
    actions[rng.random(n) < 0.1] = rng.choice([0.5, -0.5])
    return actions


def assert_the_seed_is_all_that_differs(made):
    """Make it twice with a seed and once with another, and compare."""
    first, again, other = (np.asarray(made(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def trajectory(setpoint, output, command=None, applied=None):
    """Return one run, of columns, as if each step led to its own sample."""
    command = np.zeros(len(setpoint)) if command is None else command
    applied = command if applied is None else applied
    columns = setpoint, output, command, applied, np.subtract(setpoint, output), setpoint
    return Trajectory(*(np.array(column, dtype=float)[:, np.newaxis] for column in columns))


@pytest.fixture
def rng():
    return np.random.default_rng(20261121)


@pytest.fixture
def refused(capsys):
    """Return a function that runs a command, and returns with which words it refuses."""

    def refused(main, given):
        capsys.readouterr()  # what came before
        with pytest.raises(SystemExit) as stop:
            main([str(each) for each in given])
        assert stop.value.code == 2
        printed = capsys.readouterr()
        assert printed.out == ""
        return printed.err

    return refused
