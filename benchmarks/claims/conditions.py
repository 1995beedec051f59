"""Run the paper's network and PI controllers under the conditions of the claims, and measure.

A measured quantity has the name "QUANTITY, CONDITION", such as "error, dead zone 7", and an
array of shape (settings, runs). Errors are avoidable errors, unless a name or a docstring says
otherwise: the mean of |e| minus the reference error of the same case.
"""

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np

from agents import DirectNNController, PIController
from agents.pi import SEARCHED_GAINS
from benchmarks.bounds import reference_error
from benchmarks.claims.settings import Array, Batch
from benchmarks.loop import linear
from benchmarks.loop.measures import mean_error, settled
from benchmarks.loop.runs import make_plants
from benchmarks.loop.scenarios import Arguments
from mptc_gym import PRESETS, Parameters
from mptc_gym.plant.parameters import EPISODE_STEPS
from mptc_gym.rollout import Act, rollout, start

Measured = dict[str, Array]

CONVERGENCE = 150  # samples in which the weights converge, according to the paper
# The weights of a network have converged if, for at least `CONVERGED_SAMPLES` samples at the
# end of a run, their distance from their final values is at most `CONVERGED_SHARE` times the
# distance at the start of the run.
CONVERGED_SHARE = 0.05
CONVERGED_SAMPLES = 100
FAILURE = 600  # sample at which a hidden node fails
RUN_LENGTH = EPISODE_STEPS  # length of all runs that learn, fail or change, samples
WINDOW = (
    EPISODE_STEPS  # samples over which an error in continuous operation is averaged: 160 min
)
DAY = 10_800  # samples of a day

# Plants on which networks run, by the name of the condition.
PLANTS: dict[str, Arguments] = {
    "plain": {},
    "noise": PRESETS["noisy"],
    "dead zone 7": PRESETS["dead-zone-7"],
}
# The gains of the paper's PI controller, and the same with Ki read as a gain per minute.
PAPER_PI = {"PI": {"kp": 2.2, "ki": 0.3}, "PI per minute": {"kp": 2.2, "ki": 0.3 * 8 / 60}}
LOWER_KP = np.linspace(0.1, 2.2, 22)
# Plants other than the one on which a network has learnt.
CHANGED_PLANTS: dict[str, Arguments] = {
    "gain 0.8": {"gain_factor": 0.8},
    "gain 1.25": {"gain_factor": 1.25},
    "delay 27": {"delay": 27},
}
OTHER_PLANTS: dict[str, Arguments] = {
    "delay 9": {"delay": 9},
    "delay 36": {"delay": 36},
    "time constant 0.5": {"time_constant_factor": 0.5},
    "time constant 2": {"time_constant_factor": 2.0},
    "gain 0.5": {"gain_factor": 0.5},
    "gain 2": {"gain_factor": 2.0},
}
# How a network that has learnt goes on: whether it learns, and the interval of its updates.
UPDATES = {
    "learning": (True, 1),
    "frozen": (False, 1),
    "every 2nd sample": (True, 2),
    "every 5th sample": (True, 5),
}


def measure(batch: Batch, is_complete: bool = True) -> dict[str, Measured]:
    """Measure the conditions of all claims, by the set point: "constant" or "square".

    If not `is_complete`, only those of the results that the paper reports are measured.
    """
    setpoint = {"setpoint": batch.level}
    constant = responses(batch, 600, setpoint) | lower_gains(batch, setpoint)
    constant["converged"] = weights_converged(batch, 600, setpoint)
    wave = {"setpoint_amplitude": batch.level}
    square = responses(batch, RUN_LENGTH, wave) | lower_gains(batch, wave)
    if is_complete:
        constant |= failures(batch) | other_plants(batch)
        square |= changed_plants(batch, wave) | day(batch, wave)
    return {"constant": constant, "square": square}


