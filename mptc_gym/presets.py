"""Define presets of the environment, from the paper's cases to a hard one."""

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
"""The environment's arguments in each preset. Each preset has its own id, see `IDS`.

| Name | Id | Description |
|---|---|---|
| `paper` | `MiddlePoint-v0` | the paper's first case: dead zone 5 t/h, no noise; the default |
| `dead-zone-7` | `MiddlePointDeadZone7-v0` | its second case: dead zone 7 t/h |
| `noisy` | `MiddlePointNoisy-v0` | its third case: R = 0.5 degC^2 |
| `disturbed` | `MiddlePointDisturbed-v0` | a noisy boiler and transmitter; the load changes |
| `fouling` | `MiddlePointFouling-v0` | as `disturbed`, and gain and time constant drift |
| `randomised` | `MiddlePointRandomised-v0` | a plant drawn at each reset |
| `hard` | `MiddlePointHard-v0` | everything on, and random set points |

`time_constant_drift` above 1 makes the plant slower, and `gain_drift` below 1 weaker.
"""

IDS: Final[dict[str, str]] = {
    name: f"MiddlePoint{name.title().replace('-', '')}-v0" for name in PRESETS
} | {"paper": "MiddlePoint-v0"}
"""The id of each preset, as in `gymnasium.make(IDS["noisy"])`, with or without arguments."""
