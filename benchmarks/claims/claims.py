"""Examine the paper's claims: the runs for each, and the criteria that it must meet."""
# ruff: noqa: B023, D103 (closures are called at once; what each function does stands above it)

import itertools
import math
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.polynomial.polynomial import polyadd

from agents import PIController
from agents.pi import SEARCHED_GAINS
from benchmarks.claims.runs import OFTEN, Array, Batch, Finding, judge, judge_share, judge_time
from benchmarks.loop import linear
from benchmarks.loop.rollout import mean_error, settled
from benchmarks.loop.scenarios import SETPOINTS as CASES
from mptc_gym import PRESETS, Parameters

# The meaning of words, fixed before the numbers were known and the same for all claims.
NOTABLE = 0.05  # a smaller relative change of an error is not notable
MUCH = 0.2  # "much better", "seriously worse": the error differs by at least this share
SOON = 150  # samples; the paper's own number for the convergence of the weights

NOISY = PRESETS["noisy"]
NOISY_SQUARE = "square wave, R = 0.5 °C²"
SQUARE, CONSTANT = (arguments for *_, arguments in CASES)
# The constant set point comes first, as it shows initial learning alone.
SETPOINTS = tuple((title, arguments, samples) for _, title, samples, arguments in CASES[::-1])
KP, KI = PAPER_PI = (2.2, 0.3)
SEARCHED_PI = (SEARCHED_GAINS["kp"], SEARCHED_GAINS["ki"])
LEARNING = 600  # samples after which a network counts as trained
GAINS = {False: "the same gains", True: "gains in proportion"}  # of networks of other shapes

Findings = Iterable[Finding]


class Claim(NamedTuple):
    """A claim in a section of the paper, and the method by which it is examined."""

    section: str
    statement: str
    method: str
    examine: Callable[[Batch], Findings]


CLAIMS: dict[str, Claim] = {}


def claimed(
    section: str, statement: str, method: str, name: str = "", **given: Any
) -> Callable[[Callable[..., Findings]], Callable[..., Findings]]:
    """Register a claim of the paper, by default under the name of what examines it.

    `given` are further arguments of the examination. Of two decorators the lower is the first.
    """

    def enter(examine: Callable[..., Findings]) -> Callable[..., Findings]:
        known = name or examine.__name__.replace("_", "-")
        CLAIMS[known] = Claim(section, statement, method, partial(examine, **given))
        return examine

    return enter


def examined(name: str, batch: Batch) -> list[Finding]:
    """Return what is found about a claim."""
    return list(CLAIMS[name].examine(batch))


@claimed(
    "Section 5, result 1",
    "The weights converge within 150 sampling intervals",
    "Converged: the distance of all weights to where they end stays below 5 % of what it was "
    "at the start, for the last 100 samples at the least.",
)
def convergence(batch: Batch) -> Findings:
    for name, arguments, samples in SETPOINTS:
        network = batch.networks()
        weights: list[Array] = []

        def watch(_: int) -> None:
            arrays = vars(network.weights).values()
            flat = [each.reshape(batch.runs, -1) for each in arrays]
            weights.append(np.hstack(flat, dtype=np.float32))

        batch.run(network, samples, watch, **arguments)
        times = converged_at(np.array(weights))
        soon = times <= SOON
        yield judge_share(f"weights converged within {SOON} samples, {name}", soon, often=True)
        yield from judge_time(f"time until the weights have converged, {name}", times)
        never = np.isinf(times)
        yield judge_share(f"weights not converged when the run ends, {name}", never)


def converged_at(weights: Array) -> Array:
    """Return the sample at which weights have converged, shape (runs,).

    This is the first sample from which on their Euclidean distance to their final values is at
    most 5 % of that at the start. It is infinite for weights that come so close only in the
    last 100 samples: they have not converged, as the run might end anywhere on their way.
    `weights` are those before each sample, shape (samples, runs, n).
    """
    distance = np.linalg.norm(weights - weights[-1], axis=2)
    outside = distance > 0.05 * distance[0]
    samples = len(weights)
    # The first sample of the final stretch inside the band, found from the end.
    first = np.where(outside.any(axis=0), samples - np.argmax(outside[::-1], axis=0), 0)
    return np.where(first <= samples - 100, first, np.inf)


