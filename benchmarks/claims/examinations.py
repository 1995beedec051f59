"""The examination of each claim: what is run, what is measured, and what is asked of it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from agents.pi import SEARCHED_GAINS
from benchmarks.claims.runs import (
    Batch,
    Network,
    converged_at,
    fail_node,
    flat,
    hidden_nodes,
    with_gains,
)
from benchmarks.claims.verdicts import OFTEN, Results
from benchmarks.lib.statistics import Estimate, exact, median, share
from benchmarks.loop.metrics import mean_error, settled, split
from benchmarks.loop.scenarios import SETPOINTS as CASES
from mptc_gym import PRESETS, Parameters

# What words are taken to mean: set before the numbers were known, the same for all claims.
NOTABLE = 0.05  # an error that changes by less has not changed notably
MUCH = 0.2  # "much better", "seriously worse": an error that differs by this share or more
SOON = 150  # samples: the paper's own number for the time that the weights take

NOISY = PRESETS["noisy"]
CASES_OF = {name: arguments for name, _, _, arguments in CASES}
CONSTANT, SQUARE = CASES_OF["constant"], CASES_OF["square"]
# The constant set point first: it shows the first learning alone.
SETPOINTS = tuple((title, arguments, samples) for _, title, samples, arguments in CASES[::-1])
PAPER_PI = (2.2, 0.3)  # Kp, Ki
KI = PAPER_PI[1]
SEARCHED_PI = (SEARCHED_GAINS["kp"], SEARCHED_GAINS["ki"])
LEARNING = 600  # samples after which a network is taken to have learnt
GAINS = {False: "the same gains", True: "gains in proportion"}  # of networks of other shapes


def ratio(errors: NDArray[np.float64], reference: NDArray[np.float64]) -> Estimate:
    """Return the median ratio of the mean errors of two controllers in the same runs."""
    ratios = errors / reference
    return median(ratios) if len(ratios) > 1 else exact(ratios[0])


def convergence(batch: Batch, results: Results) -> None:
    """Find when the weights converge."""
    times = {}
    for name, arguments, samples in SETPOINTS:
        network = batch.network()
        weights: list[NDArray[np.float32]] = []

        def record(_: int) -> None:
            weights.append(flat(network.weights))  # noqa: B023 (called at once)

        batch.run(network, samples, record, **arguments)
        times[name] = converged_at(np.array(weights))
        soon = f"weights converged within {SOON} samples, {name}"
        results.ask_share(soon, times[name] <= SOON, often=True)
        results.ask_time(f"time until the weights have converged, {name}", times[name])
        never = f"weights not converged when the run ends, {name}"
        results.ask_share(never, np.isinf(times[name]))
    results.tables["convergence"] = pd.DataFrame(times)


def dead_zone(batch: Batch, results: Results) -> None:
    """Find what a dead zone of 7 t/h costs."""
    for name, arguments, samples in SETPOINTS:
        small = batch.run_nn(samples, **arguments)
        large = batch.run_nn(samples, **arguments, dead_zone=7.0)
        at_the_end = f"settled when the run ends, dead zone 7 t/h, {name}"
        results.ask_share(at_the_end, settled(large), often=True)
        results.ask(
            f"mean error at dead zone 7 t/h, as a multiple of that at 5 t/h, {name}",
            ratio(mean_error(large), mean_error(small)), at_least=1 + MUCH,
        )  # fmt: skip
        for zone, runs in ((5, small), (7, large)):
            results.ask(
                f"mean error, dead zone {zone} t/h, {name}", median(mean_error(runs)), "°C"
            )


def noise(batch: Batch, results: Results) -> None:
    """Find whether the network works under noise."""
    samples, steady = 1200, slice(-600, None)
    idle = batch.run_pi(0.0, 0.0, samples, setpoint=0.0, **NOISY)
    runs = batch.run_nn(samples, **CONSTANT, **NOISY)
    error = (runs.setpoint - runs.output)[steady]
    results.ask(
        "mean of e over the last 600 of 1,200 samples, its size, constant set point",
        median(np.abs(error.mean(axis=0))), "°C", at_most=0.05 * 5.0,
    )  # fmt: skip
    results.ask(
        "standard deviation of y over these samples, as a multiple of that without control",
        ratio(error.std(axis=0), idle.output[steady].std(axis=0)), at_most=1 + MUCH,
    )  # fmt: skip
    square = batch.run_nn(samples, **SQUARE, **NOISY)
    below = mean_error(square) < 5.0
    results.ask_share("mean error below that of doing nothing, square wave", below, often=True)
    results.ask("mean error, square wave", median(mean_error(square)), "°C")
    results.ask(
        "standard deviation of y without control", median(idle.output[steady].std(axis=0)), "°C"
    )


def pi_gains(batch: Batch, results: Results) -> None:
    """Find how the paper's PI controller behaves, and what other Kp do to it."""
    kp = PAPER_PI[0]
    samples = 1200
    paper = batch.run_pi(*PAPER_PI, samples, **CONSTANT)
    results.ask(
        "peak to peak of y over the last 300 of 1,200 samples, Kp = 2.2, constant set point",
        exact(np.ptp(paper.output[-300:])), "°C", at_least=2 * 0.05 * 5.0,
    )  # fmt: skip
    gains = np.linspace(0.1, kp, 22)  # the last is the paper's
    rows = []
    for name, arguments in (
        ("constant set point", CONSTANT), ("square wave", SQUARE),
        ("square wave, R = 0.5 °C²", NOISY),
    ):  # fmt: skip
        errors = {
            gain: mean_error(batch.run_pi(gain, KI, samples, **arguments)) for gain in gains
        }
        rows += [
            {"setpoint": name, "kp": gain, "mean_error": float(np.median(error))}
            for gain, error in errors.items()
        ]
        *others, paper_gain = errors
        best = min(others, key=lambda gain: float(np.median(errors[gain])))
        results.ask(
            f"mean error with the best lower Kp ({best:.1f}) as a multiple of that with "
            f"{kp:g}, {name}",
            ratio(errors[best], errors[paper_gain]), at_least=1 - NOTABLE,
        )  # fmt: skip
    doubled = batch.run_pi(2 * kp, KI, samples, **CONSTANT)
    results.ask(
        f"samples of the last 300 with the flow at a limit, Kp = {2 * kp:g}",
        exact(100 * np.mean(np.abs(doubled.applied[-300:]) == Parameters().u_max)), "%",
        at_least=50,
    )  # fmt: skip
    results.ask(
        f"largest pole without dead zone and limits, Kp = {2 * kp:g}: unstable above 1",
        exact(largest_pole(2 * kp, KI)), at_least=1,
    )  # fmt: skip
    results.ask("the same, Kp = 2.2", exact(largest_pole(*PAPER_PI)))
    results.ask(
        "the same, the best Kp of 0.1 to 2.2",
        exact(min(largest_pole(gain, KI) for gain in gains)),
    )
    results.tables["pi_gains"] = pd.DataFrame(rows)


