"""Examine the paper's claims: the runs for each, and the criteria that it must meet."""
# ruff: noqa: D103 (`claimed` says what each function examines)

import itertools
import math
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from agents import DirectNNController
from agents.pi import SEARCHED_GAINS
from benchmarks.claims.measures import WeightLog, converged_at, largest_pole
from benchmarks.claims.runs import (
    OFTEN,
    Batch,
    Finding,
    Gains,
    judge,
    judge_share,
    judge_time,
    judge_worst,
)
from benchmarks.loop import linear
from benchmarks.loop.rollout import mean_error, settled
from benchmarks.loop.scenarios import SETPOINTS as PAPER_SETPOINTS
from benchmarks.loop.scenarios import Arguments, Scenario
from mptc_gym import PRESETS, Parameters

# The meaning of words, fixed before the numbers were known and the same for all claims.
NOTABLE = 0.05  # a smaller relative change of an error is not notable
MUCH = 0.2  # "much better", "seriously worse": the error differs by at least this share
SOON = 150  # samples; the paper's own number for the convergence of the weights

SAMPLES = 1200  # of a run, unless the case says otherwise
NOISY = PRESETS["noisy"]
NOISY_SQUARE = "square wave, R = 0.5 °C²"
# The constant set point comes first, as it shows initial learning alone.
SETPOINTS = PAPER_SETPOINTS[::-1]
CONSTANT, SQUARE = (setpoint.arguments for setpoint in SETPOINTS)
LEARNING = 600  # samples after which a network counts as trained
# How a network of another shape learns, by whether its gains are scaled down.
GAINS = {False: "the same gains", True: "gains in proportion"}

Findings = Iterable[Finding]


PAPER_PI = Gains(2.2, 0.3)
SEARCHED_PI = Gains(SEARCHED_GAINS["kp"], SEARCHED_GAINS["ki"])


class Claim(NamedTuple):
    """A claim in a section of the paper, and the method by which it is examined."""

    section: str
    statement: str
    method: str
    examine: Callable[[Batch], Findings]


CLAIMS: dict[str, Claim] = {}


def claimed(
    section: str, statement: str, method: str, name: str = "", **arguments: Any
) -> Callable[[Callable[..., Findings]], Callable[..., Findings]]:
    """Return a decorator that registers a claim with the function that examines it.

    The claim's name is by default that of the function. `arguments` are passed to the function,
    besides the batch. If a function has two decorators, the lower one registers first.
    """

    def register(examine: Callable[..., Findings]) -> Callable[..., Findings]:
        claim_name = name or examine.__name__.replace("_", "-")
        CLAIMS[claim_name] = Claim(section, statement, method, partial(examine, **arguments))
        return examine

    return register


def examined(name: str, batch: Batch) -> list[Finding]:
    """Return the findings about a claim, from runs of a batch."""
    return list(CLAIMS[name].examine(batch))


@claimed(
    "Section 5, result 1",
    "The weights converge within 150 sampling intervals",
    "Converged: the distance of all weights to where they end stays below 5 % of what it was "
    "at the start, for the last 100 samples at the least.",
)
def convergence(batch: Batch) -> Findings:
    for setpoint in SETPOINTS:
        networks = batch.networks()
        log = WeightLog(networks)
        batch.run(networks, setpoint.samples, log, **setpoint.arguments)
        times = converged_at(np.array(log.rows))
        title = setpoint.title
        soon = times <= SOON
        yield judge_share(f"weights converged within {SOON} samples, {title}", soon, often=True)
        yield from judge_time(f"time until the weights have converged, {title}", times)
        never = np.isinf(times)
        yield judge_share(f"weights not converged when the run ends, {title}", never)


