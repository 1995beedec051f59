"""Examine the paper's claims: the runs for each claim, and the criteria that it must meet.

The paper is that of Cui and Shin (1992), whose controller is a neural network (NN) that learns
online. A function that yields `Findings` examines a claim of the paper, or two claims that
differ in an argument. Its argument `batch` says how many runs to make, and with which seeds.
`CLAIMS`, at the end of the module, holds the words of all claims.
"""

import itertools
import math
from collections.abc import Callable, Iterable
from functools import partial
from typing import NamedTuple

import numpy as np
import pandas as pd

from agents import DirectNNController, PIController
from agents.pi import SEARCHED_GAINS
from benchmarks.claims.findings import OFTEN, Finding, judge, judge_share, judge_times
from benchmarks.claims.runs import PAPER_LENGTH, Batch, Gains, WeightLog, converged_at
from benchmarks.loop import linear
from benchmarks.loop.rollout import mean_error, settled
from benchmarks.loop.scenarios import SETPOINTS as PAPER_SETPOINTS
from benchmarks.loop.scenarios import Arguments, Scenario
from mptc_gym import PRESETS, Parameters

# Numbers that give words of the claims a meaning. They were chosen before any run, and are the
# same for all claims.
NOTABLE = 0.05  # a relative change of an error below this share is not "notable"
MUCH = 0.2  # "much better", "seriously worse": the error differs by at least this share
SOON = 150  # samples; the paper says that the weights converge within 150 sampling intervals

LEVEL = 5.0  # degC, the constant set point, and the amplitude of the square wave
SAMPLES = 1200  # length of a run, unless the case has another length
LEARNING = 600  # samples after which a network counts as trained
NOISY = PRESETS["noisy"]
NOISY_SQUARE = "square wave, R = 0.5 °C²"
# The cases of the set point. The constant set point comes first: without later changes, its
# error comes from initial learning alone.
SETPOINTS = PAPER_SETPOINTS[::-1]
CONSTANT, SQUARE = (setpoint.arguments for setpoint in SETPOINTS)
# Words for the learning rates ("gains") of a network with more nodes or inputs than the paper's
# network, by the argument `in_proportion` of `Batch.networks`.
GAINS = {False: "the same gains", True: "gains in proportion"}
PAPER_PI = Gains(2.2, 0.3)
SEARCHED_PI = Gains(SEARCHED_GAINS["kp"], SEARCHED_GAINS["ki"])

Findings = Iterable[Finding]


def convergence(batch: Batch) -> Findings:
    """Yield findings about the time after which the weights of the paper's network converge."""
    for setpoint in SETPOINTS:
        networks = batch.networks()
        log = WeightLog(networks)
        batch.run(networks, setpoint.samples, log, **setpoint.arguments)
        times = converged_at(np.array(log.rows))
        title = setpoint.title
        is_soon = times <= SOON
        is_never = np.isinf(times)
        yield judge_share(
            f"weights converged within {SOON} samples, {title}",
            is_soon,
            often=True,
        )
        yield from judge_times(f"time until the weights have converged, {title}", times)
        yield judge_share(f"weights not converged when the run ends, {title}", is_never)


def dead_zone(batch: Batch) -> Findings:
    """Compare the errors of the paper's network at dead zones of 5 and 7 t/h (half widths)."""
    for setpoint in SETPOINTS:
        title = setpoint.title
        small = batch.run_nn(setpoint.samples, **setpoint.arguments)
        large = batch.run_nn(setpoint.samples, **setpoint.arguments, dead_zone=7.0)
        yield judge_share(
            f"settled when the run ends, dead zone 7 t/h, {title}",
            settled(large),
            often=True,
        )
        error_ratio = mean_error(large) / mean_error(small)
        yield judge(
            f"mean error at dead zone 7 t/h, as a multiple of the error at 5, {title}",
            error_ratio,
            at_least=1 + MUCH,
        )
        for width, runs in ((5, small), (7, large)):
            yield judge(f"mean error, dead zone {width} t/h, {title}", mean_error(runs), "°C")


