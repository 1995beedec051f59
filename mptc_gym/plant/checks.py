"""Check single values of arguments and actions.

A check is a function of an argument's name and value. The check returns the value in plain
Python types, or raises a ValueError that names the argument.
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
LONGEST: Final = 10_000  # samples of a delay or of a window of the observation
MOST_COEFFICIENTS: Final = 1_000  # of one polynomial of the plant
MOST_PLANTS: Final = 10_000_000  # in one environment, or in one evaluation
SETPOINTS: Final = ("square", "random")
REWARDS: Final = ("quadratic", "absolute")
_COEFFICIENTS = f"a list of 1 to {MOST_COEFFICIENTS:,} numbers within +-1e9"
_FLOAT64 = np.dtype(np.float64)  # NumPy takes a dtype faster than the type np.float64
_LONGEST_REPR = 80  # characters of a value in an error message, to keep the message readable
# The exceptions that NumPy, PyTorch and Python raise for a value that is not a number.
_NOT_A_NUMBER = AttributeError, TypeError, ValueError, OverflowError, RuntimeError

Number = float | Sequence[float]  # a number, or a range [low, high]
Check = Callable[[str, Any], Any]  # takes the name of an argument and its value


def reject(name: str, value: object, allowed: str) -> NoReturn:
    """Raise a ValueError that says that an argument's value is not allowed.

    Parameters
    ----------
    name
        Name of the argument.
    value
        The value that is not allowed; the message shows at most 80 characters of the value.
    allowed
        What is allowed, as in "a number above 0", to follow "must be".
    """
    raise ValueError(f"{name} must be {allowed}, got {shorten(value)}") from None


def shorten(value: object) -> str:
    """Return the repr of a value for a message, or of a long repr the first 80 characters.

    The number of elements of a long list, and the shape of a long array, follow the shortened
    repr.
    """
    text = repr(value)
    length = ""
    if isinstance(value, list | tuple):
        length = f" ({len(value)} elements)"
    if hasattr(value, "shape"):  # the repr of an array or of a tensor has several lines
        text = " ".join(text.split())
        length = f" (shape {tuple(value.shape)})"
    if len(text) <= _LONGEST_REPR:
        return text
    return f"{text[:_LONGEST_REPR]}...{length}"


def one_action(action: Any) -> float:
    """Return the action of one plant as a float.

    Parameters
    ----------
    action
        A number, or an array or a tensor with one element.

    Raises
    ------
    ValueError
        If the action is not one finite number.
    """
    try:
        array = action if hasattr(action, "item") else np.asarray(action)
        # Subtracting 0.0 fails for text: text is not a number, even if float() can parse it.
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
        One number for each plant, shape (num_envs, 1), in an array, a list or a tensor.
    num_envs
        Number of plants.
    ignored
        True for each plant whose action is ignored, shape (num_envs,): the result for such a
        plant is 0, and the action need not be finite. None if no action is ignored.

    Returns
    -------
    ndarray of float64
        The actions, shape (num_envs,).

    Raises
    ------
    ValueError
        If the actions have another shape, or if an action that counts is not a finite number.
    """
    columns = _as_float64(actions)
    if columns is None or columns.shape != (num_envs, 1):
        reject("actions", actions, f"numbers, shape ({num_envs}, 1)")
    checked = columns.ravel()
    if ignored is not None:
        checked[ignored] = 0.0
    # The sum of squares, which is fast, is finite if all actions are finite and none is huge.
    if not math.isfinite(checked.dot(checked)) and not np.isfinite(checked).all():
        reject("actions", actions, "finite")
    return checked


def _as_float64(values: Any) -> NDArray[np.float64] | None:
    """Return an array, list or tensor in a new float64 array; None if not all are numbers."""
    try:
        array = np.asarray(values)
        if array.dtype.hasobject:
            array = np.array((array - 0.0).tolist())
        # This cast fails for text: text is not a number, even if NumPy can parse the text.
        return array.astype(_FLOAT64, casting="same_kind")
    except _NOT_A_NUMBER:
        return None


def plain(value: Any) -> Any:
    """Return a value with lists for arrays and Python numbers for NumPy's, also in lists."""
    if isinstance(value, list | tuple):
        return type(value)(map(plain, value))
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return value