@claimed(
    "Section 5, result 2",
    "A dead zone of 7 t/h costs performance seriously, and the NN still works well",
    "Settled: the error stays within 5 % of the set point over the last 50 samples. Seriously: "
    "the mean error is larger by a fifth or more.",
)
def dead_zone(batch: Batch) -> Findings:
    for setpoint in SETPOINTS:
        title = setpoint.title
        small = batch.run_nn(setpoint.samples, **setpoint.arguments)
        large = batch.run_nn(setpoint.samples, **setpoint.arguments, dead_zone=7.0)
        quantity = f"settled when the run ends, dead zone 7 t/h, {title}"
        yield judge_share(quantity, settled(large), often=True)
        error_ratio = mean_error(large) / mean_error(small)
        quantity = f"mean error at dead zone 7 t/h, as a multiple of that at 5 t/h, {title}"
        yield judge(quantity, error_ratio, at_least=1 + MUCH)
        for dead_zone, runs in ((5, small), (7, large)):
            quantity = f"mean error, dead zone {dead_zone} t/h, {title}"
            yield judge(quantity, mean_error(runs), "°C")


@claimed(
    "Section 5, result 3",
    "The NN works with noise, R = 0.5, without special consideration for it",
    "It must hold the set point on average, to 5 %; must not make the temperature vary much "
    "more than it does without control; and must be better than doing nothing.",
)
def noise(batch: Batch) -> Findings:
    steady = slice(-600, None)
    idle_runs = batch.run_pi(Gains(0.0, 0.0), SAMPLES, setpoint=0.0, **NOISY)
    idle_deviation = idle_runs.output[steady].std(axis=0)
    runs = batch.run_nn(SAMPLES, **CONSTANT, **NOISY)
    errors = (runs.setpoint - runs.output)[steady]
    quantity = "absolute value of the average error over the last 600 of 1,200 samples, "
    quantity += "constant set point"
    yield judge(quantity, np.abs(errors.mean(axis=0)), "°C", at_most=0.05 * 5.0)
    quantity = "standard deviation of y over these samples, as a multiple of that without "
    quantity += "control"
    yield judge(quantity, errors.std(axis=0) / idle_deviation, at_most=1 + MUCH)
    square_errors = mean_error(batch.run_nn(SAMPLES, **SQUARE, **NOISY))
    quantity = "mean error below that without control, square wave"
    yield judge_share(quantity, square_errors < 5.0, often=True)
    yield judge("mean error, square wave", square_errors, "°C")
    yield judge("standard deviation of y without control", idle_deviation, "°C")


@claimed(
    "Section 5, after Fig. 10",
    "The paper's PI controller oscillates; a lower Kp brings no notable improvement, a higher "
    "one instability",
    "Oscillates: by 10 % of the set point and more, peak to peak, after 15 minutes and to the "
    "end. Lower: Kp from 0.1 to 2.2, with Ki = 0.3; notable is 5 % of the mean error. Higher: "
    "twice the paper's Kp.",
)
def pi_gains(batch: Batch) -> Findings:
    kp, ki = PAPER_PI
    runs = batch.run_pi(PAPER_PI, SAMPLES, **CONSTANT)
    quantity = f"peak to peak of y over the last 300 of 1,200 samples, Kp = {kp:g}, constant "
    quantity += "set point"
    yield judge(quantity, np.ptp(runs.output[-300:]), "°C", at_least=2 * 0.05 * 5.0)

    lower_gains = [Gains(float(lower), ki) for lower in np.linspace(0.1, kp, 22)]
    cases = {"constant set point": CONSTANT, "square wave": SQUARE, NOISY_SQUARE: NOISY}
    for title, arguments in cases.items():
        errors = [
            mean_error(batch.run_pi(gains, SAMPLES, **arguments)) for gains in lower_gains
        ]
        medians = [float(np.median(error)) for error in errors]
        best = int(np.argmin(medians[:-1]))  # the last is the paper's
        quantity = f"mean error with the best lower Kp ({lower_gains[best].kp:.1f}) as a "
        quantity += f"multiple of that with {kp:g}, {title}"
        # Without noise there is one run, and this is an exact number.
        yield judge(quantity, (errors[best] / errors[-1]).squeeze(), at_least=1 - NOTABLE)

    doubled_gains = Gains(2 * kp, ki)
    runs = batch.run_pi(doubled_gains, SAMPLES, **CONSTANT)
    limited_share = 100 * np.mean(np.abs(runs.applied[-300:]) == Parameters().u_max)
    quantity = f"samples of the last 300 with the flow at a limit, Kp = {2 * kp:g}"
    yield judge(quantity, limited_share, "%", at_least=50)
    quantity = f"largest pole without dead zone and limits, Kp = {2 * kp:g}: unstable above 1"
    yield judge(quantity, largest_pole(doubled_gains), at_least=1)
    quantity = "largest pole without dead zone and limits"
    yield judge(f"{quantity}, Kp = {kp:g}", largest_pole(PAPER_PI))
    smallest = min(largest_pole(gains) for gains in lower_gains)
    yield judge(f"{quantity}, the best Kp of 0.1 to {kp:g}", smallest)


