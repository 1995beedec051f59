"""Define the cases, the options that choose a plant, and designs of other plants.

A design is a set of plants around the paper's: a grid over delay and gain, or drawn at random.
"""

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from benchmarks.lib.command import Parameter, options
from benchmarks.lib.errors import UsageError
from benchmarks.loop.linear import nominal
from mptc_gym import PRESETS, Parameters
from mptc_gym.parameters import slowest_pole

Arguments = dict[str, Any]  # of the environment


@dataclass(frozen=True)
class Scenario:
    """A case: the length of a run, and arguments of the environment beyond the defaults."""

    name: str
    title: str
    samples: int
    arguments: dict[str, Any]

    @property
    def parameters(self) -> Parameters:
        """All arguments of the environment."""
        return Parameters(**self.arguments)


# The text of the paper describes the plants; only its figures show the set point. Two set
# points are used here: the environment's square wave between +5 and -5 degC, 300 samples each,
# over two periods; and a step to 5 degC.
_PLANTS = (
    ("", "paper", "dead zone 5 t/h, no noise (Figs 5 and 10)"),
    ("-dead-zone-7", "dead-zone-7", "dead zone 7 t/h, no noise (Figs 6 and 7)"),
    ("-noise", "noisy", "dead zone 5 t/h, R = 0.5 °C² (Figs 8, 9 and 11)"),
)
SETPOINTS: tuple[tuple[str, str, int, dict[str, Any]], ...] = (
    ("square", "square wave", 1200, {}),
    ("constant", "constant set point", 600, {"setpoint": 5.0}),
)
SCENARIOS = {
    setpoint + suffix: Scenario(
        setpoint + suffix, f"{title}, {plant}", samples, {**PRESETS[preset], **arguments}
    )
    for setpoint, title, samples, arguments in SETPOINTS
    for suffix, preset, plant in _PLANTS
} | {
    # A boiler's daily duty. At 5 degC the required flow stays outside the dead zone.
    "load": Scenario(
        "load",
        "load steps within ±1.5 °C at a held set point, dead zone 5 t/h, no noise",
        1200,
        {"setpoint": 5.0, "disturbance_amplitude": 1.5, "disturbance_interval": 200.0},
    )
}
PRESET_SCENARIOS = {
    name: Scenario(name, f"preset {name}", 1200, dict(arguments))
    for name, arguments in PRESETS.items()
}


@options
@dataclass(frozen=True, kw_only=True)
class PlantOptions:
    """Options that choose the plant: from a file, a preset or single arguments."""

    plant: Path | None = None
    """JSON file with arguments of the environment, such as the plant.json that
    benchmarks.identify writes."""
    preset: Annotated[str | None, Parameter(choices=PRESETS)] = None
    """A plant that comes with the environment."""
    set: tuple[str, ...] = ()
    """An argument of the environment, such as delay=30 or delay=[12,24] (repeatable;
    overrides --plant, which overrides --preset)."""

    @property
    def name(self) -> str:
        """Short description of the choice; "" for the paper's plant."""
        file = self.plant.stem if self.plant else None
        return ", ".join(filter(None, [self.preset, file, *self.set]))

    def words(self) -> list[str]:
        """Return the words of a command line that make the same choice."""
        words: list[str] = []
        if self.preset:
            words += ["--preset", self.preset]
        if self.plant:
            words += ["--plant", str(self.plant)]
        for argument in self.set:
            words += ["--set", argument]
        return words

    def cases(self, others: Mapping[str, Scenario]) -> Mapping[str, Scenario]:
        """Return the cases for the chosen plant, or the others if none is chosen.

        They use the set points of the paper's cases, unless the arguments define a set point:
        then there is one case, with that set point.
        """
        arguments = self.arguments()
        if not self.name:
            return others
        own = {"setpoint", "setpoint_amplitude", "setpoint_period"} & set(arguments)
        cases = [("run", "its own set point", 1200, {})] if own else SETPOINTS
        return {
            name: Scenario(name, f"{title}, {self.name}", samples, {**arguments, **more})
            for name, title, samples, more in cases
        }

    def arguments(self) -> dict[str, Any]:
        """Return those that differ from the defaults; `UsageError` if one is invalid."""
        arguments: dict[str, Any] = dict(PRESETS[self.preset]) if self.preset else {}
        if self.plant:
            try:
                arguments |= dict(**json.loads(self.plant.read_text(encoding="utf-8")))
            except (OSError, TypeError, ValueError) as error:  # not there, no object, no JSON
                like = 'a JSON file of arguments, such as {"delay": 20}'
                raise UsageError(f"--plant: {self.plant} must be {like}: {error}") from error
        for text in self.set:
            name, equals, value = text.partition("=")
            if not (name and equals):
                raise UsageError(f"--set must be ARGUMENT=VALUE, got {text!r}")
            arguments[name] = value  # a bare word, such as random
            with suppress(ValueError):
                arguments[name] = json.loads(value)
        given = [f"--{name}" for name in ("plant", "preset", "set") if getattr(self, name)]
        try:
            a = Parameters.of_environment(arguments).a
            if abs(slowest_pole(a) or 0.0) > 1.0:
                raise ValueError(
                    "a must not have a root beyond the unit circle, as nothing holds such a "
                    f"plant, got {list(a)}"
                )
        except (TypeError, ValueError) as error:  # the first: of an unknown argument
            raise UsageError(f"{', '.join(given)}: {error}") from error
        return arguments