def largest_pole(kp: float, ki: float) -> float:
    """Return the modulus of the largest pole of the loop of PI controller and linear plant.

    With e = y_d - y and u = -(Kp + Ki / (1 - z^-1)) e, (28) gives the characteristic polynomial
    A(z^-1) (1 - z^-1) - z^-d B(z^-1) (Kp (1 - z^-1) + Ki).
    """
    plant = Parameters()
    delay = int(plant.range_of("delay")[0])
    characteristic = -np.convolve([*[0.0] * (delay + 1), *plant.b], [kp + ki, -kp])
    open_loop = np.convolve(plant.a, [1.0, -1.0])
    characteristic[: len(open_loop)] += open_loop
    return float(np.abs(np.roots(characteristic)).max())


def versus_pi(gains: tuple[float, float], batch: Batch, results: Results) -> None:
    """Compare the network with a PI controller that has these gains."""
    for noise_name, noise_arguments in (("", {}), (", R = 0.5 °C²", NOISY)):
        for name, setpoint, samples in SETPOINTS:
            arguments = {**setpoint, **noise_arguments}
            nn = mean_error(batch.run_nn(samples, **arguments))
            pi = mean_error(batch.run_pi(*gains, samples, **arguments))
            case = f"{name}{noise_name}"
            results.ask(
                f"mean error of the NN as a multiple of the PI's, {case}", ratio(nn, pi),
                at_most=1 - MUCH,
            )  # fmt: skip
            results.ask_share(f"the NN is better, {case}", nn < pi)
    nn = mean_error(batch.run_nn(1200, dead_zone=7.0))
    pi = mean_error(batch.run_pi(*gains, 1200, dead_zone=7.0))
    results.ask("the same ratio, square wave, dead zone 7 t/h", ratio(nn, pi))


def direction(batch: Batch, results: Results) -> None:
    """Find what the wrong direction does."""
    runs = batch.run(batch.network(direction=1), 600, **CONSTANT)
    plant = Parameters()
    reachable = abs(sum(plant.b) / sum(plant.a)) * plant.range_of("u_max")[1]  # degC
    beyond = np.abs(runs.output) > 0.9 * reachable
    when = np.where(beyond.any(axis=0), np.argmax(beyond, axis=0), np.inf)
    soon = f"y beyond 90 % of what the flow can do, either way, within {SOON} samples"
    results.ask_share(soon, when <= SOON, often=True)
    late = "the same when the run ends, after 600 samples"
    results.ask_share(late, beyond[-1], often=True)
    results.ask_share("the same, on the wrong side", runs.output[-1] < 0)
    results.ask_time("time until y is beyond it", when)