def responses(batch: Batch, samples: int, setpoint: Arguments) -> Measured:
    """Measure errors, settling and divergence of networks and PI controllers from rest."""
    # "same rates", in_proportion=False: a larger network has the same learning rates as the
    # paper's network, not lower ones.
    conditions: dict[str, tuple[Any, Arguments]] = {
        **{name: (batch.networks(), plant) for name, plant in PLANTS.items()},
        "wrong sign": (batch.networks(direction=1), {}),
        "6 nodes": (batch.networks(nodes=6), {}),
        "6 nodes, same rates": (batch.networks(nodes=6, in_proportion=False), {}),
    }
    for length in (6, 20):
        windows = {"setpoint_window": length, "error_window": length}
        for in_proportion, rates in ((True, ""), (False, ", same rates")):
            networks = batch.networks(length=length, in_proportion=in_proportion)
            conditions[f"{length} inputs{rates}"] = networks, windows
    for name, gains in PAPER_PI.items():
        controller = PIController(gains["kp"], gains["ki"])
        conditions[name] = controller, {}
        conditions[f"{name}, noise"] = controller, PLANTS["noise"]
    measured: Measured = {}
    for name, (agent, plant) in conditions.items():
        if not can_hold(batch.level, plant):
            # Some levels cannot be held with a dead zone of 7 t/h, but all can on the other
            # plants. No claim is about divergence with this dead zone, so "diverged" is left
            # out.
            nothing = np.full((len(batch.settings), batch.runs), np.nan)
            measured |= {f"error, {name}": nothing, f"settled, {name}": nothing}
            continue
        trajectory = batch.run(agent, samples, **setpoint, **plant)
        case = {key: value for key, value in plant.items() if not key.endswith("_window")}
        error = mean_error(trajectory) - reference(samples, **setpoint, **case)
        early_error = trajectory.next_error[CONVERGENCE - 1]  # e(150)
        # A network that has diverged leaves the flow at a limit, so the temperature ends near
        # its largest deviation; 90 % of it counts as near.
        is_beyond = np.abs(trajectory.output[-1]) > 0.9 * largest_deviation()
        measured[f"error, {name}"] = batch.by_setting(error)
        measured[f"settled, {name}"] = batch.by_setting(settled(trajectory))
        # An idle valve has an error of the size of the set point.
        measured[f"diverged, {name}"] = batch.by_setting(
            (np.abs(early_error) > batch.level) & is_beyond
        )
    return measured


def can_hold(level: float, plant: Arguments) -> bool:
    """Return whether the flow on a plant that a set point needs is one that can be applied."""
    parameters = Parameters(**plant)
    flow = level / abs(float(linear.nominal(parameters).gain))
    return parameters.lowest.dead_zone <= flow <= parameters.lowest.u_max


def largest_deviation() -> float:
    """Return the largest steady temperature change that the flow can cause, degC."""
    parameters = Parameters()
    return abs(float(linear.nominal(parameters).gain)) * parameters.lowest.u_max


def reference(samples: int, **arguments: Any) -> float:
    """Return the reference error of a case from rest, degC."""
    return reference_error(samples=samples, **arguments).value


def weights_converged(batch: Batch, samples: int, setpoint: Arguments) -> Array:
    """Return whether the weights of each loop have converged, shape (settings, runs)."""
    networks = batch.networks()
    log = []

    def act(observations: Any) -> Any:
        """Log all weights, and return the actions of the networks."""
        arrays = vars(networks.weights).values()
        columns = [array.reshape(batch.loops, -1) for array in arrays]
        log.append(np.hstack(columns, dtype=np.float32))
        return networks.act(observations)

    batch.run(act, samples, **setpoint)
    return batch.by_setting(converged_at(np.array(log)) <= CONVERGENCE)


def converged_at(weights: Any) -> Array:
    """Return the sample at which the weights of each run have converged, shape (runs,).

    The weights have converged at the first sample from which on their Euclidean distance from
    their final values is at most `CONVERGED_SHARE` times the distance at the start of the run.
    The result is infinite for a run whose weights converge less than `CONVERGED_SAMPLES`
    samples before the end of the run, since these weights may still be changing when the run
    ends.

    `weights` has the weights of the networks before each sample, shape (samples, runs,
    weights).
    """
    samples = len(weights)
    distances = np.linalg.norm(weights - weights[-1], axis=2)
    is_outside = distances > CONVERGED_SHARE * distances[0]
    # In reversed time, the index of the first sample outside is the number of converged
    # samples.
    converged_samples = np.argmax(is_outside[::-1], axis=0)
    # 0 for weights that never changed.
    first_converged = np.where(is_outside.any(axis=0), samples - converged_samples, 0)
    is_long_enough = first_converged <= samples - CONVERGED_SAMPLES
    return np.where(is_long_enough, first_converged, np.inf)


def lower_gains(batch: Batch, setpoint: Arguments) -> Measured:
    """Measure the paper's PI controller, and PI controllers with a lower or higher gain Kp.

    Without noise, all loops of a batch are equal.
    """
    measured = {}
    loops = Batch(batch.settings[:1], batch.level, len(LOWER_KP), batch.seed)
    for name, gains in PAPER_PI.items():
        controllers = PIController(gains["kp"], gains["ki"])
        vars(controllers).update(kp=LOWER_KP)  # a gain for each loop; the last is the paper's
        runs = loops.run(controllers, RUN_LENGTH, **setpoint)
        errors = mean_error(runs) - reference(RUN_LENGTH, **setpoint)
        doubled = {**gains, "kp": 2 * gains["kp"]}
        numbers = {
            "error of the best lower Kp": errors[:-1].min() / errors[-1],
            "swing": np.ptp(runs.output[-150:, -1]) / batch.level,
            "pole": largest_pole(gains),
            "pole, twice Kp": largest_pole(doubled),
        }
        for quantity, number in numbers.items():
            measured[f"{quantity}, {name}"] = np.full((len(batch.settings), batch.runs), number)
    return measured


