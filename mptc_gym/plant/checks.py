"""Check single values of arguments and actions.

A check is a function that takes the name and the value of an argument. A check returns the
value in Python's own types, or raises a ValueError that names the argument.
"""

import math
from collections.abc import Callable, Sequence
from enum import Enum
from functools import partial
from numbers import Integral, Real
from typing import Any, Final, NoReturn

import numpy as np
from numpy.typing import NDArray

# Largest magnitude of an argument. Larger numbers would make float32 observations and squared
# errors meaningless.
LARGEST_NUMBER: Final[Any] = 10**9
SETPOINTS: Final = ("square", "random")
REWARDS: Final = ("quadratic", "absolute")
ACTIONS: Final = ("flow", "change")
_FLOAT64 = np.dtype(np.float64)  # NumPy takes a dtype faster than the type np.float64
# The exceptions that NumPy, PyTorch and Python raise for a value that is not a number.
NOT_A_NUMBER = AttributeError, TypeError, ValueError, OverflowError, RuntimeError

Number = float | Sequence[float]  # a number, or a range [low, high]
Check = Callable[[str, Any], Any]  # takes the name of an argument and its value


def reject(name: str, value: object, allowed: str, reason: str = "") -> NoReturn:
    """Raise a ValueError with the message "`name` must be `allowed`, got `value``reason`"."""
    raise ValueError(f"{name} must be {allowed}, got {shorten(value)}{reason}") from None


def shorten(value: object) -> str:
    """Return the repr of a value for an error message, cut to the first 80 characters.

    To the cut text of an array or a tensor, the shape is added.
    """
    text = " ".join(repr(value).split())  # the repr of an array has several lines
    if len(text) > 80:
        text = f"{text[:80]}..."
        if hasattr(value, "shape"):
            text += f" (shape {tuple(value.shape)})"
    return text


def one_action(action: Any) -> float:
    """Return the checked action of one plant as a float.

    Parameters
    ----------
    action
        Normalised action: a number, or an array, a list or a tensor with one element.

    Raises
    ------
    ValueError
        If the action is not one finite number.
    """
    array = _as_float64(action)
    if array is None or array.size != 1 or not math.isfinite(array.item()):
        reject("action", action, "one finite number, shape (1,)", _why_unreadable(action))
    return array.item()


def many_actions(
    actions: Any, num_envs: int, ignored: NDArray[np.bool_] | None
) -> NDArray[np.float64]:
    """Return the checked actions of many plants in a new array, shape (num_envs,).

    Parameters
    ----------
    actions
        Normalised actions of the plants, shape (num_envs, 1), in an array, a list or a tensor.
    num_envs
        Number of plants.
    ignored
        Mask of the plants whose actions are ignored and become 0, shape (num_envs,), or None
        for no plant. An ignored action may be infinite or NaN.

    Raises
    ------
    ValueError
        If the shape of `actions` is not (num_envs, 1), or if an action is not a finite number.
    """
    array = _as_float64(actions)
    if array is None or array.shape != (num_envs, 1):
        allowed = f"numbers, shape ({num_envs}, 1)"
        reject("actions", actions, allowed, _why_unreadable(actions))
    checked = array.ravel()
    if ignored is not None:
        checked[ignored] = 0.0
    # The sum of squares, which is fast, is finite if all actions are finite and none is huge.
    if not math.isfinite(checked.dot(checked)) and not np.isfinite(checked).all():
        reject("actions", actions, "finite")
    return checked


def _as_float64(values: Any) -> NDArray[np.float64] | None:
    """Return `values` as a new float64 array, or None if an element is not a number."""
    try:
        # This cast fails for text, complex numbers and Python objects.
        return np.asarray(values).astype(_FLOAT64, casting="same_kind")
    except NOT_A_NUMBER:
        return None


def _why_unreadable(values: Any) -> str:
    """Return why NumPy cannot read a tensor, as the end of an error message; "" if it can.

    Such a tensor has a gradient, has a type that NumPy lacks, such as bfloat16, or is not in
    the memory of the CPU. Other values than tensors are shown by the message.
    """
    if hasattr(values, "detach"):  # a tensor
        try:
            np.asarray(values)
        except NOT_A_NUMBER as error:
            reason = str(error).rstrip(".")
            return f": {reason}; pass tensor.detach().float().cpu()"
    return ""


