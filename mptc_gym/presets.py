"""Define presets of the environment's arguments: the paper's 3 cases and 4 harder cases."""

from typing import Any, Final

# A boiler with plant noise, measurement noise, and a load disturbance with jumps and a random
# walk. The variances are in degC^2, the amplitude in degC and the interval in samples.
_BOILER: Final[dict[str, Any]] = {
    "noise_variance": 0.5,
    "measurement_noise_variance": 0.1,
    "disturbance_amplitude": 2.0,
    "disturbance_interval": 200.0,
    "disturbance_walk_variance": 0.0005,
}

# Plants that differ from episode to episode: ranges, in samples (delay), t/h (dead zone), and
# multiples of the paper's gain and time constant.
_SPREAD: Final[dict[str, Any]] = {
    "delay": [12, 24],
    "dead_zone": [3.0, 7.0],
    "gain_factor": [0.75, 1.5],
    "time_constant_factor": [0.75, 1.5],
}

PRESETS: Final[dict[str, dict[str, Any]]] = {
    "paper": {},
    "dead-zone-7": {"dead_zone": 7.0},
    "noisy": {"noise_variance": 0.5},
    "disturbed": _BOILER,
    "fouling": {**_BOILER, "gain_drift": [0.5, 1.5], "time_constant_drift": [0.8, 1.5]},
    "randomised": {**_SPREAD, "noise_variance": [0.0, 0.5]},
    "hard": {
        **_BOILER,
        **_SPREAD,
        "noise_variance": [0.25, 1.0],
        "gain_drift": [0.7, 1.4],
        "time_constant_drift": [0.8, 1.25],
        "setpoint": "random",
    },
}
"""The arguments of the environment in each preset, by name of the preset.

"paper", "dead-zone-7" and "noisy" are the three cases of the paper. "disturbed" adds
measurement noise and a load disturbance to "noisy". "fouling" adds drifts of gain and time
constant to "disturbed". "randomised" samples the plant and the variance of the plant's noise at
each reset. "hard" combines the disturbances, drifts and random plants with random set points.
"""

IDS: Final[dict[str, str]] = {
    name: f"MiddlePoint{name.title().replace('-', '')}-v0" for name in PRESETS
} | {"paper": "MiddlePoint-v0"}
"""The id of each preset, by name of the preset, as in `gymnasium.make(IDS["noisy"])`."""

FOR_LEARNING: Final[dict[str, Any]] = {
    "action": "change",
    "compensated_dead_zone": 5.0,
    "action_window": 20,
    "setpoint": "random",
    "reward": "absolute",
}
"""Arguments of the environment with which policies learn quickly, as `**FOR_LEARNING`.

An action changes the flow, and the commands skip the dead zone of the paper's valve, so that
each action of an exploring policy has an effect. An observation holds the latest 20 actions,
more than the delay of the paper's plant in samples. The set points are random, and the reward
is minus the magnitude of the error, in units of `error_scale`.
"""
