"""Whether a log moves enough to tell anything: it is asked before anything is fitted."""

from __future__ import annotations

import numpy as np
import pandas as pd

from benchmarks.identify.armax import Array
from benchmarks.identify.model import CannotTellError

LEAST_SAMPLES = 100  # beside those that the longest delay takes
FOLLOWS = 0.98  # share of the flow's moves that, explained by the temperature, is feedback


def check_excitation(command: Array, output: Array) -> None:
    """Refuse a log in which nothing moves, or nothing but the feedback."""
    flows, temperatures = command[np.isfinite(command)], output[np.isfinite(output)]
    if len(flows) < LEAST_SAMPLES:
        raise CannotTellError(
            f"the log is too short: {len(flows)} rows with a flow, and at least "
            f"{LEAST_SAMPLES} are needed"
        )
    if np.ptp(flows) == 0.0:
        raise CannotTellError(
            f"the flow is constant, {flows[0]:g} t/h from its operating point: nothing moves "
            "that the temperature could answer. Record it while the flow is moved in steps"
        )
    if not len(temperatures) or np.ptp(temperatures) == 0.0:
        raise CannotTellError(
            "the temperature is constant: it answers nothing. See whether the sensor works, or "
            "name another column"
        )
    share = _explained_by_feedback(pd.Series(command), pd.Series(output))
    if share > FOLLOWS:
        raise CannotTellError(
            f"the flow follows from the temperature alone ({100 * share:.1f} % of its moves): "
            "the loop is closed and nothing else moves, so that the plant cannot be told from "
            "its controller. Change the set point in steps, or move the flow by hand"
        )


def _explained_by_feedback(u: pd.Series[float], y: pd.Series[float]) -> float:
    """Return which share of the flow's moves, beyond its past, the temperature explains."""
    own = [u.shift(1), u.shift(2), u.notna()]
    table = np.column_stack([*own, y, y.shift(1), y.shift(2), u.diff()])
    # Where a limit holds the flow, it does not follow anything.
    table = table[np.isfinite(table).all(axis=1) & (u > u.min()) & (u < u.max())]
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