def noise(batch: Batch) -> Findings:
    """Compare the paper's network with an idle valve, on plants with noise.

    At a constant set point, only the last 600 of 1,200 samples count, when learning is over.
    """
    steady = slice(-600, None)
    idle_runs = batch.run_pi(Gains(0.0, 0.0), SAMPLES, setpoint=0.0, **NOISY)
    idle_deviation = idle_runs.output[steady].std(axis=0)
    runs = batch.run_nn(SAMPLES, **CONSTANT, **NOISY)
    errors = (runs.setpoint - runs.output)[steady]
    yield judge(
        "absolute value of the average error over the last 600 of 1,200 samples, constant set "
        "point",
        np.abs(errors.mean(axis=0)),
        "°C",
        at_most=0.05 * LEVEL,
    )
    yield judge(
        "standard deviation of y over the last 600 of 1,200 samples, as a multiple of the "
        "deviation without control",
        errors.std(axis=0) / idle_deviation,
        at_most=1 + MUCH,
    )
    square_errors = mean_error(batch.run_nn(SAMPLES, **SQUARE, **NOISY))
    is_better = square_errors < LEVEL  # the mean error without control
    yield judge_share(
        "mean error below the error without control, square wave", is_better, often=True
    )
    yield judge("mean error, square wave", square_errors, "°C")
    yield judge("standard deviation of y without control", idle_deviation, "°C")


def pi_gains(batch: Batch) -> Findings:
    """Examine the paper's PI controller, and PI controllers with another gain Kp.

    The claim is that the paper's controller oscillates, that a lower Kp is not notably better,
    and that a higher Kp makes the loop unstable.
    """
    kp, ki = PAPER_PI
    runs = batch.run_pi(PAPER_PI, SAMPLES, **CONSTANT)
    yield judge(
        f"peak to peak of y over the last 300 of 1,200 samples, Kp = {kp:g}, constant set "
        "point",
        np.ptp(runs.output[-300:]),
        "°C",
        at_least=2 * 0.05 * LEVEL,
    )
    lower_gains = [Gains(float(lower), ki) for lower in np.linspace(0.1, kp, 22)]
    cases = {"constant set point": CONSTANT, "square wave": SQUARE, NOISY_SQUARE: NOISY}
    for title, arguments in cases.items():
        errors = [
            mean_error(batch.run_pi(gains, SAMPLES, **arguments)) for gains in lower_gains
        ]
        medians = [float(np.median(error)) for error in errors]
        best = int(np.argmin(medians[:-1]))  # the last is the paper's
        yield judge(
            f"mean error with the best lower Kp ({lower_gains[best].kp:.1f}) as a multiple of "
            f"the error with {kp:g}, {title}",
            (errors[best] / errors[-1]).squeeze(),  # one exact number without noise
            at_least=1 - NOTABLE,
        )
    doubled_gains = Gains(2 * kp, ki)
    runs = batch.run_pi(doubled_gains, SAMPLES, **CONSTANT)
    limited_share = 100 * np.mean(np.abs(runs.applied[-300:]) == Parameters().u_max)
    yield judge(
        f"samples of the last 300 with the flow at a limit, Kp = {2 * kp:g}",
        limited_share,
        "%",
        at_least=50,
    )
    yield judge(
        f"largest pole without dead zone and limits, Kp = {2 * kp:g}: unstable above 1",
        largest_pole(doubled_gains),
        at_least=1,
    )
    quantity = "largest pole without dead zone and limits"
    yield judge(f"{quantity}, Kp = {kp:g}", largest_pole(PAPER_PI))
    smallest = min(largest_pole(gains) for gains in lower_gains)
    yield judge(f"{quantity}, the best Kp of 0.1 to {kp:g}", smallest)


def largest_pole(gains: Gains) -> float:
    """Return the largest magnitude of a pole of the paper's plant with a PI controller.

    The closed loop is taken without the actuator's dead zone and limits. The loop is stable if
    the magnitude is below 1.
    """
    plant = linear.nominal(Parameters())
    return linear.LinearLoop.of(PIController(*gains), plant).largest_pole()


