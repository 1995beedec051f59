"""Run a controller in one case, or compute the reference error of the case.

A scenario is a plant, a set point and a length of the runs. The error of a run is the mean of
|e|, the absolute error, over the samples of the run. The functions of this module run in worker
processes, which need no pandas, as pandas takes long to import.
"""

import itertools
import operator
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.bounds.reference import Reference, reference_error
from benchmarks.controllers.roster import ControllerSpec
from benchmarks.lib.command import CommandError
from benchmarks.lib.statistics import percentiles
from benchmarks.loop.linear import LinearController, LinearLoop, nominal
from benchmarks.loop.measures import measure
from benchmarks.loop.runs import Trajectory, is_random, simulate_together
from benchmarks.loop.scenarios import Scenario

Columns = dict[str, Any]  # the columns of a table by name: arrays, or one value for all rows


@dataclass(frozen=True)
class Result:
    """The results of one controller in one scenario.

    The members of a controller are its training runs, and each member has its own runs. A
    controller that is not trained has one member.

    Attributes
    ----------
    scenario : str
        Name of the scenario.
    agent : str
        Name of the controller in options, such as "mpc".
    runs : sequence of dict
        A table for each member with a row for each run, and the columns `scenario`, `agent`,
        `policy` (the number of the member), `seed`, and the measures that
        `benchmarks.loop.measures.measure` returns.
    responses : dict
        Table of temperature and flow with a row for each sample, from `responses_over_time`.
    sensitivity : float, optional
        Maximum sensitivity Ms of the loop with the nominal plant, infinite for an unstable
        loop; None if the controller is not linear.
    seconds : float
        Processor time of making and running the controller, s.
    """

    scenario: str
    agent: str
    runs: Sequence[Columns]
    responses: Columns
    sensitivity: float | None
    seconds: float


def run_case(scenario: Scenario, controller: ControllerSpec, runs: int, seed: int) -> Result:
    """Run all members of a controller in a scenario, and return the results.

    If neither the scenario nor the controller uses random numbers, each member runs only once,
    and the results have a copy of this run for each seed.

    `runs` is the number of runs of each member, and run i has the seed `seed + i`.
    """
    start = time.process_time()
    runs_are_equal = not (controller.random or is_random(scenario.parameters))
    simulated_runs = 1 if runs_are_equal else runs
    members = [  # pairs of a controller and the arguments of its environment
        member.start(scenario.arguments, simulated_runs, seed)
        for member in controller.members()
    ]
    trajectories = []
    # Members act in one batch of plants, which saves time. Only the members of a user's
    # controller may need different arguments of the environment, and so several batches.
    for arguments, neighbours in itertools.groupby(members, key=operator.itemgetter(1)):
        agents = [agent for agent, _ in neighbours]
        trajectories += simulate_together(
            agents, simulated_runs, scenario.samples, seed, **arguments
        )
    tables = []
    for number, trajectory in enumerate(trajectories):
        columns: Columns = {
            "scenario": scenario.name,
            "agent": controller.name,
            "policy": number,
            "seed": range(seed, seed + runs),
        }
        for name, values in measure(trajectory, scenario.parameters).items():
            columns[name] = np.broadcast_to(values, runs)  # The values may be of a single run.
        tables.append(columns)
    first_agent, _ = members[0]  # Ms is that of the first member.
    sensitivity = None
    if isinstance(first_agent, LinearController):
        loop = LinearLoop.of(first_agent, nominal(scenario.parameters))
        sensitivity = loop.sensitivity()
    return Result(
        scenario=scenario.name,
        agent=controller.name,
        runs=tables,
        responses=responses_over_time(trajectories, scenario, controller.name),
        sensitivity=sensitivity,
        seconds=time.process_time() - start,
    )


def responses_over_time(
    trajectories: Sequence[Trajectory], scenario: Scenario, agent: str
) -> Columns:
    """Return a table of a controller's temperature and flow over time, one row for each sample.

    The columns are `agent`, `time_s` (s) and `setpoint` (degC); `output_run` (degC) and
    `applied_run` (t/h), the temperature and the applied flow of the first run; and `output_p10`
    and `output_p90` (degC), the percentiles of the temperature over all runs of all members. If
    the set points are random, the runs have different set points, and the percentiles are the
    values of the first run.
    """
    first = trajectories[0]  # of the first member; its first run is in column 0
    outputs = np.hstack([trajectory.output for trajectory in trajectories])
    if scenario.parameters.setpoint == "random":
        outputs = outputs[:, :1]
    band = percentiles(outputs)
    return {
        "agent": agent,
        "time_s": np.arange(len(outputs)) * scenario.parameters.sampling_interval,
        "setpoint": first.setpoint[:, 0],
        "output_run": first.output[:, 0],
        "output_p10": band["p10"],
        "output_p90": band["p90"],
        "applied_run": first.applied[:, 0],
    }


def reference_of(scenario: Scenario, runs: int, seed: int) -> Reference:
    """Return the reference error in a scenario, a mean over the episodes of the runs.

    Episode i of the `runs` episodes has the seed `seed + i`, as in `run_case`.

    Raises
    ------
    CommandError
        If the error of an idle valve in `scenario` is not above the reference error.
    """
    reference = reference_error(
        samples=scenario.samples, episodes=runs, seed=seed, **scenario.arguments
    )
    # Without scores, a case cannot be reported. So the method is called here, where a
    # refusal ends only the task of this case.
    try:
        reference.score(0.0)
    except ValueError as error:
        raise CommandError(str(error)) from error
    return reference
