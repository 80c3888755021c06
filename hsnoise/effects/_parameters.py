"""The physical parameters of an effect: how they are declared, and what is known about each."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from numbers import Real
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

MOST_LINES = 65536  # rows or columns of the largest sensors
LARGEST_UINT32 = float(np.nextafter(np.float32(2**32), np.float32(0)))  # largest that float32 can hold, too


@dataclasses.dataclass(frozen=True)
class ParameterSpec:
    """What an effect declares about one parameter: unit, inclusive bounds (None: unbounded), meaning, whether held.

    amplitude: whether it says how strong the effect is; absent: the value at which the effect vanishes.
    """

    unit: str
    low: float | None
    high: float | None
    per_channel: bool
    doc: str
    held: bool | Literal["at bounds"]
    amplitude: bool = False
    absent: float = 0.0

    def holds(self, value: float) -> bool:
        """Whether a fit leaves a parameter of this value where it is."""
        return value in (self.low, self.high) if self.held == "at bounds" else self.held

    def scaled(self, value: np.ndarray, factor: float) -> np.ndarray:
        """The value `factor` times as far from absent, as far as the bounds allow."""
        grown = value / factor if math.isinf(self.absent) else self.absent + (value - self.absent) * factor
        return np.clip(grown, -np.inf if self.low is None else self.low, np.inf if self.high is None else self.high)


@dataclasses.dataclass(frozen=True)
class Parameter:
    """One number of a model: name in tables, `<effect>.<parameter>[.<channel>]`, value and declaration."""

    name: str
    value: float
    spec: ParameterSpec


def is_whole(value: Any, low: int, high: int) -> bool:
    """Whether a setting is a whole number within these bounds; True and False are none."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and bool(low <= value <= high)


def check_white_level(name: str, value: Any) -> None:
    """Raise ValueError unless a largest count is None or a whole number that counts can hold."""
    is_number = isinstance(value, Real) and not isinstance(value, bool)
    if value is not None and not (is_number and 0 < value <= LARGEST_UINT32 and value == int(value)):
        raise ValueError(f"{name}: expected a positive whole number or None, got {value!r:.60}.")


def _holds_numbers(x: Any) -> bool:
    """Whether `x` is a number, an array or a list of them; text and truth values, which convert to some, are none."""
    if isinstance(x, list | tuple):
        return all(map(_holds_numbers, x))
    dtype = getattr(x, "dtype", None)
    return isinstance(x, Real) and not isinstance(x, bool) if dtype is None else np.dtype(dtype).kind in "iuf"


def _as_leaf(x):
    # An array keeps its own precision: a fit hands over float64 whatever the session uses.
    if eqx.is_inexact_array(x) and isinstance(x, jax.Array):
        return x
    if not _holds_numbers(x):
        return x
    try:
        return jnp.asarray(x, float)
    except (TypeError, ValueError, OverflowError):
        return x  # no number: `__check_init__`, which knows the parameter's name, says so


def param(
    unit: str,
    *,
    low: float | None = None,
    high: float | None = None,
    per_channel: bool = False,
    default: float | None = None,
    doc: str = "",
    held: bool | Literal["at bounds"] = False,
    amplitude: bool = False,
    absent: float = 0.0,
) -> Any:
    """Declare a physical parameter of an effect: a scalar, or one value per channel [channel].

    Args:
        unit: its unit, "1" if it has none.
        low, high: inclusive bounds; None for unbounded.
        per_channel: one value per colour channel; a scalar given instead holds for all channels.
        default: value unless one is given; None: one must be given.
        doc: its meaning in a few words.
        held: fits leave it at its value, because the statistics do not depend on it smoothly. "at bounds": only if it
            lies at one, such as a place at the edge of the frame.
        amplitude: whether it says how strong the effect is. With all its amplitudes at `absent` an effect does nothing;
            `diagnose` scales them, and `improve` keeps an effect only if one of them is far enough from there.
        absent: the value of an amplitude at which the effect vanishes: 0, 1 for a factor, or infinity, even if the
            parameter cannot take it.
    """
    spec = ParameterSpec(unit, low, high, per_channel, doc, held, amplitude, absent)
    metadata = {"parameter": spec}
    if default is None:
        return eqx.field(converter=_as_leaf, metadata=metadata)
    return eqx.field(converter=_as_leaf, metadata=metadata, default=default)


@dataclasses.dataclass(frozen=True)
class ArraySpec:
    """What an effect declares about a measured array: unit, names of its axes, inclusive lower bound, meaning.

    summary: the one number that stands for it in tables; summary_unit: its unit.
    """

    unit: str
    axes: tuple[str, ...]
    low: float | None
    doc: str
    summary: Callable[[np.ndarray], float]
    summary_unit: str

    def check(self, name: str, value: Any) -> None:
        """Raise TypeError, ValueError, naming the array, unless it has its axes and finite values in bounds."""
        expected = f"an array [{', '.join(self.axes)}]"
        if not isinstance(value, jax.Array):
            raise TypeError(f"{name}: expected {expected}, got {value!r}.")
        if value.ndim != len(self.axes) or value.size == 0:
            raise ValueError(f"{name}: expected {expected}, got shape {value.shape}.")
        low = -np.inf if self.low is None else self.low
        if not np.all(np.isfinite(value) & (np.asarray(value) >= low)):
            bound = "" if self.low is None else f" >= {self.low:g}"
            raise ValueError(f"{name}: expected finite numbers{bound}, got {np.min(value)} to {np.max(value)}.")


def measured(
    unit: str,
    axes: tuple[str, ...],
    *,
    summary: Callable[[np.ndarray], float],
    summary_unit: str,
    low: float | None = None,
    optional: bool = True,
    doc: str = "",
) -> Any:
    """Declare an array that is measured as a whole: a leaf of the effect that no fit moves, saved beside the JSON.

    Args:
        unit: of its values, "1" if they have none; low: inclusive lower bound.
        axes: names of its axes.
        summary: makes the one number that stands for it in tables, in summary_unit.
        optional: whether it may be None, the default then.
        doc: its meaning in a few words.
    """
    metadata = {"measured": ArraySpec(unit, axes, low, doc, summary, summary_unit)}
    if optional:
        return eqx.field(converter=lambda x: None if x is None else _as_leaf(x), metadata=metadata, default=None)
    return eqx.field(converter=_as_leaf, metadata=metadata)


def shortest(value: np.ndarray | np.floating) -> float:
    """The number of fewest digits that reads back as `value` in its precision: 0.1, not 0.10000000149."""
    return float(str(value))
