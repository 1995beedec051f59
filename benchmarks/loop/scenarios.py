"""Define the cases of comparisons, and the options that choose a plant.

A case, or scenario, consists of a plant, a set point and a length of the runs.
"""

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from benchmarks.lib.command import CommandError, Parameter, options
from benchmarks.loop.linear import unfit
from mptc_gym import PRESETS, Parameters
from mptc_gym.plant.parameters import EPISODE_STEPS, INTERFACE

Arguments = dict[str, Any]  # keyword arguments of the environment `MiddlePoint-v0`


@dataclass(frozen=True)
class Scenario:
    """A case of a comparison: a plant, a set point and a length of the runs.

    Attributes
    ----------
    name : str
        Name of the case in options and files.
    title : str
        Name of the case in reports and pictures.
    samples : int
        Length of a run, in samples.
    arguments : dict
        Arguments of the environment that differ from the defaults, for the plant and the set
        point.
    heading : str
        Short name of the case in tables on the screen; "" for `name`.
    """

    name: str
    title: str
    samples: int
    arguments: Arguments
    heading: str = ""

    @property
    def parameters(self) -> Parameters:
        """All arguments of the environment for this case, with the defaults filled in."""
        return Parameters(**self.arguments)


SETPOINTS = (
    Scenario("square", "square wave", EPISODE_STEPS, {}),
    Scenario("constant", "constant set point", 600, {"setpoint": 5.0}),
)
"""The set points of the paper's cases, with the environment's default plant.

The paper shows set points only in figures. The set points here are a square wave, which is
+5 degC for 300 samples and -5 degC for the next 300 samples, over two periods, and a constant
set point of 5 degC.
"""

_CONSTANT = SETPOINTS[1].arguments
SCENARIOS = {
    "square": Scenario(
        "square",
        "square wave, dead zone 5 t/h, no noise (Figs 5 and 10)",
        EPISODE_STEPS,
        PRESETS["paper"],
    ),
    "square-dead-zone-7": Scenario(
        "square-dead-zone-7",
        "square wave, dead zone 7 t/h, no noise (Figs 6 and 7)",
        EPISODE_STEPS,
        PRESETS["dead-zone-7"],
        "square zone 7",
    ),
    "square-noise": Scenario(
        "square-noise",
        "square wave, dead zone 5 t/h, R = 0.5 °C² (Figs 8, 9 and 11)",
        EPISODE_STEPS,
        PRESETS["noisy"],
        "square noise",
    ),
    "constant": Scenario(
        "constant",
        "constant set point, dead zone 5 t/h, no noise (Figs 5 and 10)",
        600,
        {**PRESETS["paper"], **_CONSTANT},
        "const",
    ),
    "constant-dead-zone-7": Scenario(
        "constant-dead-zone-7",
        "constant set point, dead zone 7 t/h, no noise (Figs 6 and 7)",
        600,
        {**PRESETS["dead-zone-7"], **_CONSTANT},
        "const zone 7",
    ),
    "constant-noise": Scenario(
        "constant-noise",
        "constant set point, dead zone 5 t/h, R = 0.5 °C² (Figs 8, 9 and 11)",
        600,
        {**PRESETS["noisy"], **_CONSTANT},
        "const noise",
    ),
    # Rejecting load steps is the usual work of a boiler's controller. At a set point of 5 degC,
    # the flow that the controller needs stays outside the dead zone.
    "load": Scenario(
        "load",
        "load steps within ±1.5 °C at a held set point, dead zone 5 t/h, no noise",
        EPISODE_STEPS,
        {**_CONSTANT, "disturbance_amplitude": 1.5, "disturbance_interval": 200.0},
    ),
}
"""The cases of the paper, and a case with steps of the load, by name."""
_HEADINGS = {"dead-zone-7": "dead zone 7", "disturbed": "disturb.", "randomised": "random."}
PRESET_SCENARIOS = {
    name: Scenario(
        name, f"preset {name}", EPISODE_STEPS, dict(arguments), _HEADINGS.get(name, "")
    )
    for name, arguments in PRESETS.items()
}


