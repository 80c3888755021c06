"""Arguments checked one by one; errors say what was expected and what was given."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from hsnoise._core.naming import named
from hsnoise._core.types import Window

MOST_SEED = 2**31  # single draws count their seeds up from it


def span(name: str, value: Any, size: int) -> slice:
    """A (start, stop) pair, a slice or None (all) as a slice within 0..size.

    Raises:
        ValueError: it is empty, reaches outside 0..size, or has a step.
    """
    ends = (None, None) if value is None else value
    if isinstance(ends, slice):
        ends = (ends.start, ends.stop) if ends.step in (None, 1) else ()
    ends = listed(name, ends, "(start, stop)")
    if len(ends) == 2:
        start, stop = (
            whole_number(name, default if end is None else end) for end, default in zip(ends, (0, size), strict=True)
        )
        if 0 <= start < stop <= size:
            return slice(start, stop)
    raise ValueError(f"{named(name)}: expected (start, stop) with 0 <= start < stop <= {size}, got {value}")


def seed_of(name: str, value: Any) -> int:
    """A seed of random draws. Raises TypeError unless it is a whole number, ValueError outside 0 to MOST_SEED."""
    seed = whole_number(name, value, 0)
    if seed > MOST_SEED:
        raise ValueError(f"{named(name)}: expected at most {MOST_SEED}, got {value}")
    return seed


def whole_number(name: str, value: Any, least: int | None = None) -> int:
    """`value` as an int. Raises TypeError unless it is a whole number, ValueError below `least`."""
    try:
        number = operator.index(value)
    except TypeError:
        number = None
    if number is None or isinstance(value, bool):
        raise TypeError(f"{named(name)}: expected a whole number, got {value!r}")
    if least is not None and number < least:
        raise ValueError(f"{named(name)}: expected at least {least}, got {value}")
    return number


def listed(name: str, value: Any, expected: str) -> tuple[Any, ...]:
    """`value` as a tuple. Raises TypeError unless it is a list."""
    if isinstance(value, str) or not isinstance(value, Iterable):
        raise TypeError(f"{named(name)}: expected {expected}, got {value!r}")
    return tuple(value)


def callback(name: str, function: Any) -> Callable[..., Any]:
    """A user's function; for None, one that does nothing. Raises TypeError unless it can be called."""
    if function is not None and not callable(function):
        raise TypeError(f"{named(name)}: expected a function or None, got {function!r}")
    return function or (lambda *told: None)


def window_of(window: Any, shape: tuple[int, ...]) -> Window | None:
    """Four numbers: where frames of `shape` lie on a sensor. Raises ValueError if they lie outside."""
    if window is None:
        return None
    numbers = tuple(whole_number("window", n) for n in listed("window", window, "four whole numbers"))
    if len(numbers) != 4 or min(numbers) < 0 or any(numbers[i] + shape[i] > numbers[i + 2] for i in (0, 1)):
        raise ValueError(
            f"window: expected (first row, first column, rows, columns) of a sensor that holds {shape[0]} x {shape[1]}"
            f" frames, got {window}"
        )
    return numbers[0], numbers[1], numbers[2], numbers[3]


def one_of(name: str, value: Any, allowed: Sequence[Any]) -> Any:
    """The value, if it is among `allowed`; else raises ValueError."""
    if not isinstance(value, type(allowed[0])) or value not in allowed:
        raise ValueError(f"{named(name)}: expected one of {', '.join(map(repr, allowed))}, got {value!r}")
    return value


def numbers(name: str, value: Any, length: int, per: str) -> np.ndarray:
    """Numbers as float64 `[length]`; a scalar is accepted for length 1."""
    try:
        array = np.atleast_1d(np.array(value, np.float64))
    except (TypeError, ValueError, OverflowError) as error:
        raise TypeError(f"{named(name)}: expected numbers, got {value!r:.60}") from error
    if array.shape != (length,):
        raise ValueError(f"{named(name)}: expected {length} (one for each {per}), got shape {array.shape}: {value!r}")
    array.setflags(write=False)
    return array


def not_negative(name: str, values: np.ndarray) -> np.ndarray:
    """The values, if all are finite and none is negative."""
    if not np.isfinite(values).all() or (values < 0).any():
        raise ValueError(f"{named(name)}: expected finite numbers >= 0, got {values.tolist()}")
    return values


def positive(name: str, value: Any) -> float:
    """One finite number > 0 as a float."""
    number = float(not_negative(name, numbers(name, value, 1, "stack"))[0])
    if number == 0:
        raise ValueError(f"{named(name)}: expected a number > 0, got {value!r}")
    return number