# Ranges of the plants drawn for sweeps and for training. With a gain factor below 0.74, 5 degC
# is beyond the limits.
SPANS = {
    "delay": (6, 36),
    "dead_zone": (0.0, 8.0),
    "noise_variance": (0.0, 1.0),
    "gain_factor": (0.75, 1.6),
    "time_constant_factor": (0.5, 2.0),
}


def random_design(count: int, seed: int, samples: int) -> list[Arguments]:
    """Return `count` plants from a Latin hypercube over `SPANS`.

    The second half of them drift: over `samples` samples, their gain and time constant move to
    other values within the spans.
    """
    from scipy.stats.qmc import LatinHypercube  # here: slow to import

    drifts = {"gain_factor": "gain_drift", "time_constant_factor": "time_constant_drift"}
    low, high = np.array([*SPANS.values(), *(SPANS[name] for name in drifts)]).T
    drawn = LatinHypercube(len(low), rng=np.random.default_rng(seed)).random(count)
    plants: list[Arguments] = []
    for row in (low + drawn * (high - low)).round(4).tolist():
        plant = dict(zip(SPANS, row, strict=False)) | {"delay": round(row[0])}
        if len(plants) >= count // 2:
            ends = zip(drifts.items(), row[len(SPANS) :], strict=True)
            plant |= {drift: end / plant[factor] for (factor, drift), end in ends}
            plant["drift_samples"] = samples
        plants.append(plant)
    return plants


def around(plant: Arguments, design: Sequence[Arguments]) -> list[Arguments]:
    """Return the plants of a design, which are around the paper's, around another plant.

    They differ from it by the same factors: the delay, the dead zone and the factors on gain
    and time constant, and the noise variance as a share of the square of what the flow reaches.
    """
    here, paper = (np.array(_scales(Parameters(**each))) for each in (plant, {}))
    factors = dict(zip(SPANS, (here / paper).tolist(), strict=True))
    moved = [{name: factors.get(name, 1.0) * each[name] for name in each} for each in design]
    whole = "delay", "drift_samples"
    return [
        each | {name: round(each[name]) for name in whole if name in each} for each in moved
    ]


def _scales(plant: Parameters) -> list[float]:
    """Return a plant's delay, dead zone, variance of the reach, and factors, as in `SPANS`."""
    model = nominal(plant)
    reach = float(model.gain) * (model.numbers.u_max - model.numbers.u_min) / 2.0
    middle = {**vars(model.numbers), "noise_variance": reach**2}
    return [middle[name] for name in SPANS]
