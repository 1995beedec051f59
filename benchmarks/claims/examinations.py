"""Run controllers to examine the paper's claims, and judge the results by criteria.

The paper is that of Cui and Shin (1992), whose controller is a neural network (NN) that learns
online. Each function of this module that takes a `Batch` of runs and returns `Findings`
examines one claim, or two similar claims.
"""

import itertools
import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import pandas as pd

from agents import DirectNNController, PIController
from benchmarks.claims.findings import MOST_RUNS, Finding, judge, judge_share, judge_times
from benchmarks.claims.runs import PAPER_LENGTH, Batch, converged_at
from benchmarks.loop import linear
from benchmarks.loop.measures import mean_error, settled
from benchmarks.loop.scenarios import SETPOINTS as PAPER_SETPOINTS
from benchmarks.loop.scenarios import Arguments, Scenario
from mptc_gym import PRESETS, Parameters
from mptc_gym.plant.parameters import EPISODE_STEPS
from mptc_gym.rollout import Act

# Limits that give words of the claims, such as "notable", a meaning. The limits were chosen
# before any run, and are the same for all claims.
NOTABLE_CHANGE = 0.05  # A relative change of an error is "notable" from this share on.
LARGE_CHANGE = 0.2  # "much better", "seriously worse": the error differs by at least this share
PAPER_CONVERGENCE = 150  # samples in which the weights converge, according to the paper

SETPOINT_LEVEL = 5.0  # degC, the constant set point, and the amplitude of the square wave
RUN_LENGTH = EPISODE_STEPS  # length of a run, samples, unless the case has another length
LEARNING_LENGTH = 600  # samples after which a network counts as trained
WITH_NOISE = PRESETS["noisy"]
NOISY_SQUARE = Scenario("noisy-square", "square wave, R = 0.5 °C²", RUN_LENGTH, WITH_NOISE)
# Cases with different set points. The case with a constant set point comes first, as the error
# in this case comes from initial learning alone.
SETPOINTS = PAPER_SETPOINTS[::-1]
CONSTANT_SETPOINT, SQUARE_WAVE = (setpoint.arguments for setpoint in SETPOINTS)
# Words for the learning rates ("gains") of a network with more nodes or inputs than the paper's
# network, by the argument `in_proportion` of `Batch.networks`.
WORDS_FOR_RATES = {False: "the same gains", True: "gains in proportion"}

# The gains of a PI controller: kp, t/h per degC, and ki, t/h per degC and sample.
PIGains = Mapping[str, float]
PAPER_PI = {"kp": 2.2, "ki": 0.3}
LOWER_PI = [{**PAPER_PI, "kp": float(kp)} for kp in np.linspace(0.1, PAPER_PI["kp"], 22)]
DOUBLED_PI = {**PAPER_PI, "kp": 2 * PAPER_PI["kp"]}

Findings = Iterable[Finding]


def convergence(batch: Batch) -> Findings:
    """Yield findings about the time after which the weights of the paper's network converge."""
    for setpoint in SETPOINTS:
        weights = batch.log_weights(setpoint.samples, **setpoint.arguments)
        times = converged_at(weights)  # samples; infinite if not converged
        title = setpoint.title
        yield judge_share(
            f"weights converged within {PAPER_CONVERGENCE} samples, {title}",
            times <= PAPER_CONVERGENCE,
            is_criterion=True,
        )
        yield from judge_times(f"time until the weights have converged, {title}", times)
        yield judge_share(f"weights not converged when the run ends, {title}", np.isinf(times))


def dead_zone(batch: Batch) -> Findings:
    """Compare the errors of the paper's network at dead zones of 5 and 7 t/h (half widths)."""
    for setpoint in SETPOINTS:
        title = setpoint.title
        narrow = batch.run_nn(setpoint.samples, **setpoint.arguments)
        wide = batch.run_nn(setpoint.samples, **setpoint.arguments, dead_zone=7.0)
        yield judge_share(
            f"settled when the run ends, dead zone 7 t/h, {title}",
            settled(wide),
            is_criterion=True,
        )
        yield judge(
            f"mean error at dead zone 7 t/h, as a multiple of the error at 5, {title}",
            mean_error(wide) / mean_error(narrow),
            at_least=1 + LARGE_CHANGE,
        )
        yield judge(f"mean error, dead zone 5 t/h, {title}", mean_error(narrow), "°C")
        yield judge(f"mean error, dead zone 7 t/h, {title}", mean_error(wide), "°C")