@claimed(
    "Section 5, end of the comparison",
    "No PI controller can perform well here: the NN is much better than one with searched "
    "gains, too",
    f"Kp = {SEARCHED_PI.kp:g}, Ki = {SEARCHED_PI.ki:g}, searched with the same budget as the "
    "network's gains. Otherwise as above.",
    name="nn-against-searched-pi",
    gains=SEARCHED_PI,
)
@claimed(
    "Section 5, Figs 5 and 10, 8 and 11",
    "The NN is much better than the PI controller with the paper's gains",
    f"Kp = {PAPER_PI.kp:g}, Ki = {PAPER_PI.ki:g}. Much better: the mean error is smaller by a "
    "fifth or more, in the same noise.",
    name="nn-against-paper-pi",
    gains=PAPER_PI,
)
def versus_pi(batch: Batch, gains: Gains) -> Findings:
    for noise_title, noise_arguments in (("", {}), (", R = 0.5 °C²", NOISY)):
        for setpoint in SETPOINTS:
            arguments = {**setpoint.arguments, **noise_arguments}
            nn_errors = mean_error(batch.run_nn(setpoint.samples, **arguments))
            pi_errors = mean_error(batch.run_pi(gains, setpoint.samples, **arguments))
            case = f"{setpoint.title}{noise_title}"
            quantity = f"mean error of the NN as a multiple of the PI's, {case}"
            yield judge(quantity, nn_errors / pi_errors, at_most=1 - MUCH)
            yield judge_share(f"the NN is better, {case}", nn_errors < pi_errors)
    nn_errors = mean_error(batch.run_nn(SAMPLES, dead_zone=7.0))
    pi_errors = mean_error(batch.run_pi(gains, SAMPLES, dead_zone=7.0))
    quantity = "mean error of the NN as a multiple of the PI's, square wave, dead zone 7 t/h"
    yield judge(quantity, nn_errors / pi_errors)


@claimed(
    "Section 5, on (27)",
    "Training with -D(G) diverges at once",
    "At once: within the 150 samples that the right sign is said to take.",
)
def direction(batch: Batch) -> Findings:
    runs = batch.run(batch.networks(direction=1), 600, **CONSTANT)
    reachable = abs(linear.nominal(Parameters()).gain) * 10.0  # degC
    is_beyond = np.abs(runs.output) > 0.9 * reachable
    times = np.where(is_beyond.any(axis=0), np.argmax(is_beyond, axis=0), np.inf)
    quantity = "temperature exceeds 90 % of the largest deviation that the flow can cause, in "
    quantity += f"either direction, within {SOON} samples"
    yield judge_share(quantity, times <= SOON, often=True)
    quantity = "temperature exceeds it when the run ends, after 600 samples"
    yield judge_share(quantity, is_beyond[-1], often=True)
    yield judge_share("temperature is on the wrong side when the run ends", runs.output[-1] < 0)
    yield from judge_time("time until the temperature exceeds it", times)