def to_python(value: Any) -> Any:
    """Return `value` with NumPy arrays and numbers converted to lists and Python numbers.

    The conversion includes NumPy values inside a list or tuple, and members of an `Enum`.
    """
    if isinstance(value, list | tuple):
        return type(value)(map(to_python, value))
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Enum):
        return value.value
    return value


def is_count(value: Any, minimum: int = 0) -> bool:
    """Return whether a value is an integer of at least `minimum`, and not a bool."""
    return isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= minimum


def number(
    name: str, value: Any, low: float = -LARGEST_NUMBER, high: float = LARGEST_NUMBER
) -> float:
    """Return a number as a float; ValueError unless it is real and from `low` to `high`."""
    is_real = isinstance(value, Real) and not isinstance(value, bool)
    if not is_real or not low <= value <= high:
        reject(name, value, f"a number from {low:g} to {high:g}")
    return float(value) + 0.0  # which turns -0.0 into 0.0


not_negative = partial(number, low=0.0)
positive = partial(number, low=1e-9)  # not 0.0, as `number` allows the value `low` itself


def nonzero(name: str, value: Any) -> float:
    """Return a number other than 0 as a float; ValueError for 0 and for what is no number."""
    if value == 0.0:
        reject(name, value, "a number other than 0")
    return number(name, value)


at_least_1 = partial(number, low=1.0)
share_of_range = partial(number, low=1e-9, high=2.0)  # in halves of the range


def count(name: str, value: Any, minimum: int, maximum: int = LARGEST_NUMBER) -> int:
    """Return an integer as an int; ValueError unless it is from `minimum` to `maximum`."""
    if not is_count(value, minimum) or value > maximum:
        reject(name, value, f"an integer from {minimum} to {maximum:,}")
    return int(value)


count_from_0 = partial(count, minimum=0)
count_from_1 = partial(count, minimum=1)
seed = partial(count, minimum=0, maximum=(1 << 63) - 1)  # as large as PyTorch takes


def number_list(name: str, value: Any) -> tuple[float, ...]:
    """Return a list or tuple of one or more numbers as floats; ValueError for others."""
    if not isinstance(value, list | tuple) or not value:
        reject(name, value, "a list of one or more numbers")
    return tuple(number(f"{name}[{i}]", element) for i, element in enumerate(value))


def polynomial(name: str, value: Any) -> tuple[float, ...]:
    """Return a polynomial's coefficients as floats; ValueError unless the first one is 1."""
    coefficients = number_list(name, value)
    if coefficients[0] != 1.0:
        reject(name, value, "a list of numbers, the first of them 1")
    return coefficients


def one_of(name: str, value: Any, choices: Sequence[str | None]) -> Any:
    """Return the value of an argument; ValueError unless `value` is one of `choices`."""
    if not isinstance(value, str | None) or value not in choices:
        reject(name, value, " or ".join(map(repr, choices)))
    return value


reward = partial(one_of, choices=REWARDS)
action = partial(one_of, choices=ACTIONS)


def setpoint(name: str, value: Any) -> str | float | tuple[float, ...]:
    """Return the set point: "square", "random", a float, or a tuple of floats.

    A float is a constant set point, in degC. A tuple holds a set point for each sample, in
    degC. A ValueError is raised if `value` is not a valid set point.
    """
    if isinstance(value, str):
        return str(one_of(name, value, SETPOINTS))
    if isinstance(value, list | tuple):
        return number_list(name, value)
    return number(name, value)


def number_or_range(check: Callable[[str, Any], float], name: str, value: Any) -> Number:
    """Return the value of an argument: one number, or a range (low, high) of two numbers.

    `check` is a function that checks an argument that is one number. A ValueError is raised if
    `value` is neither a number that passes `check`, nor a list or tuple of two such numbers,
    the lower number first.
    """
    if not isinstance(value, list | tuple):
        return check(name, value)
    ends = [check(name, end) for end in value]
    if len(ends) != 2 or ends[0] > ends[1]:
        reject(name, value, "one number, or a range [low, high] with low <= high")
    return ends[0], ends[1]