def is_number(value: Any) -> bool:
    """Whether a value is a real number, but no bool, of magnitude `LARGEST` (1e9) at most."""
    if not isinstance(value, Real) or isinstance(value, bool):
        return False
    return bool(-LARGEST <= value <= LARGEST)


def is_count(value: Any, minimum: int = 0) -> bool:
    """Whether a value is an integer, but no bool, of at least `minimum`."""
    return isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= minimum


def number(name: str, value: Any, low: float = -LARGEST, allowed: str | None = None) -> float:
    """Return the value of an argument as a float, 0.0 for -0.0; ValueError if not allowed.

    Parameters
    ----------
    name
        Name of the argument, for the message.
    value
        A value that must be a number from `low` to `LARGEST` (1e9).
    low
        Smallest number that is allowed.
    allowed
        What the message says is allowed; None for "a number from `low` to 1e9".
    """
    if not is_number(value) or value < low:
        reject(name, value, allowed or f"a number from {low:g} to {LARGEST:g}")
    return float(value) + 0.0


not_negative = partial(number, low=0.0)
positive = partial(number, low=1e-9)  # not 0.0, as `number` allows the value `low` itself
at_least_1 = partial(number, low=1.0)


def count(name: str, value: Any, minimum: int, maximum: int) -> int:
    """Return the value of an argument as an int; ValueError unless in the allowed range.

    Parameters
    ----------
    name
        Name of the argument, for the message.
    value
        A value that must be an integer, but no bool.
    minimum, maximum
        The allowed range, both ends included.
    """
    if not is_count(value, minimum) or value > maximum:
        reject(name, value, f"an integer from {minimum} to {maximum:,}")
    return int(value)


samples = partial(count, minimum=0, maximum=LONGEST)  # a delay or the size of a window
duration = partial(count, minimum=1, maximum=LARGEST)  # a duration in samples


def numbers(
    name: str, value: Any, allowed: str = _COEFFICIENTS, most: float = MOST_COEFFICIENTS
) -> tuple[float, ...]:
    """Return a list of numbers, the value of an argument, as a tuple of floats.

    Parameters
    ----------
    name
        Name of the argument, for the message.
    value
        A value that must be a list or a tuple of 1 to `most` numbers within +-1e9.
    allowed
        What the message says is allowed.
    most
        Largest number of elements that is allowed.

    Raises
    ------
    ValueError
        If the value is not such a list.
    """
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
    """Return the coefficients of a polynomial as floats; ValueError unless the first is 1.

    `name` is the argument's name, for the message, and `value` the list of coefficients.
    """
    allowed = f"{_COEFFICIENTS}, the first of them 1"
    checked = numbers(name, value, allowed)
    if checked[0] != 1.0:
        reject(name, value, allowed)
    return checked


def one_of(name: str, value: Any, choices: Sequence[str | None]) -> Any:
    """Return the value of an argument if `choices` contains the value; otherwise ValueError.

    `name` is the argument's name, for the message. The choices are texts or None.
    """
    if not isinstance(value, str | None) or value not in choices:
        reject(name, value, " or ".join(map(repr, choices)))
    return value


reward = partial(one_of, choices=REWARDS)


def setpoint(name: str, value: Any) -> str | float | tuple[float, ...]:
    """Return the set point argument: one of `SETPOINTS`, a float, or a tuple of floats, degC.

    A float is a constant set point, and a tuple holds a set point for each sample. For any
    other value, a ValueError that names the argument `name` is raised.
    """
    allowed = "'square', 'random', or a number or a list of one or more within +-1e9"
    if isinstance(value, list | tuple):
        return numbers(name, value, allowed, math.inf)
    if isinstance(value, str) and value in SETPOINTS:
        return value
    return number(name, value, allowed=allowed)


def or_range(check: Callable[[str, Any], float], name: str, value: Any) -> Number:
    """Return a number that passes `check`, or a range (low, high) of two such numbers.

    Parameters
    ----------
    check
        Check of a single number.
    name
        Name of the argument, for the message of a ValueError.
    value
        A number, or a list or tuple of two numbers: the ends of the range.
    """
    if not isinstance(value, list | tuple):
        return check(name, value)
    ends = [check(name, end) for end in value]
    if len(ends) != 2 or ends[0] > ends[1]:
        reject(name, value, "one number, or a range [low, high] with low <= high")
    return ends[0], ends[1]
