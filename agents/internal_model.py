"""Define what controllers with a model of the plant inside them have in common."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agents.actuator import applied_flow, avoid_dead_zone
from agents.controller import ModelBasedController, Values

Array = NDArray[np.float64]


@dataclass(eq=False, kw_only=True)
class InternalModelController(ModelBasedController):
    """A controller that runs a model of the plant beside it.

    The model is of first order, with a delay. Its input is the flow that the actuator passes,
    after the dead zone and the limits; so its outputs are right whatever was commanded. The
    parameters are those of `ModelBasedController`.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        self._edge = self.dead_zone
        self._pole = math.exp(-self.sampling_interval / self.time_constant)
        self._input_gain = self.gain * (1.0 - self._pole)  # degC per t/h and sample
        self._delay = max(round(self._delay_samples), 1)

    def reset(self) -> None:
        """Return the model to rest."""
        super().reset()
        self._outputs: list[Values] = []  # of the undelayed model, degC; the newest is last

    @property
    def _undelayed(self) -> Values:
        """Output of the model without its delay, degC: all inputs so far have arrived."""
        return self._outputs[-1] if self._outputs else np.float64(0.0)

    @property
    def _delayed(self) -> Values:
        """Output of the model with its delay, degC: what the plant should show now."""
        return self._outputs[0] if self._outputs else np.float64(0.0)

    def _passable(self, command: Array) -> Array:
        """Return the command, moved to 0 or the edge of the dead zone if it is inside, t/h."""
        passable: Array = avoid_dead_zone(command, self.dead_zone)
        return passable

    def _advance(self, command: Array) -> None:
        """Let the model take a sample with what the actuator passes of a command, t/h."""
        applied = applied_flow(command, self.dead_zone, self.u_min, self.u_max)
        outputs = self._outputs or [np.float64(0.0)] * self._delay
        newest = self._pole * outputs[-1] + self._input_gain * applied
        self._outputs = [*outputs[1:], newest]