@claimed(
    "Section 5, on the choice of inputs",
    "More delayed inputs are not superior",
    "Six and twenty set points and errors, not three; with the same gains, and with gains in "
    "proportion: for the weights of the inputs smaller by as much as there are more inputs. "
    "Better: as above.",
    name="more-inputs",
    shapes={f"{n} set points and errors": {"length": n} for n in (6, 20)},
)
@claimed(
    "Section 5, Fig. 12",
    "Six hidden nodes are no better than three",
    "With the same gains, and with gains in proportion: half as large for the weights and "
    "thresholds of hidden nodes. Better: the mean error is smaller by 5 % or more.",
    name="six-nodes",
    shapes={"6 hidden nodes": {"nodes": 6}},
)
def against_the_paper(batch: Batch, shapes: Mapping[str, Mapping[str, int]]) -> Findings:
    noisy_square = Scenario("noisy-square", NOISY_SQUARE, SAMPLES, NOISY)
    for case in (*SETPOINTS, noisy_square):
        paper_errors = mean_error(batch.run_nn(case.samples, **case.arguments))
        for (shape_title, shape), slower in itertools.product(shapes.items(), (False, True)):
            length = shape.get("length", 3)
            windows: Arguments = {"setpoint_window": length, "error_window": length}
            networks = batch.networks(**shape, slower=slower)
            runs = batch.run(networks, case.samples, **case.arguments, **windows)
            quantity = f"mean error with {shape_title}, {GAINS[slower]}, as a multiple of that "
            quantity += f"of the paper's network, {case.title}"
            yield judge(quantity, mean_error(runs) / paper_errors, at_least=1 - NOTABLE)


@claimed(
    "Section 5, last sentence",
    "More hidden nodes improve reliability",
    "After 600 samples at set point 5 the output of a hidden node stays at 0, or at 1, and the "
    "others go on learning. Reliable: the mean error after that is smaller than with three "
    "nodes by 5 % or more. Gains in proportion: as above.",
)
def reliability(batch: Batch) -> Findings:
    for slower, stuck_at in itertools.product((False, True), (0, 1)):
        errors = {}
        for nodes in (3, 6, 12):
            networks = batch.networks(nodes=nodes, slower=slower)
            damage = partial(damage_networks, networks, stuck_at)
            runs = batch.run(networks, 2 * LEARNING, damage, **CONSTANT)
            runs_before = runs[:LEARNING]
            runs_after = runs[LEARNING:]
            errors[nodes] = mean_error(runs_after)
            case = f"{nodes} nodes, one stuck at {stuck_at}, {GAINS[slower]}"
            if stuck_at == 0:
                yield judge_share(f"settled before the failure, {case}", settled(runs_before))
            quantity = f"settled 600 samples after the failure, {case}"
            yield judge_share(quantity, settled(runs_after))
            quantity = f"mean error in the 600 samples after the failure, {case}"
            yield judge(quantity, errors[nodes], "°C")
            if nodes > 3:
                quantity = f"this error as a multiple of that with 3 nodes, {case}"
                yield judge(quantity, errors[nodes] / errors[3], at_most=1 - NOTABLE)


def damage_networks(networks: DirectNNController, stuck_at: int, k: int) -> None:
    """At k = `LEARNING`, let the output of a hidden node of every network stay at 0 or at 1."""
    if k == LEARNING:
        weights = networks.weights
        weights.W[..., 0, :] = 0.0
        # So far out on the sigmoid the slope vanishes: the node cannot learn.
        weights.theta_1[..., 0] = 1e6 if stuck_at else -1e6
        networks.weights = weights


