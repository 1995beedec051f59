"""What is known of a controller, and how it is trained: the records that the roster holds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast

from benchmarks.controllers.factories import Factory, load, load_factory
from benchmarks.lib.fan_out import FanOut

POLICIES = Path("results/policies")  # where trained policies are kept


@dataclass(frozen=True)
class Account:
    """What a controller costs before it runs.

    Attributes
    ----------
    prior_knowledge
        What it is told about the plant.
    parameters
        How many numbers shape it: gains, and weights if it has any.
    samples
        Samples of the plant, or of a simulated one, that went into tuning and training.
    """

    prior_knowledge: str = ""
    parameters: str = ""
    samples: str = ""


@dataclass(frozen=True)
class Tuning:
    """How the gains of a controller are searched.

    Attributes
    ----------
    space
        Name of a gain: lowest and highest value. Gains are searched on a logarithmic scale.
    trials, startup
        Number of trials, and how many of them are at random before the sampler learns.
    finalists
        How many of the best are judged again.
    penalty
        For failing to settle at a constant set point, degC: what doing nothing about 5 degC
        costs.
    members
        How many controllers are made of the same gains, in the search and at last. Their
        objectives are averaged.
    make
        "module:function", called with the gains, `final` (whether they are judged for the last
        time) and `member` (the number of the controller); returns a factory. By default the
        controller's own factory gets the gains as arguments.
    """

    space: Mapping[str, tuple[float, float]]
    trials: int = 800
    startup: int = 200
    finalists: int = 10
    penalty: float = 5.0
    members: tuple[int, int] = (1, 1)
    make: str = ""


@dataclass(frozen=True)
class Training:
    """How controllers that need training are to be had.

    Attributes
    ----------
    fan_out
        Runs the trainings.
    folder
        Where trained policies are kept.
    steps
        Samples of experience; None for as many as the training has by default.
    members
        How many policies, which differ in their seeds; None for the default.
    retrain
        Whether to train even where a finished policy is at hand.
    """

    fan_out: FanOut = field(default_factory=lambda: FanOut(1))
    folder: Path = POLICIES
    steps: int | None = None
    members: int | None = None
    retrain: bool = False


@dataclass(frozen=True)
class Controller:
    """A controller and all that any command has to know of it.

    Attributes
    ----------
    name
        In options and files.
    label
        In tables and plots.
    factory
        "module:factory"; see `load_factory`. Empty if `trained` is given.
    trained
        "module:function", called with a `Training`; returns factories, one for each policy.
        They may have attributes `provenance`, a dict for JSON, and `curve`, the learning curve
        as a list of rows.
    in_service
        "module:factory" of the controller as `sweep` meets it, if it is another one: one that
        has learnt on the plant that it was made for.
    account
        What it costs before it runs.
    tuning
        How its gains are searched, if they are.
    compared, swept
        Whether `compare` and `sweep` run it unless told otherwise.
    drawn
        Whether its responses are drawn in a comparison.
    """

    name: str
    label: str
    factory: str = ""
    trained: str = ""
    in_service: str = ""
    account: Account = Account()
    tuning: Tuning | None = None
    compared: bool = True
    swept: bool = False
    drawn: bool = False

    def members(self, training: Training | None = None) -> list[Factory]:
        """Return the factories of its members: one, or several that were trained apart."""
        if self.trained:
            return cast("list[Factory]", load(self.trained)(training or Training()))
        return [load_factory(self.factory)]

    def members_in_service(self, training: Training | None = None) -> list[Factory]:
        """Return its members as they come to plants that they were not made for."""
        if self.in_service:
            return [load_factory(self.in_service)]
        return self.members(training)