def against_pi(batch: Batch, gains: Gains) -> Findings:
    """Compare the paper's network with a PI controller of these gains, in the same noise."""
    for noise_title, noise_arguments in (("", {}), (", R = 0.5 °C²", NOISY)):
        for setpoint in SETPOINTS:
            arguments = {**setpoint.arguments, **noise_arguments}
            nn_errors = mean_error(batch.run_nn(setpoint.samples, **arguments))
            pi_errors = mean_error(batch.run_pi(gains, setpoint.samples, **arguments))
            case = f"{setpoint.title}{noise_title}"
            yield judge(
                f"mean error of the NN as a multiple of the PI's, {case}",
                nn_errors / pi_errors,
                at_most=1 - MUCH,
            )
            yield judge_share(f"the NN is better, {case}", nn_errors < pi_errors)
    nn_errors = mean_error(batch.run_nn(SAMPLES, dead_zone=7.0))
    pi_errors = mean_error(batch.run_pi(gains, SAMPLES, dead_zone=7.0))
    yield judge(
        "mean error of the NN as a multiple of the PI's, square wave, dead zone 7 t/h",
        nn_errors / pi_errors,
    )


def direction(batch: Batch) -> Findings:
    """Measure when networks that assume the wrong sign of the plant's gain diverge.

    A run counts as diverged when the temperature exceeds 90 % of the largest deviation that the
    limited flow can cause.
    """
    runs = batch.run(batch.networks(direction=1), 600, **CONSTANT)
    plant = Parameters()
    reach = abs(linear.nominal(plant).gain) * plant.u_max  # degC that the flow can cause
    is_beyond = np.abs(runs.output) > 0.9 * reach
    times = np.where(is_beyond.any(axis=0), np.argmax(is_beyond, axis=0), np.inf)
    yield judge_share(
        "temperature exceeds 90 % of the largest deviation that the flow can cause, in either "
        f"direction, within {SOON} samples",
        times <= SOON,
        often=True,
    )
    yield judge_share(
        "temperature exceeds this share when the run ends, after 600 samples",
        is_beyond[-1],
        often=True,
    )
    yield judge_share("temperature is on the wrong side when the run ends", runs.output[-1] < 0)
    yield from judge_times("time until the temperature exceeds this share", times)


def other_shapes(batch: Batch, shapes: dict[str, dict[str, int]]) -> Findings:
    """Compare networks with more nodes or inputs with the paper's network.

    `shapes` holds, for each shape of a network, a title and arguments of `Batch.networks`. Each
    shape is examined with the paper's learning rates, and with rates scaled in proportion.
    """
    noisy_square = Scenario("noisy-square", NOISY_SQUARE, SAMPLES, NOISY)
    for case in (*SETPOINTS, noisy_square):
        paper_errors = mean_error(batch.run_nn(case.samples, **case.arguments))
        for (shape_title, shape), in_proportion in itertools.product(shapes.items(), GAINS):
            networks = batch.networks(**shape, in_proportion=in_proportion)
            length = shape.get("length", PAPER_LENGTH)
            windows: Arguments = {"setpoint_window": length, "error_window": length}
            runs = batch.run(networks, case.samples, **case.arguments, **windows)
            yield judge(
                f"mean error with {shape_title}, {GAINS[in_proportion]}, as a multiple of the "
                f"error of the paper's network, {case.title}",
                mean_error(runs) / paper_errors,
                at_least=1 - NOTABLE,
            )


def reliability(batch: Batch) -> Findings:
    """Compare networks of 3, 6 and 12 hidden nodes, before and after the failure of a node.

    After `LEARNING` samples, the output of one hidden node stays at 0 or at 1 for ever.
    """
    for in_proportion, stuck_at in itertools.product(GAINS, (0, 1)):
        errors = {}  # after the failure, by the number of nodes
        for nodes in (3, 6, 12):
            networks = batch.networks(nodes=nodes, in_proportion=in_proportion)
            damage = partial(damage_networks, networks, stuck_at)
            runs = batch.run(networks, 2 * LEARNING, damage, **CONSTANT)
            runs_before, runs_after = runs[:LEARNING], runs[LEARNING:]
            errors[nodes] = mean_error(runs_after)
            case = f"{nodes} nodes, one stuck at {stuck_at}, {GAINS[in_proportion]}"
            if stuck_at == 0:
                yield judge_share(f"settled before the failure, {case}", settled(runs_before))
            yield judge_share(
                f"settled 600 samples after the failure, {case}",
                settled(runs_after),
            )
            yield judge(
                f"mean error in the 600 samples after the failure, {case}",
                errors[nodes],
                "°C",
            )
            if nodes > 3:
                yield judge(
                    f"this mean error as a multiple of the error with 3 nodes, {case}",
                    errors[nodes] / errors[3],
                    at_most=1 - NOTABLE,
                )