@claimed(
    "Section 5, result 2",
    "A dead zone of 7 t/h costs performance seriously, and the NN still works well",
    "Settled: the error stays within 5 % of the set point over the last 50 samples. Seriously: "
    "the mean error is larger by a fifth or more.",
)
def dead_zone(batch: Batch) -> Findings:
    for name, arguments, samples in SETPOINTS:
        small = batch.run_nn(samples, **arguments)
        large = batch.run_nn(samples, **arguments, dead_zone=7.0)
        quantity = f"settled when the run ends, dead zone 7 t/h, {name}"
        yield judge_share(quantity, settled(large), often=True)
        cost = mean_error(large) / mean_error(small)
        quantity = f"mean error at dead zone 7 t/h, as a multiple of that at 5 t/h, {name}"
        yield judge(quantity, cost, at_least=1 + MUCH)
        for zone, runs in ((5, small), (7, large)):
            yield judge(f"mean error, dead zone {zone} t/h, {name}", mean_error(runs), "°C")


@claimed(
    "Section 5, result 3",
    "The NN works with noise, R = 0.5, without special consideration for it",
    "It must hold the set point on average, to 5 %; must not make the temperature vary much "
    "more than it does without control; and must be better than doing nothing.",
)
def noise(batch: Batch) -> Findings:
    samples, steady = 1200, slice(-600, None)
    idle = batch.run_pi(0.0, 0.0, samples, setpoint=0.0, **NOISY)
    runs = batch.run_nn(samples, **CONSTANT, **NOISY)
    error = (runs.setpoint - runs.output)[steady]
    alone = idle.output[steady].std(axis=0)
    quantity = (
        "absolute value of the mean of e over the last 600 of 1,200 samples, constant set point"
    )
    yield judge(quantity, np.abs(error.mean(axis=0)), "°C", at_most=0.05 * 5.0)
    quantity = "standard deviation of y over these samples, as a multiple of that without "
    quantity += "control"
    yield judge(quantity, error.std(axis=0) / alone, at_most=1 + MUCH)
    square = mean_error(batch.run_nn(samples, **SQUARE, **NOISY))
    better = "mean error below that of doing nothing, square wave"
    yield judge_share(better, square < 5.0, often=True)
    yield judge("mean error, square wave", square, "°C")
    yield judge("standard deviation of y without control", alone, "°C")


@claimed(
    "Section 5, after Fig. 10",
    "The paper's PI controller oscillates; a lower Kp brings no notable improvement, a higher "
    "one instability",
    "Oscillates: by 10 % of the set point and more, peak to peak, after 15 minutes and to the "
    "end. Lower: Kp from 0.1 to 2.2, with Ki = 0.3; notable is 5 % of the mean error. Higher: "
    "twice the paper's Kp.",
)
def pi_gains(batch: Batch) -> Findings:
    paper = batch.run_pi(KP, KI, 1200, **CONSTANT)
    quantity = "peak to peak of y over the last 300 of 1,200 samples, Kp = 2.2, constant set "
    quantity += "point"
    yield judge(quantity, np.ptp(paper.output[-300:]), "°C", at_least=2 * 0.05 * 5.0)
    gains = np.linspace(0.1, KP, 22)  # the last is the paper's
    cases = {"constant set point": CONSTANT, "square wave": SQUARE, NOISY_SQUARE: NOISY}
    for name, arguments in cases.items():
        errors = [mean_error(batch.run_pi(kp, KI, 1200, **arguments)) for kp in gains]
        medians = [float(np.median(error)) for error in errors]
        best = int(np.argmin(medians[:-1]))
        quantity = f"mean error with the best lower Kp ({gains[best]:.1f}) as a multiple of "
        quantity += f"that with {KP:g}, {name}"
        # Of one run without noise, an exact number.
        yield judge(quantity, (errors[best] / errors[-1]).squeeze(), at_least=1 - NOTABLE)
    doubled = batch.run_pi(2 * KP, KI, 1200, **CONSTANT)
    limited = 100 * np.mean(np.abs(doubled.applied[-300:]) == Parameters().u_max)
    quantity = f"samples of the last 300 with the flow at a limit, Kp = {2 * KP:g}"
    yield judge(quantity, limited, "%", at_least=50)
    quantity = f"largest pole without dead zone and limits, Kp = {2 * KP:g}: unstable above 1"
    yield judge(quantity, largest_pole(2 * KP, KI), at_least=1)
    yield judge("the same, Kp = 2.2", largest_pole(KP, KI))
    smallest = min(largest_pole(gain, KI) for gain in gains)
    yield judge("the same, the best Kp of 0.1 to 2.2", smallest)


def largest_pole(kp: float, ki: float) -> float:
    """Return the modulus of the largest pole of the loop of a PI and the plant (28).

    The actuator is left out. The loop is stable if this is below 1.
    """
    up, down = PIController(kp, ki).transfer()
    plant = linear.nominal(Parameters())
    a, b = [1.0, *-plant.alpha], [*np.zeros(18 + 1), *plant.beta]  # the delay, and one
    closed: Array = polyadd(np.convolve(down, a), np.convolve(up, b))
    return float(np.abs(np.roots(closed)).max())


