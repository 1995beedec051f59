"""Arguments of the environment, drawn from all that is valid."""

from hypothesis import strategies as st

coefficients = st.floats(-0.3, 0.3)
valid_arguments = st.fixed_dictionaries(
    {},
    optional={
        "a": st.lists(coefficients, max_size=3).map(lambda tail: [1.0, *tail]),
        "b": st.lists(coefficients, min_size=1, max_size=5),
        "c": st.lists(coefficients, max_size=3).map(lambda tail: [1.0, *tail]),
        "delay": st.integers(0, 30),
        "dead_zone": st.floats(0, 10),
        "u_min": st.floats(-20, -10),
        "u_max": st.floats(0, 20),
        "noise_variance": st.floats(0, 4),
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
    },
).filter(
    lambda arguments: any(
        arguments.get(name, default)
        for name, default in (
            ("setpoint_window", 3), ("error_window", 3), ("output_window", 0),
            ("action_window", 0),
        )
    )  # an observation with no element is refused
)  # fmt: skip
