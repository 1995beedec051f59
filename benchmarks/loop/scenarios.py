"""Define the cases of comparisons, the options that choose a plant, and random plants.

A case (a scenario in the code) is a plant, a set point and a length of the runs.
"""

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from benchmarks.lib.command import Parameter, options
from benchmarks.lib.errors import UsageError
from benchmarks.loop.linear import nominal
from mptc_gym import PRESETS, Parameters
from mptc_gym.plant.parameters import slowest_pole

Arguments = dict[str, Any]  # keyword arguments of the environment `MiddlePoint-v0`


@dataclass(frozen=True)
class Scenario:
    """A case: a plant, a set point and a length of the runs.

    Attributes
    ----------
    name : str
        The name of the case in options and files.
    title : str
        The name of the case in reports and pictures.
    samples : int
        Length of a run, in samples.
    arguments : dict
        The arguments of the environment that define the plant and the set point. All other
        arguments have their defaults.
    """

    name: str
    title: str
    samples: int
    arguments: Arguments

    @property
    def parameters(self) -> Parameters:
        """All arguments of the environment, those with default values included."""
        return Parameters(**self.arguments)


SETPOINTS = (
    Scenario("square", "square wave", 1200, {}),
    Scenario("constant", "constant set point", 600, {"setpoint": 5.0}),
)
"""The set points of the paper's cases, on the environment's default plant.

Only the figures of the paper show set points. Two set points are used here: the environment's
square wave, which is +5 degC for 300 samples and -5 degC for the next 300 samples, over two
periods; and a constant set point of 5 degC.
"""

_CONSTANT = SETPOINTS[1].arguments
SCENARIOS = {
    "square": Scenario(
        "square",
        "square wave, dead zone 5 t/h, no noise (Figs 5 and 10)",
        1200,
        PRESETS["paper"],
    ),
    "square-dead-zone-7": Scenario(
        "square-dead-zone-7",
        "square wave, dead zone 7 t/h, no noise (Figs 6 and 7)",
        1200,
        PRESETS["dead-zone-7"],
    ),
    "square-noise": Scenario(
        "square-noise",
        "square wave, dead zone 5 t/h, R = 0.5 °C² (Figs 8, 9 and 11)",
        1200,
        PRESETS["noisy"],
    ),
    "constant": Scenario(
        "constant",
        "constant set point, dead zone 5 t/h, no noise (Figs 5 and 10)",
        600,
        {**PRESETS["paper"], **_CONSTANT},
    ),
    "constant-dead-zone-7": Scenario(
        "constant-dead-zone-7",
        "constant set point, dead zone 7 t/h, no noise (Figs 6 and 7)",
        600,
        {**PRESETS["dead-zone-7"], **_CONSTANT},
    ),
    "constant-noise": Scenario(
        "constant-noise",
        "constant set point, dead zone 5 t/h, R = 0.5 °C² (Figs 8, 9 and 11)",
        600,
        {**PRESETS["noisy"], **_CONSTANT},
    ),
    # Rejecting load steps is the usual work of a boiler's controller. At a set point of 5 degC,
    # the flow that the controller needs stays outside the dead zone.
    "load": Scenario(
        "load",
        "load steps within ±1.5 °C at a held set point, dead zone 5 t/h, no noise",
        1200,
        {**_CONSTANT, "disturbance_amplitude": 1.5, "disturbance_interval": 200.0},
    ),
}
"""The cases of the paper, and steps of the load, by name."""
PRESET_SCENARIOS = {
    name: Scenario(name, f"preset {name}", 1200, dict(arguments))
    for name, arguments in PRESETS.items()
}


@options
@dataclass(frozen=True, kw_only=True)
class PlantOptions:
    """Options that choose the plant: by a file, a preset or single arguments."""

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
        """Short description of the chosen plant; "" if no option chooses a plant."""
        file = self.plant.stem if self.plant else None
        return ", ".join(filter(None, [self.preset, file, *self.set]))

    def words(self) -> list[str]:
        """Return the words of a command line, such as "--preset", "hard", for these options."""
        words: list[str] = []
        if self.preset:
            words += ["--preset", self.preset]
        if self.plant:
            words += ["--plant", str(self.plant)]
        for argument in self.set:
            words += ["--set", argument]
        return words

    def cases(self, default: Mapping[str, Scenario]) -> Mapping[str, Scenario]:
        """Return the cases of the chosen plant by name, or `default` if no plant is chosen.

        There is one case for each of the `SETPOINTS`, called "square" and "constant". But if
        the user's arguments of the plant define a set point, there is one case with this set
        point, called "run".
        """
        arguments = self.arguments()
        if not self.name:
            return default
        setpoints: tuple[Scenario, ...] = SETPOINTS
        if {"setpoint", "setpoint_amplitude", "setpoint_period"} & set(arguments):
            setpoints = (Scenario("run", "the set point of the plant's arguments", 1200, {}),)
        cases = {}
        for setpoint in setpoints:
            title = f"{setpoint.title}, {self.name}"
            combined = {**arguments, **setpoint.arguments}
            cases[setpoint.name] = replace(setpoint, title=title, arguments=combined)
        return cases

    def arguments(self) -> Arguments:
        """Return the arguments of the environment that the user has chosen.

        A `UsageError` names the option if an argument of the environment is unknown or invalid,
        or if the plant is unstable.
        """
        arguments: Arguments = {}
        if self.preset:
            arguments |= PRESETS[self.preset]
        if self.plant:
            arguments |= _read_plant(self.plant)
        for text in self.set:
            name, equals, value = text.partition("=")
            if not (name and equals):
                raise UsageError(f"--set must be ARGUMENT=VALUE, got {text!r}")
            arguments[name] = value  # a bare word, such as random
            with suppress(ValueError):
                arguments[name] = json.loads(value)
        options = [f"--{name}" for name in ("plant", "preset", "set") if getattr(self, name)]
        try:
            a = Parameters.of_environment(arguments).a
            if abs(slowest_pole(a) or 0.0) > 1.0:
                raise ValueError(
                    "a must not have a root beyond the unit circle, as no controller of this "
                    f"checkout holds such a plant, got {list(a)}"
                )
        except (TypeError, ValueError) as error:  # A TypeError names an unknown argument.
            raise UsageError(f"{', '.join(options)}: {error}") from error
        return arguments


