"""Named variants of the environment, from the paper's cases to a hard one."""

from __future__ import annotations

from typing import Any, Final

_BOILER: Final[dict[str, Any]] = {
    "noise_variance": 0.5,
    "measurement_noise_variance": 0.1,
    "disturbance_amplitude": 2.0,
    "disturbance_interval": 200.0,
    "disturbance_walk_variance": 0.0005,
}

PRESETS: Final[dict[str, dict[str, Any]]] = {
    "paper": {},
    "dead-zone-7": {"dead_zone": 7.0},
    "noisy": {"noise_variance": 0.5},
    "disturbed": _BOILER,
    "fouling": {**_BOILER, "gain_drift": [0.5, 1.5], "time_constant_drift": [0.8, 1.5]},
    "randomised": {
        "delay": [12, 24],
        "dead_zone": [3.0, 7.0],
        "noise_variance": [0.0, 0.5],
        "gain_factor": [0.75, 1.5],
        "time_constant_factor": [0.75, 1.5],
    },
    "hard": {
        **_BOILER,
        "delay": [12, 24],
        "dead_zone": [3.0, 7.0],
        "noise_variance": [0.25, 1.0],
        "gain_factor": [0.75, 1.5],
        "gain_drift": [0.7, 1.4],
        "time_constant_factor": [0.75, 1.5],
        "time_constant_drift": [0.8, 1.25],
        "setpoint": "random",
    },
}
"""Arguments of the environment by name: `gymnasium.make("MiddlePoint-v0", **PRESETS["noisy"])`.

| Name | What it is |
|---|---|
| `paper` | the paper's first case (Figs 5 and 10): dead zone 5 t/h, no noise; the default |
| `dead-zone-7` | its second case (Figs 6 and 7): dead zone 7 t/h |
| `noisy` | its third case (Figs 8, 9 and 11): R = 0.5 degC^2 |
| `disturbed` | a noisy boiler and transmitter, under a load that changes and wanders |
| `fouling` | the same, and the dynamics drift: the gain to 0.5 to 1.5 times what it was |
| `randomised` | delay, dead zone, noise, gain and time constant drawn at each reset |
| `hard` | everything on, and random set points |

`time_constant_drift` above 1 makes the plant slower, and `gain_drift` below 1 weaker.
"""
