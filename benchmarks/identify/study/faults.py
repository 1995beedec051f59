"""Simulate logs of plants with faulty valves, independently of the environment.

The plants are continuous: one or two time constants and a dead time that is no whole number of
samples, integrated in fine time steps. Between the command and the plant is a valve.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from agents import PIController
from benchmarks.identify.log import Log
from benchmarks.loop.linear import LinearModel

Array = NDArray[np.float64]

FINE = 20  # time steps in a sample
INTERVAL = 8.0  # s
LEVEL = 6.0  # t/h, largest step of the flow from its operating point
FAULTS = {  # by kind, the smallest and largest size of the fault; (0, 0) for sound plants
    "first order": (0.0, 0.0),
    "second order": (0.0, 0.0),
    "dead zone": (0.0, 0.0),
    "drift": (0.0, 0.0),
    "two inputs": (0.0, 0.0),
    "loop": (0.0, 0.0),
    "backlash": (0.5, 4.0),
    "backlash, loop": (0.5, 4.0),
    "stiction": (0.5, 4.0),
    "two gains": (1.2, 2.0),
    "dead zone off centre": (0.5, 4.0),
}
# Size from which on a fault is harmful: t/h, or a ratio.
HARMFUL = dict.fromkeys(FAULTS, 2.0) | {"two gains": 1.5}


class Faulty(NamedTuple):
    """A simulated plant: its log, the size of its fault, and its linear part."""

    log: Log
    size: float
    """Width of backlash or stiction, or distance of the dead zone from the centre, t/h; or the
    ratio of two gains; 0 for a sound plant."""
    plant: LinearModel
    """As a finite impulse response; of two gains, with the larger one."""


def valve(kind: str, size: float) -> Callable[[float, float], float]:
    """Return how a valve moves: from its position and a command to its next position."""
    if kind.startswith("backlash"):
        return lambda x, u: min(max(x, u - size / 2.0), u + size / 2.0)
    if kind == "stiction":  # (A. Stenman et al., Int. J. Adapt. Control 17, 2003, 625-639)
        return lambda x, u: u if abs(u - x) > size / 2.0 else x
    if kind == "two gains":
        return lambda _, u: u * (size if u > 0.0 else 1.0)
    if kind.startswith("dead zone"):
        return lambda _, u: 0.0 if abs(u - size) < 2.0 else u
    return lambda _, u: u


def faulty(kind: str, number: int, seed: int) -> Faulty:
    """Return a plant of a kind, and a log of it."""
    generator = np.random.default_rng([seed, number, list(FAULTS).index(kind)])
    size = float(generator.uniform(*FAULTS[kind]))
    samples = int(generator.integers(600, 1500))
    slow = float(generator.uniform(60.0, 300.0))
    fast = float(generator.uniform(0.2, 0.6)) * slow * (kind == "second order")
    gain = float(generator.choice([-1.0, 1.0]) * generator.uniform(0.3, 2.0))
    dead = generator.uniform(0.2, 1.0) * slow + fast
    step = INTERVAL / FINE
    lags, late = [time for time in (slow, fast) if time], round(dead / step)
    position, states = valve(kind, size), np.zeros(len(lags))
    transit, shares = np.zeros(late + 1), [-math.expm1(-step / time) for time in lags]
    x = 0.0

    def advance(command: float, move: Callable[[float, float], float]) -> float:
        """Return the output after one sample of a command."""
        nonlocal x
        for _ in range(FINE):
            x = move(x, command)
            transit[:-1] = transit[1:]
            transit[-1] = gain * x
            entering = transit[0]
            for i, share in enumerate(shares):
                states[i] += share * (entering - states[i])
                entering = states[i]
        return float(states[-1])

    settled = math.ceil((dead + 8.0 * sum(lags)) / INTERVAL)
    response = [advance(float(k == 0), lambda _, u: u) for k in range(settled)]
    larger = size if kind == "two gains" else 1.0
    linear = LinearModel([1.0], (larger * np.array(response)).tolist())
    x, states[:], transit[:] = 0.0, 0.0, 0.0

    # The noise of a transmitter, and a coloured disturbance.
    white = generator.normal(size=samples)
    coloured = signal.lfilter([1.0], [1.0, -math.exp(-INTERVAL / slow)], white)
    level = generator.uniform(0.02, 0.2) * abs(gain)
    noise = level * (coloured + generator.normal(size=samples))
    if kind == "drift":
        noise += np.cumsum(generator.normal(0.0, 0.02 * abs(gain), samples))
    other = _steps(generator, samples, slow, LEVEL)
    levels = _steps(generator, samples, slow, LEVEL * (1.0 if "loop" not in kind else 0.6))
    pi = PIController.simc(
        gain=gain, time_constant=slow, delay=dead, closed_loop_time_constant=2.0 * dead
    )
    flow, temperature, y = np.zeros(samples), np.zeros(samples), 0.0
    share = -math.expm1(-INTERVAL / slow)
    effect = signal.lfilter([0.0, 0.3 * gain * share], [1.0, share - 1.0], other)
    for k in range(samples):
        temperature[k] = y + noise[k] + effect[k] * (kind == "two inputs")
        if "loop" in kind:
            wanted = gain * levels[k]
            pi.act([0.0, 0.0, 0.0, wanted - temperature[k]])
            flow[k] = float(pi.command)
        else:
            flow[k] = levels[k]
        y = advance(flow[k], position)
    disturbances = {"other": other} if kind == "two inputs" else {}
    log = Log(flow + 50.0, temperature.round(3) + 200.0, INTERVAL, disturbances=disturbances)
    return Faulty(log, size, linear)


def _steps(generator: np.random.Generator, samples: int, slow: float, level: float) -> Array:
    """Return steps that are held for one to four time constants, after a rest."""
    levels = [0.0] * int(slow / INTERVAL)
    while len(levels) < samples:
        held = int(generator.uniform(1.0, 4.0) * slow / INTERVAL)
        levels += [float(generator.uniform(-level, level))] * held
    return np.array(levels[:samples])
