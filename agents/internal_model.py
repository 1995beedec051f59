"""Define the base class of controllers that run a model of the plant."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mptc_gym.plant.actuator import applied_flow, avoid_dead_zone

from .controller import ModelBasedController, Values

Array = NDArray[np.float64]


@dataclass(eq=False, kw_only=True)
class InternalModelController(ModelBasedController):
    """A controller that runs a first-order model with a delay, in parallel with the plant.

    The input of the model is the flow that leaves the actuator, after dead zone and flow
    limits, so saturation of the actuator does not make the model wrong. The parameters are
    described in `ModelBasedController`.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        self._pole = math.exp(-self.sampling_interval / self.time_constant)
        # Effect of a flow on the model's next output, degC per t/h.
        self._input_gain = self.gain * (1.0 - self._pole)
        # d + 1 samples, for the transport delay d of equation (28) of the paper.
        self._delay = max(round(self.delay / self.sampling_interval), 1)

    def reset(self) -> None:
        """Set the model's output to 0 before a new episode, as for a plant at rest."""
        super().reset()
        # Outputs x of the undelayed model at the latest samples, degC, at most `_delay` = d + 1
        # outputs from x(k-d) to x(k). In the first d samples, the oldest output is x(0) = 0,
        # which equals x(k-d) of a model that was at rest. A float until the first sample, and
        # then arrays of shape (loops,).
        self._outputs: list[Values] = [np.float64(0.0)]

    @property
    def _undelayed(self) -> Values:
        """Output x(k) of the model without its delay, degC; 0 before the first sample."""
        return self._outputs[-1]

    @property
    def _delayed(self) -> Values:
        """Output x(k-d) of the model with its delay, degC; 0 before the first sample."""
        return self._outputs[0]

    def _command(self, wanted: Array) -> Array:
        """Return the commands for wanted flows, both in t/h, and advance the model by a sample.

        A wanted flow inside the dead zone is moved to 0 or to the edge of the dead zone,
        whichever is nearer. The input of the model is the flow that the command gives.
        """
        command: Array = avoid_dead_zone(wanted, self.dead_zone)
        applied = applied_flow(command, self.dead_zone, self.u_min, self.u_max)
        self._outputs.append(self._pole * self._undelayed + self._input_gain * applied)
        if len(self._outputs) > self._delay:
            del self._outputs[0]  # no longer needed, as it is older than x(k-d)
        return command