def damage_networks(networks: DirectNNController, stuck_at: int, k: int) -> None:
    """Damage the first hidden node of each network at the sample k = `LEARNING`.

    A rollout calls this function before each sample. The output of the damaged node stays at
    `stuck_at`, 0 or 1, and the other nodes go on learning.
    """
    if k == LEARNING:
        weights = networks.weights
        weights.W[..., 0, :] = 0.0
        # So far out on the sigmoid the slope vanishes: the node cannot learn.
        weights.theta_1[..., 0] = 1e6 if stuck_at else -1e6
        networks.weights = weights


def keep_learning(batch: Batch) -> Findings:
    """Compare learning and frozen networks on plants that differ from the training plant.

    The networks learn on the paper's plant. Then the gain or the delay of the plant changes,
    and the weights either continue to learn or stay as they are.
    """
    networks = batch.networks()
    batch.run(networks, SAMPLES, **SQUARE)
    learnt_weights = networks.weights
    changes: dict[str, Arguments] = {
        "gain times 0.75": {"gain_factor": 0.75},
        "gain times 1.25": {"gain_factor": 1.25},
        "gain times 1.4": {"gain_factor": 1.4},
        "delay 27": {"delay": 27},
        "gain times 1.25 and delay 27": {"gain_factor": 1.25, "delay": 27},
        "no change": {},
    }
    for title, plant in changes.items():
        errors = {}  # by whether the weights are learning
        for learning in (True, False):
            networks.weights = learnt_weights
            networks.learning = learning
            errors[learning] = mean_error(batch.run(networks, SAMPLES, **SQUARE, **plant))
        ratio = errors[True] / errors[False]
        quantity = f"mean error of learning weights divided by that of frozen weights, {title}"
        at_most = 1 - NOTABLE if plant else math.inf  # without a change, only information
        yield judge(quantity, ratio, at_most=at_most)
        yield judge(f"mean error of frozen weights, {title}", errors[False], "°C")
        is_useless = errors[False] >= LEVEL  # the mean error without control
        yield judge_share(f"frozen weights do no better than no control, {title}", is_useless)


def direction_only(batch: Batch) -> Findings:
    """Measure how often the paper's network settles on plants with other dynamics.

    The plants differ from the paper's plant in delay, gain and time constant. The steady flow
    for a set point of 5 degC lies beyond the actuator's limits if the gain is below 0.74 of the
    paper's gain, and inside the dead zone if the gain is above 1.46 of the paper's gain. So
    there are two series of runs: with a set point of 5 degC, and with a set point of 5 degC
    times the gain factor.
    """
    fixed = plants_that_settle(batch, gains=(0.75, 1.0, 1.25, 1.4), is_scaled=False)
    scaled = plants_that_settle(batch, gains=(0.7, 1.0, 1.25, 1.5), is_scaled=True)
    designs = {"set point 5 °C": fixed, "set point 5 °C times the gain": scaled}

    delays = fixed.query("constant == 1 and gain == 1")
    yield judge_worst(delays, "delays from 9 to 36, set point 5 °C")
    constants = fixed.query("gain == 1 and delay == 18")
    text = "time constants from 0.5 to 2 times the paper's, set point 5 °C"
    yield judge_worst(constants, text)
    for setpoint, plants in designs.items():
        lowest, highest = plants["gain"].min(), plants["gain"].max()
        text = f"gains from {lowest:g} to {highest:g} times the paper's, {setpoint}"
        yield judge_worst(plants.query("constant == 1 and delay == 18"), text)
    for setpoint, plants in designs.items():
        yield judge_worst(plants, f"all {len(plants)} combinations, {setpoint}")
        yield judge(
            f"combinations in which at least {OFTEN:.0%} of runs settle, {setpoint}",
            100 * (plants["share"] >= OFTEN).mean(),
            "%",
        )