def noise(batch: Batch) -> Findings:
    """Compare the paper's network with an idle valve (a flow of 0 t/h) on plants with noise.

    At a constant set point, only the last 600 of 1,200 samples are evaluated, since the network
    has learnt by then.
    """
    idle_runs = batch.run_pi({"kp": 0.0, "ki": 0.0}, RUN_LENGTH, setpoint=0.0, **WITH_NOISE)
    idle_deviation = idle_runs[-600:].output.std(axis=0)
    runs = batch.run_nn(RUN_LENGTH, **CONSTANT_SETPOINT, **WITH_NOISE)[-600:]
    errors = runs.setpoint - runs.output
    yield judge(
        "absolute value of the average error over the last 600 of 1,200 samples, constant set "
        "point",
        np.abs(errors.mean(axis=0)),
        "°C",
        at_most=0.05 * SETPOINT_LEVEL,
    )
    yield judge(
        "standard deviation of y over the last 600 of 1,200 samples, as a multiple of the "
        "deviation without control",
        errors.std(axis=0) / idle_deviation,
        at_most=1 + LARGE_CHANGE,
    )
    square_errors = mean_error(batch.run_nn(RUN_LENGTH, **SQUARE_WAVE, **WITH_NOISE))
    is_better = square_errors < SETPOINT_LEVEL  # the mean error without control
    yield judge_share(
        "mean error below the error without control, square wave", is_better, is_criterion=True
    )
    yield judge("mean error, square wave", square_errors, "°C")
    yield judge("standard deviation of y without control", idle_deviation, "°C")


def pi_gains(batch: Batch) -> Findings:
    """Examine the paper's PI controller, and PI controllers with a lower or higher gain Kp.

    The paper claims that its PI controller oscillates, that a lower Kp is not notably better,
    and that a higher Kp makes the loop unstable.
    """
    kp = PAPER_PI["kp"]
    runs = batch.run_pi(PAPER_PI, RUN_LENGTH, **CONSTANT_SETPOINT)
    yield judge(
        f"peak to peak of y over the last 300 of 1,200 samples, Kp = {kp:g}, constant set "
        "point",
        np.ptp(runs.output[-300:]),
        "°C",
        at_least=2 * 0.05 * SETPOINT_LEVEL,
    )
    for case in (*SETPOINTS, NOISY_SQUARE):
        yield best_lower_gain(batch, case)
    runs = batch.run_pi(DOUBLED_PI, RUN_LENGTH, **CONSTANT_SETPOINT)
    limited_share = 100 * np.mean(np.abs(runs.applied[-300:]) == Parameters().u_max)
    yield judge(
        f"samples of the last 300 with the flow at a limit, Kp = {2 * kp:g}",
        limited_share,
        "%",
        at_least=50,
    )
    yield judge(
        f"largest pole without dead zone and limits, Kp = {2 * kp:g}: unstable above 1",
        largest_pole(DOUBLED_PI),
        at_least=1,
    )
    quantity = "largest pole without dead zone and limits"
    yield judge(f"{quantity}, Kp = {kp:g}", largest_pole(PAPER_PI))
    smallest = min(largest_pole(gains) for gains in LOWER_PI)
    yield judge(f"{quantity}, the best Kp of 0.1 to {kp:g}", smallest)


