"""List the controllers that the commands can run, as records of the class `ControllerSpec`.

The command `compare` can run each controller of the roster. The command `tune` can search the
gains of each controller whose record has `spans`. The option `--agent NAME=MODULE:FACTORY` of
`compare` makes a record for a user's own controller.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from agents import (
    DahlinController,
    DirectNNController,
    PIController,
    PolicyNetwork,
    SelfTuningController,
    SmithPredictor,
)
from agents.networks import PRETRAINED
from agents.pi import SEARCHED_GAINS
from benchmarks.controllers import plant_scale
from benchmarks.controllers.mpc import PredictiveController
from benchmarks.controllers.spec import (
    BANK,
    DATA_SHEET,
    DIRECTION,
    EVERYTHING,
    LIMITS,
    ROBUSTNESS,
    STEP_TEST,
    ControllerSpec,
)
from benchmarks.loop.rollout import Agent, IdleValve
from mptc_gym import PRESETS, Parameters

# Default ratio of the closed-loop time constant of Dahlin's controller to the plant's time
# constant. The small ratio makes the control loop fast; the filter time constant makes the
# control loop robust.
LAMBDA = 0.1
# The colours and markers that a user's own controllers get in turn.
OWN_LOOKS = ("#5B3FA6", "P"), ("#B22222", "X"), ("#3B7A2B", "8"), ("#17798C", "d")


def self_tuning(*, widest_dead_zone: float, **prior_knowledge: Any) -> Agent:
    """Return a self-tuning controller that assumes the largest dead zone of the plant.

    `widest_dead_zone` is the largest half width of the dead zone that the plant can have, t/h,
    and `prior_knowledge` are all further arguments of `SelfTuningController`.
    """
    return SelfTuningController(dead_zone=widest_dead_zone, **prior_knowledge)


def dahlin(*, time_constant: float, **arguments: Any) -> Agent:
    """Return Dahlin's controller for a plant.

    `time_constant` is the time constant of the plant, s, and `arguments` are all further
    arguments of `DahlinController`. The default of `closed_loop_time_constant` is `LAMBDA`
    times the plant's time constant.
    """
    arguments.setdefault("closed_loop_time_constant", LAMBDA * time_constant)
    return DahlinController(time_constant=time_constant, **arguments)


def with_policy(parameters: Parameters, network: PolicyNetwork, **limits: Any) -> Agent:
    """Return a trained policy, adapted to the actuator of a plant.

    `limits` has the flow limits `u_min` and `u_max` of the returned policy, t/h. If the policy
    was trained to compensate for a dead zone, the returned policy compensates for the dead zone
    in `parameters` instead, unless the dead zone in `parameters` is a range.
    """
    increments = network.increments
    dead_zone = parameters.dead_zone
    if increments and increments.dead_zone and not isinstance(dead_zone, Sequence):
        increments = replace(increments, dead_zone=dead_zone)
    return replace(network, increments=increments, **limits)


def trained(files: str) -> Mapping[str, PolicyNetwork]:
    """Return trained policies, by the name of the policy's file.

    The files lie in the folder `agents/pretrained`, and have names that match the pattern
    `files`, such as "ppo-*.npz".
    """
    return {file.name: PolicyNetwork.load(file) for file in PRETRAINED.glob(files)}


# Texts for reports: what a controller knows, and how the controller was searched or trained. In
# reports, 1 M samples are a million samples.
_KNOWS_STEP_TEST = "gain, time constant, delay"
_KNOWS_DATA_SHEET = f"{_KNOWS_STEP_TEST}, dead zone, limits"
_KNOWS_SIGN = "sign of the gain; settings searched on the paper's plant"
_NN_SEARCH = (
    "25 weights in the run itself; 6 settings by the search of version 0.1; the present search "
    "takes 800 trials: 566 M samples, 6 min"
)
_KNOWS_HOLDS = "hold times of random set points"
_TUNING_RULE = f"one time constant, by a tuning rule and an Ms of {ROBUSTNESS:g}; one step test"
_SPECS = (
    ControllerSpec(
        name="idle",
        label="idle valve",
        look=("#8C8C8C", "x"),
        build=IdleValve,
        knows="nothing",
        searched="nothing",
        observation={},
        compared=False,
    ),
    ControllerSpec(
        name="nn",
        label="NN (1992)",
        look=("#D55E00", "o"),
        build=DirectNNController,
        prior_knowledge=DIRECTION,
        knows=_KNOWS_SIGN,
        searched=_NN_SEARCH,
        assumes=("scale",),
        random=True,
        learns=True,
        spans=plant_scale.nn_spans,
        pictured=True,
    ),
    ControllerSpec(
        name="pi",
        label="PI (1992)",
        look=("#CC79A7", "s"),
        build=PIController,
        knows="gains of the paper, for its plant",
        searched="2 gains; the paper does not say how they were found",
        linear=True,
        assumes=("direction", "scale"),
        spans=plant_scale.pi_spans,
        pictured=True,
    ),
    ControllerSpec(
        name="pi-simc",
        label="PI (SIMC)",
        look=("#9B2F8C", "h"),
        build=PIController.simc,
        prior_knowledge=STEP_TEST,
        knows=_KNOWS_STEP_TEST,
        searched=_TUNING_RULE,
        tuned_by="closed_loop_time_constant",
        linear=True,
    ),
    ControllerSpec(
        name="pi-searched",
        label="PI (searched)",
        look=("#5A1220", "p"),
        build=partial(PIController, kp=SEARCHED_GAINS["kp"], ki=SEARCHED_GAINS["ki"]),
        knows="gains searched on the paper's plant",
        searched="2 gains by an earlier version of the search; the present search takes 800 "
        "trials: 566 M samples, 3 min",
        linear=True,
        assumes=("direction", "scale"),
    ),
    ControllerSpec(
        name="smith",
        label="Smith",
        look=("#56B4E9", "^"),
        build=SmithPredictor,
        prior_knowledge=DATA_SHEET,
        knows=_KNOWS_DATA_SHEET,
        searched=_TUNING_RULE,
        tuned_by="closed_loop_time_constant",
        linear=True,
    ),
    ControllerSpec(
        name="dahlin",
        label="Dahlin",
        look=("#003F7D", "<"),
        build=dahlin,
        prior_knowledge=DATA_SHEET,
        knows=_KNOWS_DATA_SHEET,
        searched=f"{_TUNING_RULE}; closed-loop time constant by hand: a tenth of the plant's",
        tuned_by="filter_time_constant",
        linear=True,
        spans=plant_scale.dahlin_spans,
        pictured=True,
    ),
    ControllerSpec(
        name="self-tuning",
        label="self-tuning",
        look=("#5FCF9F", "v"),
        build=self_tuning,
        prior_knowledge=BANK,
        knows=f"{_KNOWS_DATA_SHEET}; delay range; {_KNOWS_HOLDS}",
        searched="about 70 settings by hand; one step test",
    ),
    ControllerSpec(
        name="mpc",
        label="MPC",
        look=("#000000", "*"),
        build=PredictiveController,
        prior_knowledge=EVERYTHING,
        knows="everything except the future",
        searched="nothing",
    ),
    ControllerSpec(
        name="ppo",
        label="PPO",
        look=("#E69F00", "D"),
        build=with_policy,
        prior_knowledge=("parameters", *LIMITS),
        knows="dead zone; trained on a simulator of the paper's plant",
        searched="388 weights on the paper's plant: 5 M samples a policy; settings by 79 "
        "trials: 121 M samples, 30 min",
        assumes=("direction", "scale"),
        networks=partial(trained, "ppo-[0-9]*.npz"),
        pictured=True,
    ),
    ControllerSpec(
        name="ppo-hard",
        label="PPO (hard)",
        look=("#8F6200", "D"),
        build=with_policy,
        prior_knowledge=("parameters", *LIMITS),
        knows="limits; trained on a simulator of the plants of the preset hard",
        searched="12,608 weights on plants that vary: 4 M samples a policy; settings by 43 "
        "trials: 36 M samples, 12 min",
        assumes=("direction", "scale"),
        made_for=PRESETS["hard"],
        networks=partial(trained, "ppo-hard-*.npz"),
    ),
)

ROSTER = {spec.name: spec for spec in _SPECS}
"""All controllers by name."""


def label(agent: str) -> str:
    """Return the name of a controller in tables and pictures, such as "MPC" for "mpc".

    `agent` is the controller's name in options. In tables and pictures, a user's own controller
    has the same name as in options.
    """
    return ROSTER[agent].label if agent in ROSTER else agent


def looks(agents: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Return the colour and the marker, for matplotlib, of each controller by its name.

    Users' own controllers, which are not in `ROSTER`, get the colours and markers of
    `OWN_LOOKS` in alphabetical order of the names, so that the order of `agents` does not
    matter.
    """
    own_names = sorted(agent for agent in agents if agent not in ROSTER)
    own_looks = dict(zip(own_names, itertools.cycle(OWN_LOOKS), strict=False))
    return {agent: own_looks.get(agent) or ROSTER[agent].look for agent in agents}
