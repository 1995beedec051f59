"""Check single values.

A check takes the name of an argument and its value. It returns the value in plain Python types,
or raises a ValueError that names the argument.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from numbers import Integral, Real
from typing import Any, Final, NoReturn

import numpy as np
from numpy.typing import NDArray

# Largest magnitude of an argument. Larger numbers would make float32 observations and squared
# errors meaningless.
LARGEST: Final[Any] = 10**9
# These limits are far above what any plant needs. Without them, a mistyped number could fill
# the memory.
LONGEST: Final = 10_000  # samples of a delay or of a window
MOST_COEFFICIENTS: Final = 1_000
MOST_PLANTS: Final = 10_000_000  # in one environment
SETPOINTS: Final = ("square", "random")
REWARDS: Final = ("quadratic", "absolute")
_COEFFICIENTS = f"a list of 1 to {MOST_COEFFICIENTS:,} numbers within +-1e9"
_FLOAT64 = np.dtype(np.float64)  # faster to pass than np.float64
_LONGEST_REPR = 80  # characters of a value in an error message
# The exceptions of arrays, tensors and Python for a value that is not a number.
_NOT_A_NUMBER = AttributeError, TypeError, ValueError, OverflowError, RuntimeError

Number = float | Sequence[float]  # a number, or a range [low, high]
Check = Callable[[str, Any], Any]  # takes the name of an argument and its value


def reject(name: str, value: object, allowed: str) -> NoReturn:
    """Raise a ValueError: the argument `name` must be `allowed`, but is `value`."""
    raise ValueError(f"{name} must be {allowed}, got {shorten(value)}") from None


def shorten(value: object) -> str:
    """Return the repr of a value; of a long repr, the beginning and the value's length."""
    text = repr(value)
    length = ""
    if isinstance(value, list | tuple):
        length = f" ({len(value)} elements)"
    if hasattr(value, "shape"):  # an array or a tensor, whose repr has several lines
        text = " ".join(text.split())
        length = f" (shape {tuple(value.shape)})"
    if len(text) <= _LONGEST_REPR:
        return text
    return f"{text[:_LONGEST_REPR]}...{length}"


def one_action(action: Any) -> float:
    """Return the action of one plant as a float; the action is a number or an array of one.

    Raises
    ------
    ValueError
        If the action is not one finite number.
    """
    try:
        array = action if hasattr(action, "item") else np.asarray(action)
        # The difference fails for text, which is not a number even if float() can parse it.
        checked = float(array.item() - 0.0)
    except _NOT_A_NUMBER:
        checked = math.nan
    if not math.isfinite(checked):
        reject("action", action, "one finite number, shape (1,)")
    return checked


def many_actions(
    actions: Any, num_envs: int, ignored: NDArray[np.bool_] | None
) -> NDArray[np.float64]:
    """Return the actions of many plants in a new array.

    Parameters
    ----------
    actions
        Numbers, shape (num_envs, 1).
    num_envs
        Number of plants.
    ignored
        Plants whose actions are ignored, shape (num_envs,): the results for these plants are 0,
        and their actions need not be finite. None if no action is ignored.

    Returns
    -------
    ndarray of float64
        The actions, shape (num_envs,).

    Raises
    ------
    ValueError
        If the actions have another shape, or if one is not a finite number.
    """
    columns = _as_float64(actions)
    if columns is None or columns.shape != (num_envs, 1):
        reject("actions", actions, f"numbers, shape ({num_envs}, 1)")
    checked = columns.ravel()
    if ignored is not None:
        checked[ignored] = 0.0
    # The sum of squares is finite if all actions are, unless an action is huge.
    if not math.isfinite(checked.dot(checked)) and not np.isfinite(checked).all():
        reject("actions", actions, "finite")
    return checked