def _read_plant(file: Path) -> Arguments:
    """Return the arguments of the environment in a JSON file, the value of `--plant`."""
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        return dict(**content)  # a TypeError if `content` is no mapping
    except (OSError, TypeError, ValueError) as error:
        allowed = 'a JSON file of arguments, such as {"delay": 20}'
        raise UsageError(f"--plant: {file} must be {allowed}: {error}") from error


# Ranges of the random plants that `random_design` returns, by argument of the environment. With
# a gain factor below 0.74, the largest flow could not keep the temperature at 5 degC.
SPANS = {
    "delay": (6, 36),
    "dead_zone": (0.0, 8.0),
    "noise_variance": (0.0, 1.0),
    "gain_factor": (0.75, 1.6),
    "time_constant_factor": (0.5, 2.0),
}
# The factors that drift in half of the random plants, and the argument for each factor's drift.
DRIFTS = {"gain_factor": "gain_drift", "time_constant_factor": "time_constant_drift"}


def random_design(count: int, seed: int, samples: int) -> list[Arguments]:
    """Return `count` random plants: for each, the values of its arguments, drawn from `SPANS`.

    The values form a Latin hypercube with the seed `seed`. The second half of the plants drift:
    the factors of gain and time constant change, over `samples` samples, to other values within
    `SPANS`.
    """
    from scipy.stats.qmc import LatinHypercube  # here: slow to import

    # A plant's row has the values of all arguments, and then the factors at the end of a drift.
    spans = [*SPANS.values(), *(SPANS[factor] for factor in DRIFTS)]
    low, high = np.array(spans).T
    shares = LatinHypercube(len(spans), rng=np.random.default_rng(seed)).random(count)
    rows = (low + shares * (high - low)).round(4).tolist()
    plants: list[Arguments] = []
    for i, row in enumerate(rows):
        plant = dict(zip(SPANS, row, strict=False))  # without the factors after a drift
        plant["delay"] = round(plant["delay"])
        if i >= count // 2:
            final_factors = row[len(SPANS) :]
            for factor, final_factor in zip(DRIFTS, final_factors, strict=True):
                plant[DRIFTS[factor]] = final_factor / plant[factor]
            plant["drift_samples"] = samples
        plants.append(plant)
    return plants


def around(nominal_plant: Arguments, variations: Sequence[Arguments]) -> list[Arguments]:
    """Convert variations of the paper's plant to variations of another plant.

    If a variation has twice the delay of the paper's plant, then the returned variation has
    twice the delay of the other plant. Dead zone, gain factor and time constant factor are
    scaled in the same way. The noise variance is scaled with the square of the temperature
    change that the flow can cause. All other arguments keep their values.

    `nominal_plant` has the environment's arguments for the other plant. A variation has the
    arguments that differ from the nominal plant.
    """
    scales = _scales(Parameters(**nominal_plant))
    paper_scales = _scales(Parameters())
    scaled_variations: list[Arguments] = []
    for variation in variations:
        scaled = dict(variation)
        for name in SPANS:
            if name in variation:
                scaled[name] = scales[name] / paper_scales[name] * variation[name]
        scaled["delay"] = round(scaled["delay"])
        scaled_variations.append(scaled)
    return scaled_variations


def _scales(plant: Parameters) -> dict[str, float]:
    """Return a plant's value of each argument in `SPANS`, with which `around` scales.

    If an argument of the plant has a range, the value is the middle of the range. In place of
    the noise variance, which may be 0, the result has the square of the temperature change by
    half the range of the flow, degC^2.
    """
    model = nominal(plant)
    reach = float(model.gain) * (model.numbers.u_max - model.numbers.u_min) / 2.0  # degC
    scales = {**vars(model.numbers), "noise_variance": reach**2}
    return {name: float(scales[name]) for name in SPANS}