@options
@dataclass(frozen=True, kw_only=True)
class PlantOptions:
    """Options that choose the plant by a file, by a preset or by single arguments."""

    plant: Path | None = None
    """JSON file with arguments of the environment."""
    preset: Annotated[str | None, Parameter(choices=PRESETS)] = None
    """Name of a plant that the environment defines, such as hard."""
    set: tuple[str, ...] = ()
    """An argument of the environment, such as delay=30 or delay=[12,24] (repeatable;
    overrides --plant, which overrides --preset)."""

    @property
    def name(self) -> str:
        """Description of the chosen plant, such as "hard, delay=30"; "" if none is chosen."""
        file = self.plant.stem if self.plant else None
        return ", ".join(filter(None, [self.preset, file, *self.set]))

    @property
    def words(self) -> list[str]:
        """The words on a command line that choose this plant, such as ["--preset", "hard"]."""
        words: list[str] = []
        if self.plant:
            words += ["--plant", str(self.plant)]
        if self.preset:
            words += ["--preset", self.preset]
        for argument in self.set:
            words += ["--set", argument]
        return words

    def cases(self, default: Mapping[str, Scenario]) -> Mapping[str, Scenario]:
        """Return the cases of the chosen plant by name, or `default` if no plant is chosen.

        The cases of a chosen plant are "square" and "constant", as in `SETPOINTS`, but with the
        amplitude and the period of the plant's arguments. If the arguments of the chosen plant
        have a `setpoint`, the only case is "run", with this set point.
        """
        arguments = self.arguments()
        if not self.name:
            return default
        cases: tuple[Scenario, ...] = SETPOINTS
        if "setpoint" in arguments:
            cases = (
                Scenario("run", "the set point of the plant's arguments", EPISODE_STEPS, {}),
            )
        cases_by_name = {}
        for case in cases:
            title = f"{case.title}, {self.name}"
            combined = dict(arguments)
            if case.name == "constant":
                combined["setpoint"] = Parameters(**arguments).setpoint_amplitude
            cases_by_name[case.name] = replace(case, title=title, arguments=combined)
        return cases_by_name

    def arguments(self) -> Arguments:
        """Return the arguments of the environment that --preset, --plant and --set choose.

        A `CommandError` is raised if an argument is unknown or invalid, or not one of the
        plant, if the plant is not for these commands, or if the file cannot be read.
        """
        arguments: Arguments = {}
        if self.preset:
            arguments |= PRESETS[self.preset]
        if self.plant:
            arguments |= _read_plant(self.plant)
        for text in self.set:
            name, _, value = text.partition("=")
            arguments[name] = value  # a bare word, such as random
            with suppress(ValueError):
                arguments[name] = json.loads(value)
        interface = [name for name in INTERFACE if name in arguments]
        if interface:
            raise CommandError(
                f"--plant, --set: {', '.join(interface)} must be left out, as each controller "
                "has its own observations and actions"
            )
        try:
            reason = unfit(Parameters(**arguments))
        except (TypeError, ValueError) as error:  # A TypeError names an unknown argument.
            raise CommandError(f"--plant, --preset, --set: {error}") from error
        if reason:
            raise CommandError(f"--plant, --preset, --set: {reason}")
        return arguments


def _read_plant(file: Path) -> Arguments:
    """Return the arguments of the environment in a JSON file that `--plant` names.

    A `CommandError` is raised if the file cannot be read, or does not contain a mapping.
    """
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        return dict(**content)  # a TypeError if `content` is no mapping
    except (OSError, TypeError, ValueError) as error:
        allowed = 'a JSON file of arguments, such as {"delay": 20}'
        raise CommandError(f"--plant: {file} must be {allowed}: {error}") from error