def best_lower_gain(batch: Batch, case: Scenario) -> Finding:
    """Compare the paper's PI controller with the best PI controller with a lower gain Kp.

    The runs have `RUN_LENGTH` samples, whatever the length of the case.
    """
    errors = [
        mean_error(batch.run_pi(gains, RUN_LENGTH, **case.arguments)) for gains in LOWER_PI
    ]
    paper_errors = errors[-1]  # LOWER_PI ends with the paper's gains.
    medians = [float(np.median(error)) for error in errors[:-1]]
    best = int(np.argmin(medians))
    return judge(
        f"mean error with the best lower Kp ({LOWER_PI[best]['kp']:.1f}) as a multiple of "
        f"the error with {PAPER_PI['kp']:g}, {case.title}",
        (errors[best] / paper_errors).squeeze(),  # Without noise, each array has one number.
        at_least=1 - NOTABLE_CHANGE,
    )


def largest_pole(gains: PIGains) -> float:
    """Return the largest magnitude of the poles of a PI controller's loop on the paper's plant.

    Dead zone and limits of the actuator are left out of the loop. The loop is stable if the
    largest magnitude of its poles is below 1.
    """
    plant = linear.nominal(Parameters())
    return linear.LinearLoop.of(PIController(gains["kp"], gains["ki"]), plant).largest_pole()


def against_pi(batch: Batch, gains: PIGains) -> Findings:
    """Compare the errors of the paper's network and of a PI controller in the same noise."""
    for noise_title, noise_arguments in (("", {}), (", R = 0.5 °C²", WITH_NOISE)):
        for setpoint in SETPOINTS:
            arguments = {**setpoint.arguments, **noise_arguments}
            nn_errors = mean_error(batch.run_nn(setpoint.samples, **arguments))
            pi_errors = mean_error(batch.run_pi(gains, setpoint.samples, **arguments))
            case = f"{setpoint.title}{noise_title}"
            yield judge(
                f"mean error of the NN as a multiple of the PI's, {case}",
                nn_errors / pi_errors,
                at_most=1 - LARGE_CHANGE,
            )
            yield judge_share(f"the NN is better, {case}", nn_errors < pi_errors)
    nn_errors = mean_error(batch.run_nn(RUN_LENGTH, dead_zone=7.0))
    pi_errors = mean_error(batch.run_pi(gains, RUN_LENGTH, dead_zone=7.0))
    yield judge(
        "mean error of the NN as a multiple of the PI's, square wave, dead zone 7 t/h",
        nn_errors / pi_errors,
    )


def wrong_direction(batch: Batch) -> Findings:
    """Measure when runs diverge if the networks assume the wrong sign of the plant's gain.

    A run has diverged when the magnitude of the temperature exceeds 90 % of the largest steady
    temperature change that the flow can cause within its limits.
    """
    runs = batch.run(batch.networks(direction=1), 600, **CONSTANT_SETPOINT)
    plant = Parameters()
    largest_deviation = abs(linear.nominal(plant).gain) * plant.u_max  # degC
    is_beyond = np.abs(runs.output) > 0.9 * largest_deviation
    times = np.where(is_beyond.any(axis=0), np.argmax(is_beyond, axis=0), np.inf)
    yield judge_share(
        "temperature exceeds 90 % of the largest deviation that the flow can cause, in either "
        f"direction, within {PAPER_CONVERGENCE} samples",
        times <= PAPER_CONVERGENCE,
        is_criterion=True,
    )
    yield judge_share(
        "temperature exceeds this share when the run ends, after 600 samples",
        is_beyond[-1],
        is_criterion=True,
    )
    yield judge_share("temperature is on the wrong side when the run ends", runs.output[-1] < 0)
    yield from judge_times("time until the temperature exceeds this share", times)