def plants_that_settle(
    batch: Batch, gains: Iterable[float], *, is_scaled: bool
) -> pd.DataFrame:
    """Run the paper's network on plants with other dynamics, and return a row for each plant.

    The plants are all combinations of three time constants, four delays and these gains.

    Parameters
    ----------
    batch
        Number and seeds of the runs on each plant.
    gains
        Gains of the plants, as multiples of the paper's gain.
    is_scaled
        Whether the set point is 5 degC times the gain factor, in place of 5 degC.

    Returns
    -------
    DataFrame
        The columns are `constant` and `gain`, factors of the paper's time constant and gain;
        `delay`, samples; `runs`, an array of shape (runs,) that says whether each run settles;
        and `share`, the share of runs that settle.
    """
    rows = []
    for constant, gain, delay in itertools.product((0.5, 1.0, 2.0), gains, (9, 18, 27, 36)):
        plant = {"gain_factor": gain, "time_constant_factor": constant, "delay": delay}
        setpoint = LEVEL * gain if is_scaled else LEVEL
        settles = settled(batch.run_nn(SAMPLES, setpoint=setpoint, **plant))
        row = {"constant": constant, "gain": gain, "delay": delay}
        rows.append({**row, "runs": settles, "share": settles.mean()})
    return pd.DataFrame(rows)


def judge_worst(plants: pd.DataFrame, text: str) -> Finding:
    """Return a finding about the plant on which the smallest share of runs settles.

    `plants` are rows of what `plants_that_settle` returns, and `text` describes these plants in
    words.
    """
    worst = plants.iloc[plants["share"].argmin()]
    quantity = (
        f"settled within 1,200 samples, the worst of {text} (delay {worst['delay']}, gain "
        f"{worst['gain']:g}, time constant {worst['constant']:g})"
    )
    return judge_share(quantity, worst["runs"], often=True)


def figures(_: Batch) -> Findings:
    """Return no findings: the paper does not say how the curves of its figures were made."""
    return ()


class Claim(NamedTuple):
    """A claim of the paper, and how the claim is examined."""

    section: str  # where the claim is in the paper
    statement: str  # the claim in one sentence
    method: str  # how the claim is examined, and what its words mean, for the report
    examine: Callable[..., Findings]  # takes a `Batch`, and returns the findings


