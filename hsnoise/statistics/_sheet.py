"""The statistics of one exposure, and their averages over exposures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

ABS_VARIANCE = 1 - 2 / np.pi  # of |x| of a standard normal x
TINY_DN2 = 1e-4  # far below the variance of rounding; keeps the logarithm of a zero variance finite
LARGEST_CORRELATION = 0.9999


def log_ratio(above: np.ndarray, below: np.ndarray | float) -> np.ndarray:
    """Log of a ratio of two variances, DN^2, or of two numbers of order one."""
    return np.log((np.asarray(above, np.float64) + TINY_DN2) / (np.asarray(below, np.float64) + TINY_DN2))


def fisher(correlation: np.ndarray) -> np.ndarray:
    """artanh of correlations: its standard error is 1/sqrt(n) for any correlation."""
    return np.arctanh(np.clip(correlation, -LARGEST_CORRELATION, LARGEST_CORRELATION))


def correlation(a: np.ndarray, b: np.ndarray, axes: tuple[int, ...]) -> np.ndarray:
    """artanh of the uncentred correlation of two arrays over `axes`; 0 where one of them is all zero."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    power = (a * a).sum(axes) * (b * b).sum(axes)
    return fisher((a * b).sum(axes) / np.sqrt(np.maximum(power, 1e-60)))


@dataclass(frozen=True)
class Entry:
    """A statistic of one exposure: a value with its standard error, or a number of rare pixels.

    of_map: whether it describes the static map itself, which in flats shows the shape of the light.
    """

    value: float
    error: float
    is_count: bool = False
    of_map: bool = False


@dataclass
class Sheet:
    """The statistics of one exposure by (group, what). `letters` [plane] is the colour of each plane."""

    letters: tuple[str, ...]
    entries: dict[tuple[str, str], Entry] = field(default_factory=dict)

    def add(self, group: str, what: str, values: np.ndarray | float, error: float, *, of_map: bool = False) -> None:
        """The mean of `values` over all axes; `error` is the standard error of that mean."""
        values = np.asarray(values, np.float64)
        self.entries[group, what] = Entry(float(values.sum() / values.size), float(error), of_map=of_map)

    def add_count(self, group: str, what: str, number: float, *, of_map: bool = False) -> None:
        self.entries[group, what] = Entry(float(number), 0.5, is_count=True, of_map=of_map)

    def add_colours(self, group: str, what: str, values: np.ndarray, error: float) -> None:
        """One statistic per colour from values [plane]; `error` is that of one plane."""
        for colour in dict.fromkeys(self.letters):
            of = [i for i, letter in enumerate(self.letters) if letter == colour]
            name = what if colour == "mono" else f"{what}, {colour}"
            self.add(group, name, np.asarray(values)[of], error / np.sqrt(len(of)))


def gather(sheets: Sequence[Sheet], half: str) -> dict[tuple[str, str], Entry]:
    """The statistics of the exposures of one half: means, and square roots of summed numbers.

    Exposures with few frames lack some statistics: each mean is over the exposures that have it.
    """
    keys = dict.fromkeys(key for sheet in sheets for key in sheet.entries)
    out = {}
    for group, what in keys:
        found = [sheet.entries[group, what] for sheet in sheets if (group, what) in sheet.entries]
        total = sum(entry.value for entry in found)
        if found[0].is_count:
            value, error = math.sqrt(total), 0.5
        else:
            value, error = total / len(found), math.sqrt(sum(entry.error**2 for entry in found)) / len(found)
        out[group, f"{what}, {half}"] = Entry(value, error, of_map=found[0].of_map)
    return out
