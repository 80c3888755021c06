"""The statistics of exposures, and how those of one half are averaged."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import numpy as np

ABS_VARIANCE = 1 - 2 / np.pi  # of |x| of a standard normal x
TINY_DN2 = 1e-4  # far below the variance of rounding: keeps logarithms of empty variances finite
LARGEST_CORRELATION = 0.9999


def log_ratio(above: np.ndarray, below: np.ndarray | float) -> np.ndarray:
    """Log of a ratio of two variances, DN^2, or of two numbers of order one."""
    return np.log((np.asarray(above, np.float64) + TINY_DN2) / (np.asarray(below, np.float64) + TINY_DN2))


def fisher(correlation: np.ndarray) -> np.ndarray:
    """artanh of correlations: standard error 1/sqrt(n) whatever their size."""
    return np.arctanh(np.clip(correlation, -LARGEST_CORRELATION, LARGEST_CORRELATION))


def correlation(a: np.ndarray, b: np.ndarray, axes: tuple[int, ...]) -> np.ndarray:
    """artanh of the uncentred correlation of two arrays over `axes`; 0 where one of them is all zero."""
    power = (a * a).sum(axes) * (b * b).sum(axes)
    return fisher((a * b).sum(axes) / np.sqrt(np.maximum(power, 1e-60)))


def correlations(x: np.ndarray) -> np.ndarray:
    """artanh of the uncentred correlations of the planes of x [exposure, plane, ...]: [exposure, plane, plane]."""
    flat = x.reshape(*x.shape[:2], -1)
    product = flat @ flat.transpose(0, 2, 1)
    power = np.diagonal(product, axis1=1, axis2=2)
    return fisher(product / np.sqrt(np.maximum(power[:, :, None] * power[:, None], 1e-60)))


class Entry(NamedTuple):
    """A statistic with its standard error. of_map: whether it is of the shape of the static map, as light has one."""

    value: float
    error: float
    of_map: bool = False


@lru_cache
def planes_by_colour(letters: tuple[str, ...]) -> tuple[tuple[str, list[int]], ...]:
    """Of each colour, what follows the name of its statistics, and its planes."""
    return tuple(
        ("" if colour == "mono" else f", {colour}", [i for i, letter in enumerate(letters) if letter == colour])
        for colour in dict.fromkeys(letters)
    )


@dataclass(eq=False)
class Sheet:
    """The statistics of exposures with one number of frames. `letters` [plane] is the colour of each plane.

    exposures: their numbers. values, errors: [exposure], by (group, what); counts: which are numbers of rare pixels;
    maps: which are of the shape of the static map.
    """

    letters: tuple[str, ...]
    exposures: list[int]
    values: dict[tuple[str, str], np.ndarray] = field(default_factory=dict)
    errors: dict[tuple[str, str], np.ndarray] = field(default_factory=dict)
    counts: set[tuple[str, str]] = field(default_factory=set)
    maps: set[tuple[str, str]] = field(default_factory=set)

    def add(
        self, group: str, what: str, values: np.ndarray, error: np.ndarray | float, *, of_map: bool = False
    ) -> None:
        """The mean of values [exposure, ...] over all further axes; `error` is the standard error of that mean."""
        n = len(self.exposures)
        if values.ndim > 1:
            values = values.reshape(n, -1).sum(1) / (values.size // n)
        self.values[group, what] = values
        self.errors[group, what] = np.full(n, error)
        if of_map:
            self.maps.add((group, what))

    def add_count(self, group: str, what: str, numbers: np.ndarray, *, of_map: bool = False) -> None:
        self.add(group, what, numbers, 0.5, of_map=of_map)
        self.counts.add((group, what))

    def add_colours(self, group: str, what: str, values: np.ndarray, error: np.ndarray | float) -> None:
        """One statistic a colour from values [exposure, plane]; `error` is that of one plane."""
        for colour, planes in planes_by_colour(self.letters):
            self.add(group, f"{what}{colour}", values[:, planes], error / math.sqrt(len(planes)))


def gather(sheets: Sequence[Sheet], half: str, chosen: Sequence[int]) -> dict[tuple[str, str], Entry]:
    """The statistics of the `chosen` exposures: means, and square roots of summed numbers.

    An exposure of few frames has fewer statistics than others: the mean is over those that have one.
    """
    sheet_of = {number: sheet for sheet in sheets for number in sheet.exposures}
    some = dict.fromkeys(sheet_of[number] for number in chosen)
    place = {key: i for i, key in enumerate(dict.fromkeys(key for sheet in some for key in sheet.values))}
    number, total, square = np.zeros((3, len(place)))
    for sheet in some:
        where = [place[key] for key in sheet.values]
        of = [i for i, exposure in enumerate(sheet.exposures) if exposure in chosen]
        number[where] += len(of)
        total[where] += np.array(list(sheet.values.values()))[:, of].sum(1)
        square[where] += np.square(np.array(list(sheet.errors.values()))[:, of]).sum(1)
    mean, error = total / number, np.sqrt(square) / number
    for i in (place[key] for key in set().union(*(sheet.counts for sheet in some))):
        mean[i], error[i] = math.sqrt(total[i]), 0.5
    maps = set().union(*(sheet.maps for sheet in some))
    entries = map(Entry, mean.tolist(), error.tolist(), [key in maps for key in place])
    return {(group, f"{what}, {half}"): entry for (group, what), entry in zip(place, entries, strict=True)}