CLAIMS = {
    "convergence": Claim(
        "Section 5, result 1",
        "The weights converge within 150 sampling intervals",
        "The weights have converged when their distance to their final values stays below 5 "
        "% of the distance at the start of the run, for at least the last 100 samples of the "
        "run.",
        convergence,
    ),
    "dead-zone": Claim(
        "Section 5, result 2",
        "A dead zone of 7 t/h costs performance seriously, and the NN still works well",
        "A run has settled if the error stays within 5 % of the set point over the last 50 "
        "samples. A dead zone of 7 t/h costs performance seriously if the mean error is at "
        "least a fifth larger than with the paper's usual dead zone of 5 t/h. Both dead zones "
        "are half widths.",
        dead_zone,
    ),
    "noise": Claim(
        "Section 5, result 3",
        "The NN works with noise, R = 0.5, without special consideration for it",
        "R is the variance of the noise, °C². The NN works if three criteria are met: the "
        "average error is at most 5 % of the set point, the temperature varies at most a fifth "
        "more than without control, and the mean error is smaller than without control.",
        noise,
    ),
    "pi-gains": Claim(
        "Section 5, after Fig. 10",
        "The paper's PI controller oscillates; a lower Kp brings no notable improvement, a "
        "higher one instability",
        "The paper's PI controller has the proportional gain Kp = 2.2 and the integral gain "
        "Ki = 0.3. The temperature y oscillates if it varies by at least 10 % of the set "
        "point, peak to peak, over the last 300 samples. The lower gains are Kp from 0.1 to "
        "2.2, and an improvement is notable if the mean error is at least 5 % smaller. The "
        "higher gain is twice the paper's Kp.",
        pi_gains,
    ),
    "nn-against-paper-pi": Claim(
        "Section 5, Figs 5 and 10, 8 and 11",
        "The NN is much better than the PI controller with the paper's gains",
        f"The PI controller has the gains Kp = {PAPER_PI.kp:g} and Ki = {PAPER_PI.ki:g}. The "
        "NN is much better if its mean error is at least a fifth smaller in the same noise.",
        partial(against_pi, gains=PAPER_PI),
    ),
    "nn-against-searched-pi": Claim(
        "Section 5, end of the comparison",
        "No PI controller can perform well here: the NN is much better than one with searched "
        "gains, too",
        f"The PI controller has the gains Kp = {SEARCHED_PI.kp:g} and Ki = "
        f"{SEARCHED_PI.ki:g}, which were searched with the same budget as the learning rates "
        "of the NN. The NN is much better if its mean error is at least a fifth smaller in "
        "the same noise.",
        partial(against_pi, gains=SEARCHED_PI),
    ),
    "direction": Claim(
        "Section 5, on (27)",
        "Training with -D(G) diverges at once",
        "D(G) is the sign of the plant's gain, so that -D(G) is the wrong sign. A run diverges "
        "at once if the temperature exceeds, within 150 samples, 90 % of the largest deviation "
        "that the flow can cause. According to the paper, the weights converge within 150 "
        "samples if the network has the right sign.",
        direction,
    ),
    "six-nodes": Claim(
        "Section 5, Fig. 12",
        "Six hidden nodes are no better than three",
        "Six nodes are better if the mean error is at least 5 % smaller than with three nodes. "
        "The gains are the learning rates of a network. Networks with six nodes run with the "
        "gains of the paper's network ('the same gains'), and with half of these gains for the "
        "weights and thresholds of hidden nodes ('gains in proportion').",
        partial(other_shapes, shapes={"6 hidden nodes": {"nodes": 6}}),
    ),
    "more-inputs": Claim(
        "Section 5, on the choice of inputs",
        "More delayed inputs are not superior",
        "The paper's network observes the latest three set points and the latest three errors. "
        "Here, networks observe the latest 6 or 20 values of each signal. More inputs are "
        "superior if the mean error is at least 5 % smaller. The gains are the learning rates "
        "of a network. The networks run with the gains of the paper's network ('the same "
        "gains'), and with smaller gains for the weights of the inputs: half as large with 6 "
        "values, and 3/20 as large with 20 values ('gains in proportion').",
        partial(
            other_shapes,
            shapes={f"{n} set points and errors": {"length": n} for n in (6, 20)},
        ),
    ),
    "reliability": Claim(
        "Section 5, last sentence",
        "More hidden nodes improve reliability",
        "After 600 samples at a set point of 5 °C, one hidden node fails: its output stays at "
        "0, or at 1, and the other nodes continue to learn. More nodes improve reliability if "
        "the mean error after the failure is at least 5 % smaller than with three nodes. A run "
        "has settled if the error stays within 5 % of the set point over 50 samples. The gains "
        "are the learning rates of a network. The networks run with the gains of the paper's "
        "network ('the same gains'), and with smaller gains for the weights and thresholds of "
        "hidden nodes: half as large with six nodes, and a quarter as large with twelve nodes "
        "('gains in proportion').",
        reliability,
    ),
    "keep-learning": Claim(
        "Section 4, last paragraph",
        "On a plant that changes the weights must keep being updated",
        "The network learns on the paper's plant for 1,200 samples of the square wave. Then "
        "the gain or the delay (in samples) of the plant changes, and the network controls the "
        "changed plant for 1,200 samples, from rest. In one run, the weights continue to "
        "learn; in another run, the weights are frozen. Learning is necessary if the mean "
        "error is at least 5 % smaller with learning weights than with frozen weights.",
        keep_learning,
    ),
    "direction-only": Claim(
        "Abstract and Section 6",
        "The direction of the response is all that need be known of a plant",
        "The direction is the sign of the plant's gain. The paper's network, with the learning "
        "rates of the paper's plant, controls other plants with the same direction, whose "
        "gains and time constants are multiples of those of the paper's plant. A run has "
        "settled if the error stays within 5 % of the set point over the last 50 samples. The "
        "network works on a plant if at least 90 % of the runs settle.",
        direction_only,
    ),
    "figures": Claim(
        "Section 5, Figs 5 to 12",
        "The curves of the figures themselves",
        "The text of the paper does not say with which set points, gains, initial weights and "
        "noise the curves were made. The command python -m benchmarks.compare draws the "
        "responses of both controllers on the same plants.",
        figures,
    ),
}


def examined(name: str, batch: Batch) -> list[Finding]:
    """Run the examination of a claim, and return all findings about the claim.

    `name` is a key of `CLAIMS`, and `batch` gives the number of runs and their seeds.
    """
    return list(CLAIMS[name].examine(batch))
