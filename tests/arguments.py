"""Arguments of the environment, drawn from all that is valid."""

from hypothesis import strategies as st

coefficients = st.floats(-0.3, 0.3)


def or_range(numbers):
    """Return a strategy for numbers, and for ranges of them."""
    return numbers | st.lists(numbers, min_size=2, max_size=2).map(sorted)


STRATEGIES = {
    "a": st.lists(coefficients, max_size=3).map(lambda tail: [1.0, *tail]),
    "b": st.lists(coefficients, min_size=1, max_size=5),
    "c": st.lists(coefficients, max_size=3).map(lambda tail: [1.0, *tail]),
    "delay": or_range(st.integers(0, 30)),
    "dead_zone": or_range(st.floats(0, 10)),
    "u_min": or_range(st.floats(-20, -10)),
    "u_max": or_range(st.floats(0, 20)),
    "noise_variance": or_range(st.floats(0, 4)),
    "measurement_noise_variance": or_range(st.floats(0, 4)),
    "disturbance_amplitude": or_range(st.floats(0, 10)),
    "disturbance_interval": or_range(st.floats(1, 100)),
    "disturbance_walk_variance": or_range(st.floats(0, 1)),
    "gain_factor": or_range(st.floats(0.1, 10)),
    "time_constant_factor": or_range(st.floats(0.5, 4)),
    "gain_drift": or_range(st.floats(0.1, 10)),
    "time_constant_drift": or_range(st.floats(0.2, 4)),
    "drift_samples": st.integers(1, 100),
    "sampling_interval": st.floats(0.1, 60),
    "setpoint": st.one_of(
        st.sampled_from(["square", "random"]),
        st.floats(-100, 100),
        st.lists(st.floats(-100, 100), min_size=1, max_size=5),
    ),
    "setpoint_amplitude": st.floats(0, 100),
    "setpoint_period": st.integers(1, 1000),
    "setpoint_window": st.integers(0, 5),
    "error_window": st.integers(0, 5),
    "output_window": st.integers(0, 5),
    "action_window": st.integers(0, 30),
    "temperature_span": st.floats(0.5, 200),
    "reward": st.sampled_from(["quadratic", "absolute"]),
    "error_scale": st.floats(0.1, 20),
    "move_weight": st.floats(0, 2),
}
WINDOWS = {"setpoint_window": 3, "error_window": 3, "output_window": 0, "action_window": 0}


def _without(*names):
    chosen = {name: each for name, each in STRATEGIES.items() if name not in names}
    return st.fixed_dictionaries({}, optional=chosen)


# Another A, or other time constants of the paper's A: not every A has one to change.
valid_arguments = (
    _without("a") | _without("time_constant_factor", "time_constant_drift")
).filter(
    # An observation with no element is refused.
    lambda arguments: any(arguments.get(name, default) for name, default in WINDOWS.items())
)