@claimed(
    "Section 5, end of the comparison",
    "No PI controller can perform well here: the NN is much better than one with searched "
    "gains, too",
    f"Kp = {SEARCHED_PI[0]:g}, Ki = {SEARCHED_PI[1]:g}, searched with the same budget as the "
    "network's gains. Otherwise as above.",
    name="nn-against-searched-pi",
    gains=SEARCHED_PI,
)
@claimed(
    "Section 5, Figs 5 and 10, 8 and 11",
    "The NN is much better than the PI controller with the paper's gains",
    f"Kp = {KP:g}, Ki = {KI:g}. Much better: the mean error is smaller by a fifth or more, in "
    "the same noise.",
    name="nn-against-paper-pi",
    gains=PAPER_PI,
)
def versus_pi(batch: Batch, gains: tuple[float, float]) -> Findings:
    for noise_name, noise_arguments in (("", {}), (", R = 0.5 °C²", NOISY)):
        for name, setpoint, samples in SETPOINTS:
            arguments = {**setpoint, **noise_arguments}
            nn = mean_error(batch.run_nn(samples, **arguments))
            pi = mean_error(batch.run_pi(*gains, samples, **arguments))
            case = f"{name}{noise_name}"
            quantity = f"mean error of the NN as a multiple of the PI's, {case}"
            yield judge(quantity, nn / pi, at_most=1 - MUCH)
            yield judge_share(f"the NN is better, {case}", nn < pi)
    nn = mean_error(batch.run_nn(1200, dead_zone=7.0))
    pi = mean_error(batch.run_pi(*gains, 1200, dead_zone=7.0))
    yield judge("the same ratio, square wave, dead zone 7 t/h", nn / pi)


@claimed(
    "Section 5, on (27)",
    "Training with -D(G) diverges at once",
    "At once: within the 150 samples that the right sign is said to take.",
)
def direction(batch: Batch) -> Findings:
    runs = batch.run(batch.networks(direction=1), 600, **CONSTANT)
    reachable = abs(linear.nominal(Parameters()).gain) * 10.0  # degC
    beyond = np.abs(runs.output) > 0.9 * reachable
    when = np.where(beyond.any(axis=0), np.argmax(beyond, axis=0), np.inf)
    soon = (
        f"y beyond 90 % of the largest deviation that the flow can cause, within {SOON} samples"
    )
    yield judge_share(soon, when <= SOON, often=True)
    late = "the same when the run ends, after 600 samples"
    yield judge_share(late, beyond[-1], often=True)
    yield judge_share("the same, on the wrong side", runs.output[-1] < 0)
    yield from judge_time("time until y is beyond it", when)


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
    for case, arguments, samples in (*SETPOINTS, (NOISY_SQUARE, NOISY, 1200)):
        paper = mean_error(batch.run_nn(samples, **arguments))
        for (name, shape), slower in itertools.product(shapes.items(), (False, True)):
            n = shape.get("length", 3)
            windows: dict[str, Any] = {"setpoint_window": n, "error_window": n}
            networks = batch.networks(**shape, slower=slower)
            runs = batch.run(networks, samples, **arguments, **windows)
            quantity = f"mean error with {name}, {GAINS[slower]}, as a multiple of that of the "
            quantity += f"paper's network, {case}"
            yield judge(quantity, mean_error(runs) / paper, at_least=1 - NOTABLE)


@claimed(
    "Section 5, last sentence",
    "More hidden nodes improve reliability",
    "After 600 samples at set point 5 the output of a hidden node stays at 0, or at 1, and the "
    "others go on learning. Reliable: the mean error after that is smaller than with three "
    "nodes by 5 % or more. Gains in proportion: as above.",
)
def reliability(batch: Batch) -> Findings:
    for slower, stuck_at in itertools.product((False, True), (0, 1)):
        error = {}
        for nodes in (3, 6, 12):
            networks = batch.networks(nodes=nodes, slower=slower)

            def damage(k: int) -> None:
                if k == LEARNING:
                    weights = networks.weights
                    weights.W[..., 0, :] = 0.0
                    # So far out on the sigmoid the slope vanishes: the node cannot learn.
                    weights.theta_1[..., 0] = 1e6 if stuck_at else -1e6
                    networks.weights = weights

            runs = batch.run(networks, 2 * LEARNING, damage, **CONSTANT)
            before, after = runs[:LEARNING], runs[LEARNING:]
            error[nodes] = mean_error(after)
            case = f"{nodes} nodes, one stuck at {stuck_at}, {GAINS[slower]}"
            if stuck_at == 0:
                yield judge_share(f"settled before the failure, {case}", settled(before))
            yield judge_share(f"settled 600 samples after the failure, {case}", settled(after))
            yield judge(f"mean error in these samples, {case}", error[nodes], "°C")
            if nodes > 3:
                quantity = f"the same as a multiple of that with 3 nodes, {case}"
                yield judge(quantity, error[nodes] / error[3], at_most=1 - NOTABLE)


