"""Define `KnownPlant`: what a controller may know about a plant before a run."""

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, TypeVar

from benchmarks.lib.command import CommandError
from benchmarks.loop.linear import (
    ROBUSTNESS,
    SLOWEST_LOOP,
    LinearController,
    LinearModel,
    nominal,
    step_test,
    time_constant_for,
)
from mptc_gym import Parameters
from mptc_gym.plant.signals import SetPointLevels

Tuned = TypeVar("Tuned", bound=LinearController)


class KnownPlant:
    """A plant whose quantities a controller can look up before a run.

    If arguments of the environment are ranges, the quantities are those of the nominal plant,
    which has the middle value of each range, unless a quantity says otherwise.

    Parameters
    ----------
    arguments
        Arguments of the environment that differ from the defaults.

    Attributes
    ----------
    arguments : dict
        Arguments of the environment that differ from the defaults.
    parameters : Parameters
        All arguments of the environment, with the defaults filled in.
    limits : dict
        Limits of the flow, `u_min` and `u_max`, t/h.
    dead_zone, widest_dead_zone : float
        Half width of the dead zone, and the largest half width of a range, t/h.
    delay_range : tuple of float, optional
        Shortest and longest delay, s; None if the delay is not a range.
    setpoint_holds : tuple of float, optional
        Shortest and longest time between changes of the set point, s; None if the set point is
        not random.
    """

    def __init__(self, arguments: Mapping[str, Any]) -> None:
        parameters = Parameters(**arguments)
        self.arguments = dict(arguments)
        self.parameters = parameters
        # These are never ranges.
        self.limits: dict[str, Any] = {"u_min": parameters.u_min, "u_max": parameters.u_max}
        self.dead_zone = sum(parameters.range_of("dead_zone")) / 2
        self.widest_dead_zone = parameters.range_of("dead_zone")[1]
        interval = parameters.sampling_interval
        self.delay_range: tuple[float, float] | None = None
        if isinstance(parameters.delay, Sequence):
            # A flow first affects the output one sample after the argument `delay`.
            shortest, longest = parameters.delay
            self.delay_range = (shortest + 1) * interval, (longest + 1) * interval
        self.setpoint_holds: tuple[float, float] | None = None
        levels = SetPointLevels(parameters)
        if levels.random:
            self.setpoint_holds = levels.shortest * interval, levels.longest * interval

    @cached_property
    def step_test(self) -> dict[str, Any]:
        """What a step test gives: `gain`, `time_constant`, `delay` and `sampling_interval`.

        The function `benchmarks.loop.linear.step_test` describes the numbers and their units.
        """
        return {**step_test(self.parameters)}

    @cached_property
    def model(self) -> LinearModel:
        """The exact model of the nominal plant, by which engineers tune their controllers."""
        return nominal(self.parameters)

    @property
    def gain(self) -> float:
        """Exact steady-state gain, degC per t/h."""
        return float(self.model.gain)

    @property
    def direction(self) -> int:
        """1 if the steady temperature rises with the flow, and -1 otherwise."""
        return 1 if self.gain > 0.0 else -1

    @property
    def temperature_range(self) -> float:
        """Change of the steady temperature by half the range of the flow, degC."""
        half_range = float(self.model.numbers.u_max - self.model.numbers.u_min) / 2.0
        return abs(self.gain) * half_range

    def robust(self, build: Callable[[float], Tuned]) -> Tuned:
        """Return the fastest controller whose control loop is robust enough.

        The control loop with the nominal plant is robust enough if its maximum sensitivity Ms
        is at most `ROBUSTNESS`. The time constant is rounded to four digits, so that all
        machines build the same controller. The rounding can raise Ms slightly.

        Parameters
        ----------
        build
            Function that takes a time constant, s, and returns a controller. With a larger time
            constant, the control loop must be more robust.
        """
        # All useful time constants are between `fastest` and `slowest`, s.
        test = self.step_test
        slowest = SLOWEST_LOOP * (test["time_constant"] + test["delay"])
        fastest = 0.1 * test["sampling_interval"]
        try:
            exact = time_constant_for(ROBUSTNESS, build, self.model, slowest, fastest)
        except ValueError as error:  # The plant resonates too much for this controller.
            raise CommandError(str(error)) from error
        return build(float(f"{exact:.4g}"))


PAPER = KnownPlant({})  # the paper's plant
