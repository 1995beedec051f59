"""Whether a log moves enough to tell anything: it is asked before anything is fitted."""

from __future__ import annotations

import numpy as np

from benchmarks.identify.armax import Array
from benchmarks.identify.model import CannotTellError

LEAST_SAMPLES = 100  # beside those that the longest delay takes
FOLLOWS = 0.98  # share of the flow's moves that, explained by the temperature, is feedback


def check_excitation(command: Array, output: Array) -> None:
    """Refuse a log in which nothing moves, or nothing but the feedback.

    Raises
    ------
    CannotTellError
        The message says what is missing.
    """
    known = command[np.isfinite(command)]
    if len(known) < LEAST_SAMPLES:
        raise CannotTellError(
            f"the log is too short: {len(known)} rows with a flow, and at least "
            f"{LEAST_SAMPLES} are needed"
        )
    if np.ptp(known) == 0.0:
        raise CannotTellError(
            f"the flow is constant, {known[0]:g} t/h from its operating point: nothing moves "
            "that the temperature could answer. Record it while the flow is moved in steps"
        )
    temperatures = output[np.isfinite(output)]
    if not len(temperatures) or np.ptp(temperatures) == 0.0:
        raise CannotTellError(
            "the temperature is constant: it answers nothing. See whether the sensor works, or "
            "name another column"
        )
    share = _explained_by_feedback(command, output)
    if share > FOLLOWS:
        raise CannotTellError(
            f"the flow follows from the temperature alone ({100 * share:.1f} % of its moves): "
            "the loop is closed and nothing else moves, so that the plant cannot be told from "
            "its controller. Change the set point in steps, or move the flow by hand"
        )


def _explained_by_feedback(command: Array, output: Array) -> float:
    """Return which share of the flow's moves the temperature explains, linearly.

    It is a share of what the flow's own past leaves open.
    """
    lags = 3
    index = np.arange(lags, len(command))
    moves = command[index] - command[index - 1]
    own = [command[index - i] for i in (1, 2)] + [np.ones(len(index))]
    temperatures = [output[index - i] for i in range(lags)]
    table = np.column_stack([*own, *temperatures, moves])
    # Where a limit holds the flow, it does not follow anything.
    free = np.isfinite(table).all(axis=1)
    free &= (command[index] > np.nanmin(command)) & (command[index] < np.nanmax(command))
    table = table[free]
    if len(table) < LEAST_SAMPLES:
        return 0.0

    def left(columns: int) -> float:
        fitted, *_ = np.linalg.lstsq(table[:, :columns], table[:, -1], rcond=None)
        errors = table[:, -1] - table[:, :columns] @ fitted
        return float(errors @ errors)

    alone, total = left(len(own)), float(table[:, -1] @ table[:, -1])
    if alone <= 1e-9 * total:  # it goes on as it has gone, whatever the temperature does
        return 0.0
    return 1.0 - left(table.shape[1] - 1) / alone