def largest_pole(gains: Mapping[str, float]) -> float:
    """Return the largest magnitude of the poles of a PI controller's loop on the paper's plant.

    Dead zone and limits of the actuator are left out of the loop. The loop is stable if the
    largest magnitude of its poles is below 1.
    """
    plant = linear.nominal(Parameters())
    return linear.LinearLoop.of(PIController(gains["kp"], gains["ki"]), plant).largest_pole()


def failures(batch: Batch) -> Measured:
    """Measure networks in which a node fails, at a constant set point.

    The errors are mean errors after the failure, not avoidable errors.
    """
    measured = {}
    for nodes, rates in ((3, ""), (6, ""), (6, ", same rates")):
        for stuck_at in (0, 1):
            networks = batch.networks(nodes=nodes, in_proportion=not rates)
            act = with_failing_node(networks, stuck_at)
            after = batch.run(act, RUN_LENGTH, setpoint=batch.level)[FAILURE:]
            name = f"error, {nodes} nodes, one stuck at {stuck_at}{rates}"
            measured[name] = batch.by_setting(mean_error(after))
    return measured


def other_plants(batch: Batch) -> Measured:
    """Measure networks on other plants, at constant set points in proportion to the gain."""
    measured = {}
    for name, plant in OTHER_PLANTS.items():
        setpoint = batch.level * plant.get("gain_factor", 1.0)
        trajectory = batch.run(batch.networks(), RUN_LENGTH, setpoint=setpoint, **plant)
        measured[f"settled, {name}"] = batch.by_setting(settled(trajectory))
    return measured


def with_failing_node(networks: DirectNNController, stuck_at: int) -> Act:
    """Return a function that acts like networks in which the first hidden node fails.

    The function must be called once for each sample of a run. From sample `FAILURE` on, the
    output of the failed node is always `stuck_at`, which is 0 or 1. All other nodes continue to
    learn.
    """
    samples = itertools.count()

    def act(observations: Any) -> Any:
        """Return the actions of the networks, after the failure if it is time for it."""
        if next(samples) == FAILURE:
            weights = networks.weights  # a copy
            weights.W[..., 0, :] = 0.0  # The node no longer depends on its inputs.
            # With a threshold of this size, the slope of the node's sigmoid function is 0, so
            # that the node cannot learn.
            weights.theta_1[..., 0] = 1e6 if stuck_at else -1e6
            networks.weights = weights
        return networks.act(observations)

    return act


def changed_plants(batch: Batch, setpoint: Arguments) -> Measured:
    """Measure networks that have learnt on the paper's plant, on plants that have changed."""
    networks = batch.networks()
    batch.run(networks, RUN_LENGTH, **setpoint)
    learnt_weights = networks.weights
    measured = {}
    for name, plant in CHANGED_PLANTS.items():
        for updates, (networks.learning, networks.update_interval) in UPDATES.items():
            networks.weights = learnt_weights
            error = mean_error(batch.run(networks, RUN_LENGTH, **setpoint, **plant))
            error -= reference(RUN_LENGTH, **setpoint, **plant)
            if not can_hold(batch.level, plant):
                error = np.full(batch.loops, np.nan)
            measured[f"error, {name}, {updates}"] = batch.by_setting(error)
    return measured


def day(batch: Batch, setpoint: Arguments) -> Measured:
    """Measure a day of continuous operation of networks and of PI (searched)."""
    measured = {}
    searched_pi = PIController(SEARCHED_GAINS["kp"], SEARCHED_GAINS["ki"])
    for name, plant in PLANTS.items():
        # A reference error from rest differs, as its first change of the set point is smaller
        # than all later ones.
        first = reference(WINDOW, **setpoint, **plant)
        later = 2 * reference(2 * WINDOW, **setpoint, **plant) - first
        for controller, agent in (("NN", batch.networks()), ("PI", searched_pi)):
            case = f"{name}, {controller}"
            windows = errors_by_window(agent, batch, DAY, **setpoint, **plant)
            if not can_hold(batch.level, plant):
                windows[:] = np.nan
            best = np.median(windows, axis=-1).argmin(axis=0)  # by setting
            measured[f"error, first, {case}"] = windows[0] - first
            measured[f"error, last, {case}"] = windows[-1] - later
            measured[f"mean error, last, {case}"] = windows[-1]
            measured[f"mean error, best, {case}"] = windows[best, np.arange(len(best))]
    return measured


def errors_by_window(agent: Any, batch: Batch, samples: int, **arguments: Any) -> Array:
    """Return mean errors of continuous operation, degC, shape (windows, settings, runs).

    `arguments` are arguments of the environment, and `samples` is the length of the operation,
    a multiple of `WINDOW`.
    """
    plants = make_plants(batch.loops, samples, **arguments)
    seeds = range(batch.seed, batch.seed + batch.loops)
    totals = np.zeros((samples // WINDOW, batch.loops))
    steps = rollout(plants, start(agent, batch.loops), samples, seeds)
    for k, sample in enumerate(itertools.islice(steps, 1, None)):  # without sample 0
        totals[k // WINDOW] += np.abs(sample.infos["error"])
    return batch.by_setting(totals / WINDOW)