def other_shapes(batch: Batch, shapes: Mapping[str, dict[str, int]]) -> Findings:
    """Compare networks with more nodes or inputs with the paper's network.

    `shapes` maps the title of each kind of network in the report to arguments of
    `Batch.networks`: {"6 hidden nodes": {"nodes": 6}}, for example. Each kind of network runs
    with the paper's learning rates, and with smaller learning rates (the argument
    `in_proportion` of `Batch.networks`).
    """
    for case in (*SETPOINTS, NOISY_SQUARE):
        paper_errors = mean_error(batch.run_nn(case.samples, **case.arguments))
        for (title, shape), in_proportion in itertools.product(shapes.items(), (False, True)):
            networks = batch.networks(**shape, in_proportion=in_proportion)
            length = shape.get("length", PAPER_LENGTH)
            windows: Arguments = {"setpoint_window": length, "error_window": length}
            runs = batch.run(networks, case.samples, **case.arguments, **windows)
            rates = WORDS_FOR_RATES[in_proportion]
            yield judge(
                f"mean error with {title}, {rates}, as a multiple of the error of the paper's "
                f"network, {case.title}",
                mean_error(runs) / paper_errors,
                at_least=1 - NOTABLE_CHANGE,
            )


def reliability(batch: Batch) -> Findings:
    """Compare networks of 3, 6 and 12 hidden nodes, before and after the failure of a node.

    The paper claims that more nodes make the control more reliable. In each network, one hidden
    node fails after `LEARNING_LENGTH` samples: from then on, the output of this node is always
    0, or always 1.
    """
    for in_proportion, stuck_at in itertools.product((False, True), (0, 1)):
        errors = {}  # mean errors after the failure, by the number of nodes
        for nodes in (3, 6, 12):
            networks = batch.networks(nodes=nodes, in_proportion=in_proportion)
            act = with_failing_node(networks, stuck_at)
            signals = batch.run(act, 2 * LEARNING_LENGTH, **CONSTANT_SETPOINT)
            before, after = signals[:LEARNING_LENGTH], signals[LEARNING_LENGTH:]
            errors[nodes] = mean_error(after)
            case = f"{nodes} nodes, one stuck at {stuck_at}, {WORDS_FOR_RATES[in_proportion]}"
            if stuck_at == 0:  # Before the failure, the runs are the same for 0 and 1.
                yield judge_share(f"settled before the failure, {case}", settled(before))
            yield judge_share(f"settled 600 samples after the failure, {case}", settled(after))
            yield judge(
                f"mean error in the 600 samples after the failure, {case}", errors[nodes], "°C"
            )
            if nodes > 3:
                yield judge(
                    f"this mean error as a multiple of the error with 3 nodes, {case}",
                    errors[nodes] / errors[3],
                    at_most=1 - NOTABLE_CHANGE,
                )


def with_failing_node(networks: DirectNNController, stuck_at: int) -> Act:
    """Return a function that acts like networks in which the first hidden node fails.

    The function must be called once for each sample of a run. From sample `LEARNING_LENGTH` on,
    the output of the failed node is always `stuck_at`, which is 0 or 1. All other nodes
    continue to learn.
    """
    samples = itertools.count()

    def act(observations: Any) -> Any:
        """Return the actions of the networks, after the failure if it is time for it."""
        if next(samples) == LEARNING_LENGTH:
            weights = networks.weights  # a copy
            weights.W[..., 0, :] = 0.0  # The node no longer depends on its inputs.
            # With a threshold of this size, the slope of the node's sigmoid function is 0, so
            # that the node cannot learn.
            weights.theta_1[..., 0] = 1e6 if stuck_at else -1e6
            networks.weights = weights
        return networks.act(observations)

    return act


def keep_learning(batch: Batch) -> Findings:
    """Compare learning and frozen networks on plants that differ from the training plant.

    The networks first learn on the paper's plant. Then they run on plants with another gain or
    delay, while their weights either continue to learn or are frozen.
    """
    networks = batch.networks()
    batch.run(networks, RUN_LENGTH, **SQUARE_WAVE)
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
        errors = {}  # mean errors, by whether the weights learn
        for learning in (True, False):
            networks.weights = learnt_weights
            networks.learning = learning
            runs = batch.run(networks, RUN_LENGTH, **SQUARE_WAVE, **plant)
            errors[learning] = mean_error(runs)
        learning_errors, frozen_errors = errors[True], errors[False]
        at_most = math.inf  # Without a change, the number is for information only.
        if plant:
            at_most = 1 - NOTABLE_CHANGE
        yield judge(
            f"mean error of learning weights divided by that of frozen weights, {title}",
            learning_errors / frozen_errors,
            at_most=at_most,
        )
        yield judge(f"mean error of frozen weights, {title}", frozen_errors, "°C")
        is_useless = frozen_errors >= SETPOINT_LEVEL  # the mean error without control
        yield judge_share(f"frozen weights do no better than no control, {title}", is_useless)