def _as_float64(values: Any) -> NDArray[np.float64] | None:
    """Return values in a new float64 array, or None if a value is not a real number."""
    try:
        array = np.asarray(values)
        if array.dtype.hasobject:
            array = np.array((array - 0.0).tolist())
        # This cast fails for text, which is not a number even if NumPy can parse it.
        return array.astype(_FLOAT64, casting="same_kind")
    except _NOT_A_NUMBER:
        return None


def plain(value: Any) -> Any:
    """Return an array as a list, and a scalar of NumPy, also in a list, as a Python number."""
    if isinstance(value, list | tuple):
        return type(value)(map(plain, value))
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return value


def is_number(value: Any) -> bool:
    """Whether a value is a finite number within the bounds of all arguments."""
    if not isinstance(value, Real) or isinstance(value, bool):
        return False
    return bool(-LARGEST <= value <= LARGEST)


def is_count(value: Any, minimum: int = 0) -> bool:
    """Whether a value is an integer of at least `minimum`."""
    return isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= minimum


def number(name: str, value: Any, low: float = -LARGEST, allowed: str | None = None) -> float:
    """Return a number of at least `low` as a float, never -0."""
    if not is_number(value) or value < low:
        reject(name, value, allowed or f"a number from {low:g} to {LARGEST:g}")
    return float(value) + 0.0


not_negative = partial(number, low=0.0)
positive = partial(number, low=1e-9)
at_least_1 = partial(number, low=1.0)


def count(name: str, value: Any, minimum: int, maximum: int) -> int:
    """Return an integer from `minimum` to `maximum`."""
    if not is_count(value, minimum) or value > maximum:
        reject(name, value, f"an integer from {minimum} to {maximum:,}")
    return int(value)


samples = partial(count, minimum=0, maximum=LONGEST)  # of a delay or a window
duration = partial(count, minimum=1, maximum=LARGEST)  # in samples


def numbers(
    name: str, value: Any, allowed: str = _COEFFICIENTS, most: float = MOST_COEFFICIENTS
) -> tuple[float, ...]:
    """Return the numbers of a list of 1 to `most` elements; `allowed` is for the message."""
    if not isinstance(value, list | tuple) or not 0 < len(value) <= most:
        reject(name, value, allowed)
    for i, element in enumerate(value):
        if not is_number(element):
            raise ValueError(
                f"{name} must be {allowed}, got {shorten(value)}, where element {i} is "
                f"{shorten(element)}"
            )
    return tuple(map(float, value))


def polynomial(name: str, value: Any) -> tuple[float, ...]:
    """Return the coefficients of a polynomial, the first of which must be 1."""
    allowed = f"{_COEFFICIENTS}, the first of them 1"
    checked = numbers(name, value, allowed)
    if checked[0] != 1.0:
        reject(name, value, allowed)
    return checked


def one_of(name: str, value: Any, choices: Sequence[str | None]) -> Any:
    """Return a value that is one of the choices, which are texts or None."""
    if not isinstance(value, str | None) or value not in choices:
        reject(name, value, " or ".join(map(repr, choices)))
    return value


reward = partial(one_of, choices=REWARDS)


def setpoint(name: str, value: Any) -> str | float | tuple[float, ...]:
    """Return a set point: one of `SETPOINTS`, a constant, or a number for each sample, degC."""
    allowed = "'square', 'random', or a number or a list of one or more within +-1e9"
    if isinstance(value, list | tuple):
        return numbers(name, value, allowed, math.inf)
    if isinstance(value, str) and value in SETPOINTS:
        return value
    return number(name, value, allowed=allowed)


def or_range(check: Callable[[str, Any], float], name: str, value: Any) -> Number:
    """Return a number that passes `check`, or a range (low, high) of such numbers."""
    if not isinstance(value, list | tuple):
        return check(name, value)
    ends = [check(name, end) for end in value]
    if len(ends) != 2 or ends[0] > ends[1]:
        reject(name, value, "one number, or a range [low, high] with low <= high")
    return ends[0], ends[1]
