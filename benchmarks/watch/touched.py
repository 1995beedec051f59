"""A plant whose set point and load can be changed by hand while it runs."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import gymnasium
import numpy as np
from numpy.typing import NDArray

from benchmarks.loop.linear import check_linear, coefficients
from mptc_gym import MiddlePointEnv
from mptc_gym.ranges import Ranges
from mptc_gym.record import Record


class Touched(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Adds to a plant's set point, and to its load, what a hand does.

    The set point does not act on the plant, and (28) is linear in the load: with A(1) w(k)
    added to it, y is what it is without, plus d(k) = alpha_1 d(k-1) + ... + A(1) w(k), where
    the alpha are the coefficients of A with their signs changed. So both can be added outside
    of the environment. Observation and info are those of the plant that is touched. The reward,
    which nothing here uses, is that of the plant that is not, and so is the limit of the
    transmitter.

    `show`, if given, is called with a record of the last samples at each reset and step.
    """

    def __init__(
        self, env: gymnasium.Env[Any, Any], show: Callable[[Record], None] | None = None
    ) -> None:
        super().__init__(env)
        self.parameters = cast("MiddlePointEnv", env.unwrapped).parameters
        check_linear(self.parameters)
        self._show = show
        self.setpoint = self.load = 0.0  # what is added from the next sample on, degC

    def reset(self, **arguments: Any) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Reset the plant; nothing is added at k = 0."""
        observation, info = self.env.reset(**arguments)
        parameters = self.parameters
        drawn = {name: info[name] for name in parameters.ranges}
        self._numbers = replace(Ranges(parameters).given, **drawn)
        self._k = 0
        length = max(*parameters.windows, len(parameters.a) - 1)
        # What is added to y_d and to y, newest first.
        self._setpoints = deque([0.0] * length, length)
        self._outputs = deque([0.0] * length, length)
        if self._show is not None:
            self.record = Record(self._numbers, parameters.sampling_interval, info["setpoint"])
            self._show(self.record)
        return observation, info

    def step(
        self, action: Any
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Step the plant, and add what the hand does."""
        self._k += 1
        now = coefficients(self.parameters, self._numbers, self._k)
        observation, reward, terminated, truncated, info = self.env.step(action)
        added = sum(a * d for a, d in zip(now.alpha.tolist(), self._outputs, strict=False))
        self._outputs.appendleft(added + float(now.load) * self.load)
        self._setpoints.appendleft(self.setpoint)
        output, setpoint = self._outputs[0], self._setpoints[0]
        info |= {
            "output": info["output"] + output,
            "setpoint": info["setpoint"] + setpoint,
            "error": info["error"] + setpoint - output,
        }
        if self._show is not None:
            self.record.add(*(info[x] for x in ("setpoint", "output", "command", "applied")))
            self._show(self.record)
        setpoints, outputs = np.array(self._setpoints), np.array(self._outputs)
        added_to = setpoints, setpoints - outputs, outputs, np.zeros(len(outputs))
        windows = zip(added_to, self.parameters.windows, strict=True)
        shift = np.concatenate([each[:length] for each, length in windows]).astype(np.float32)
        if shift.any():
            observation = observation + shift
        return observation, float(reward), terminated, truncated, info
