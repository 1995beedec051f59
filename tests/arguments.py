"""Draws arguments of the environment from all that is valid, by how they are declared."""

from gymnasium.vector import AutoresetMode
from hypothesis import strategies as st

from mptc_gym import checks
from mptc_gym.evaluation import WINDOWS
from mptc_gym.parameters import ARGUMENTS, PLANT_NUMBERS

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


def _strategy(name, argument):
    """Return a strategy for an argument, and for ranges of it where they are valid."""
    numbers = BY_NAME[name] if name in BY_NAME else BY_CHECK[argument.check]
    if name not in PLANT_NUMBERS:
        return numbers
    return numbers | st.lists(numbers, min_size=2, max_size=2).map(sorted)


STRATEGIES = {name: _strategy(name, argument) for name, argument in ARGUMENTS.items()}
MODES = [mode.value for mode in AutoresetMode]
NOISY = {"noise_variance": 0.5, "setpoint": "random", "setpoint_period": 60}


def _without(*names):
    chosen = {name: each for name, each in STRATEGIES.items() if name not in names}
    return st.fixed_dictionaries({}, optional=chosen)


# Another A, or other time constants of the paper's A: not every A has one to change.
valid_arguments = (
    _without("a") | _without(*(name for name in ARGUMENTS if name.startswith("time_constant")))
).filter(
    # An observation with no element is refused.
    lambda arguments: any(arguments.get(name, ARGUMENTS[name].default) for name in WINDOWS)
)