def against_the_paper(networks: Sequence[Network], batch: Batch, results: Results) -> None:
    """Compare other networks with that of the paper."""
    for case, arguments, samples in (*SETPOINTS, ("square wave, R = 0.5 °C²", NOISY, 1200)):
        paper = mean_error(batch.run_nn(samples, **arguments))
        for network, slower in itertools.product(networks, (False, True)):
            controller = with_gains(batch, network, slower=slower)
            runs = batch.run(controller, samples, **arguments, **network.windows)
            results.ask(
                f"mean error with {network.name}, {GAINS[slower]}, as a multiple of that "
                f"of the paper's network, {case}",
                ratio(mean_error(runs), paper), at_least=1 - NOTABLE,
            )  # fmt: skip


def node_failure(batch: Batch, results: Results) -> None:
    """Find how networks of several sizes recover from the failure of a hidden node."""
    for slower, stuck_at in itertools.product((False, True), (0, 1)):
        error = {}
        for nodes in (3, 6, 12):
            controller = with_gains(batch, hidden_nodes(nodes), slower=slower)

            def damage(k: int) -> None:
                if k == LEARNING:
                    fail_node(controller, stuck_at)  # noqa: B023 (called at once)

            runs = batch.run(controller, 2 * LEARNING, damage, **CONSTANT)
            before, after = split(runs, LEARNING)
            error[nodes] = mean_error(after)
            case = f"{nodes} nodes, one stuck at {stuck_at}, {GAINS[slower]}"
            if stuck_at == 0:
                results.ask_share(f"settled before the failure, {case}", settled(before))
            results.ask_share(f"settled 600 samples after the failure, {case}", settled(after))
            results.ask(f"mean error in these samples, {case}", median(error[nodes]), "°C")
            if nodes > 3:
                results.ask(
                    f"the same as a multiple of that with 3 nodes, {case}",
                    ratio(error[nodes], error[3]), at_most=1 - NOTABLE,
                )  # fmt: skip


def changing_plant(batch: Batch, results: Results) -> None:
    """Find whether weights must keep learning when the plant changes."""
    network = batch.network()
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
        results.ask(
            f"mean error of learning weights as a multiple of that of frozen ones, {name}",
            ratio(error[True], error[False]),
            at_most=1 - NOTABLE if plant else math.inf,
        )  # fmt: skip
        results.ask(f"mean error of frozen weights, {name}", median(error[False]), "°C")
        useless = f"frozen weights do no better than no control, {name}"
        results.ask_share(useless, error[False] >= 5.0)


def other_plants(batch: Batch, results: Results) -> None:
    """Find on which plants of the same direction the same gains work."""
    nominal = {"delay": 18, "gain": 1.0, "time_constant": 1.0}
    # The gain changes the flow that a set point needs. With too much gain that lies inside the
    # dead zone, with too little beyond the limits: for 5 degC below 0.74 and above 1.46.
    families = {
        "set point 5 °C": (0.75, 1.0, 1.25, 1.4),
        "set point 5 °C times the gain": (0.7, 1.0, 1.25, 1.5),
    }
    rows: list[dict[str, Any]] = []
    for family, gains in families.items():
        for time_constant, gain, delay in itertools.product(
            (0.5, 1.0, 2.0), gains, (9, 18, 27, 36)
        ):
            setpoint = 5.0 * gain if "times" in family else 5.0
            plant = {"gain_factor": gain, "time_constant_factor": time_constant}
            runs = batch.run_nn(1200, setpoint=setpoint, delay=delay, **plant)
            about = {"delay": delay, "gain": gain, "time_constant": time_constant}
            found = {"settled": share(settled(runs)), "mean_error": np.median(mean_error(runs))}
            rows.append({"setpoint": family, **about, **found})

    def ask(text: str, of: Iterable[dict[str, Any]]) -> None:
        worst = min(of, key=lambda row: row["settled"].value)
        where = ", ".join(f"{name.replace('_', ' ')} {worst[name]:g}" for name in nominal)
        quantity = f"settled within 1,200 samples, the worst of {text} ({where})"
        results.ask_share(quantity, worst["settled"], often=True)

    for name, text in (
        ("delay", "delays from 9 to 36"),
        ("time_constant", "time constants from 0.5 to 2 times the paper's"),
        ("gain", "gains from 0.7 to 1.5 times the paper's"),
    ):
        others = [other for other in nominal if other != name]
        alone = [row for row in rows if all(row[other] == nominal[other] for other in others)]
        for family in families if name == "gain" else list(families)[:1]:
            ask(f"{text}, {family}", [row for row in alone if row["setpoint"] == family])
    for family in families:
        those = [row for row in rows if row["setpoint"] == family]
        ask(f"all {len(those)} combinations, {family}", those)
        works = [row["settled"].value >= OFTEN for row in those]
        results.ask(
            f"combinations in which at least {OFTEN:.0%} of draws settle, {family}",
            exact(100 * float(np.mean(works))), "%",
        )  # fmt: skip
    results.tables["other_plants"] = pd.DataFrame(
        [{**row, "settled": row["settled"].value} for row in rows]
    )


def nothing(batch: Batch, results: Results) -> None:
    """Find nothing: the paper does not say enough for a test."""