@claimed(
    "Section 4, last paragraph",
    "On a plant that changes the weights must keep being updated",
    "The network learns on the paper's plant for 1,200 samples of the square wave; then the "
    "plant changes, and for 1,200 more, from rest, the weights learn on or stay as they are.",
)
def keep_learning(batch: Batch) -> Findings:
    network = batch.networks()
    batch.run(network, 1200, **SQUARE)
    learnt = network.weights
    for name, plant in (
        ("gain times 0.75", {"gain_factor": 0.75}),
        ("gain times 1.25", {"gain_factor": 1.25}),
        ("gain times 1.4", {"gain_factor": 1.4}),
        ("delay 27", {"delay": 27}),
        ("gain times 1.25 and delay 27", {"gain_factor": 1.25, "delay": 27}),
        ("no change", {}),
    ):
        error = {}
        for learning in (True, False):
            network.weights = learnt
            network.learning = learning
            error[learning] = mean_error(batch.run(network, 1200, **SQUARE, **plant))
        quantity = "mean error of learning weights as a multiple of that of frozen ones, "
        quantity += name
        at_most = 1 - NOTABLE if plant else math.inf
        yield judge(quantity, error[True] / error[False], at_most=at_most)
        yield judge(f"mean error of frozen weights, {name}", error[False], "°C")
        useless = error[False] >= 5.0
        yield judge_share(f"frozen weights do no better than no control, {name}", useless)


@claimed(
    "Abstract and Section 6",
    "The direction of the response is all that need be known of a plant",
    "The same gains on other plants with the same direction. Settled: as above; works: in at "
    "least 90 % of the draws.",
)
def direction_only(batch: Batch) -> Findings:
    # The flow that a set point needs depends on the gain. For 5 degC it lies beyond the limits
    # if the gain is below 0.74, and inside the dead zone if it is above 1.46.
    five, scaled = "set point 5 °C", "set point 5 °C times the gain"
    plants = {}
    for family, gains in ((five, (0.75, 1.0, 1.25, 1.4)), (scaled, (0.7, 1.0, 1.25, 1.5))):
        rows = []
        for constant, gain, delay in itertools.product((0.5, 1.0, 2.0), gains, (9, 18, 27, 36)):
            plant = {"gain_factor": gain, "time_constant_factor": constant, "delay": delay}
            setpoint = 5.0 * gain if family == scaled else 5.0
            runs = settled(batch.run_nn(1200, setpoint=setpoint, **plant))
            rows.append((constant, gain, delay, runs, runs.mean()))
        columns = ["constant", "gain", "delay", "runs", "share"]
        plants[family] = pd.DataFrame(rows, columns=columns)

    def worst(text: str, family: str, which: str = "delay > 0") -> Finding:
        found = plants[family].query(which)
        row = found.iloc[found["share"].argmin()]
        where = f"delay {row['delay']}, gain {row['gain']:g}"
        where += f", time constant {row['constant']:g}"
        quantity = f"settled within 1,200 samples, the worst of {text}, {family} ({where})"
        return judge_share(quantity, row["runs"], often=True)

    yield worst("delays from 9 to 36", five, "constant == 1 and gain == 1")
    constants = "time constants from 0.5 to 2 times the paper's"
    yield worst(constants, five, "gain == 1 and delay == 18")
    for family, found in plants.items():
        text = (
            f"gains from {found['gain'].min():g} to {found['gain'].max():g} times the paper's"
        )
        yield worst(text, family, "constant == 1 and delay == 18")
    for family, found in plants.items():
        yield worst(f"all {len(found)} combinations", family)
        quantity = f"combinations in which at least {OFTEN:.0%} of runs settle, {family}"
        yield judge(quantity, 100 * (found["share"] >= OFTEN).mean(), "%")


@claimed(
    "Section 5, Figs 5 to 12",
    "The curves of the figures themselves",
    "The text gives neither their set points nor the gains, initial weights and noise behind "
    "them. `python -m benchmarks.compare` draws the responses of both controllers on the same "
    "plants.",
)
def figures(_: Batch) -> Findings:
    return ()