@claimed(
    "Section 4, last paragraph",
    "On a plant that changes the weights must keep being updated",
    "The network learns on the paper's plant for 1,200 samples of the square wave; then the "
    "plant changes, and for 1,200 more, from rest, the weights learn on or stay as they are.",
)
def keep_learning(batch: Batch) -> Findings:
    networks = batch.networks()
    batch.run(networks, SAMPLES, **SQUARE)
    learnt_weights = networks.weights
    for title, plant in (
        ("gain times 0.75", {"gain_factor": 0.75}),
        ("gain times 1.25", {"gain_factor": 1.25}),
        ("gain times 1.4", {"gain_factor": 1.4}),
        ("delay 27", {"delay": 27}),
        ("gain times 1.25 and delay 27", {"gain_factor": 1.25, "delay": 27}),
        ("no change", {}),
    ):
        errors = {}
        for learning in (True, False):
            networks.weights = learnt_weights
            networks.learning = learning
            errors[learning] = mean_error(batch.run(networks, SAMPLES, **SQUARE, **plant))
        quantity = "mean error of learning weights as a multiple of that of frozen ones, "
        quantity += title
        at_most = 1 - NOTABLE if plant else math.inf
        yield judge(quantity, errors[True] / errors[False], at_most=at_most)
        yield judge(f"mean error of frozen weights, {title}", errors[False], "°C")
        is_useless = errors[False] >= 5.0
        yield judge_share(f"frozen weights do no better than no control, {title}", is_useless)


@claimed(
    "Abstract and Section 6",
    "The direction of the response is all that need be known of a plant",
    "The same gains on other plants with the same direction. Settled: as above; works: in at "
    "least 90 % of the draws.",
)
def direction_only(batch: Batch) -> Findings:
    # The flow that a set point needs depends on the gain. For 5 degC it lies beyond the limits
    # if the gain is below 0.74, and inside the dead zone if it is above 1.46.
    five = "set point 5 °C"
    scaled = "set point 5 °C times the gain"
    plants_by_setpoint: dict[str, pd.DataFrame] = {}
    for setpoint_title, gains in (
        (five, (0.75, 1.0, 1.25, 1.4)),
        (scaled, (0.7, 1.0, 1.25, 1.5)),
    ):
        rows = []
        for constant, gain, delay in itertools.product((0.5, 1.0, 2.0), gains, (9, 18, 27, 36)):
            plant = {"gain_factor": gain, "time_constant_factor": constant, "delay": delay}
            setpoint = 5.0 * gain if setpoint_title == scaled else 5.0
            has_settled = settled(batch.run_nn(SAMPLES, setpoint=setpoint, **plant))
            row = {"constant": constant, "gain": gain, "delay": delay}
            rows.append({**row, "runs": has_settled, "share": has_settled.mean()})
        plants_by_setpoint[setpoint_title] = pd.DataFrame(rows)

    plants = plants_by_setpoint[five]
    delays = plants.query("constant == 1 and gain == 1")
    yield judge_worst(delays, f"delays from 9 to 36, {five}")
    constants = plants.query("gain == 1 and delay == 18")
    yield judge_worst(constants, f"time constants from 0.5 to 2 times the paper's, {five}")
    for setpoint_title, plants in plants_by_setpoint.items():
        lowest, highest = plants["gain"].min(), plants["gain"].max()
        text = f"gains from {lowest:g} to {highest:g} times the paper's, {setpoint_title}"
        yield judge_worst(plants.query("constant == 1 and delay == 18"), text)
    for setpoint_title, plants in plants_by_setpoint.items():
        yield judge_worst(plants, f"all {len(plants)} combinations, {setpoint_title}")
        quantity = f"combinations in which at least {OFTEN:.0%} of runs settle, "
        quantity += setpoint_title
        yield judge(quantity, 100 * (plants["share"] >= OFTEN).mean(), "%")


@claimed(
    "Section 5, Figs 5 to 12",
    "The curves of the figures themselves",
    "The text gives neither their set points nor the gains, initial weights and noise behind "
    "them. `python -m benchmarks.compare` draws the responses of both controllers on the same "
    "plants.",
)
def figures(_: Batch) -> Findings:
    return ()