def direction_only(batch: Batch) -> Findings:
    """Measure how often the paper's network settles on plants with other parameter values.

    The steady flow for a set point of 5 degC lies beyond the actuator's limits if the gain is
    below about 0.733 of the paper's gain, and inside the dead zone if the gain is above about
    1.465 of the paper's gain. Hence the network runs on all plants twice: with a set point of
    5 degC, and with a set point of 5 degC times the gain factor of the plant (the plant's gain
    as a multiple of the paper's gain).
    """
    fixed = plants_that_settle(batch, gains=(0.75, 1.0, 1.25, 1.4), is_scaled=False)
    scaled = plants_that_settle(batch, gains=(0.7, 1.0, 1.25, 1.5), is_scaled=True)
    series = {"set point 5 °C": fixed, "set point 5 °C times the gain": scaled}

    delays = fixed.query("constant == 1 and gain == 1")
    yield judge_worst(delays, "delays from 9 to 36, set point 5 °C")
    constants = fixed.query("gain == 1 and delay == 18")
    text = "time constants from 0.5 to 2 times the paper's, set point 5 °C"
    yield judge_worst(constants, text)
    for setpoint, plants in series.items():
        lowest, highest = plants["gain"].min(), plants["gain"].max()
        text = f"gains from {lowest:g} to {highest:g} times the paper's, {setpoint}"
        yield judge_worst(plants.query("constant == 1 and delay == 18"), text)
    for setpoint, plants in series.items():
        yield judge_worst(plants, f"all {len(plants)} combinations, {setpoint}")
        yield judge(
            f"combinations in which at least {MOST_RUNS:.0%} of runs settle, {setpoint}",
            100 * (plants["share"] >= MOST_RUNS).mean(),
            "%",
        )


def plants_that_settle(
    batch: Batch, gains: Iterable[float], *, is_scaled: bool
) -> pd.DataFrame:
    """Run the paper's network on several plants, and return a table with a row for each plant.

    The plants are all combinations of three time constants, four delays, and the gain factors
    `gains`, which are multiples of the paper's gain. If `is_scaled` is true, the set point is
    5 degC times the gain factor of the plant; otherwise, the set point is 5 degC.

    Returns
    -------
    DataFrame
        The table has the columns `constant` and `gain` (time constant and gain of the plant, as
        multiples of the paper's values), `delay` (samples), `runs` (an array of shape (runs,)
        that says whether each run settles) and `share` (the share of runs that settle, from 0
        to 1).
    """
    rows = []
    for constant, gain, delay in itertools.product((0.5, 1.0, 2.0), gains, (9, 18, 27, 36)):
        plant = {"gain_factor": gain, "time_constant_factor": constant, "delay": delay}
        setpoint = SETPOINT_LEVEL * gain if is_scaled else SETPOINT_LEVEL
        settles = settled(batch.run_nn(RUN_LENGTH, setpoint=setpoint, **plant))
        row = {"constant": constant, "gain": gain, "delay": delay}
        rows.append({**row, "runs": settles, "share": settles.mean()})
    return pd.DataFrame(rows)


def judge_worst(plants: pd.DataFrame, text: str) -> Finding:
    """Judge the share of runs that settle, on the plant with the smallest share.

    `plants` are rows of the table that `plants_that_settle` returns, and `text` describes these
    plants in the report.
    """
    worst = plants.iloc[plants["share"].argmin()]
    quantity = (
        f"settled within 1,200 samples, the worst of {text} (delay {worst['delay']}, gain "
        f"{worst['gain']:g}, time constant {worst['constant']:g})"
    )
    return judge_share(quantity, worst["runs"], is_criterion=True)
