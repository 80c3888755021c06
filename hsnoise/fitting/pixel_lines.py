"""Static levels of whole rows and columns: those of the many, those that lie far off, and what neighbours share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter

from hsnoise._core.coloured import EXPONENTS, exponent_of, fading_power
from hsnoise._core.robust import robust_sigma
from hsnoise.fitting.pixel_rows import LEAST_ERROR, widened
from hsnoise.statistics.pixels.shading import FAR, Shading
from hsnoise.statistics.pixels.survey import Plane

FEWEST_LINES = 32  # for a difference of even and odd ones
FEW = 0.05  # share of lines with a defect; of more, levels have two or three values, as bands leave them
EFFICIENCY = 2 / 3  # of differences of neighbours, which overlap
PARITY_THERE = 4.0  # errors of a difference of even and odd lines
AROUND, WHOLE = 9, 0.5  # lines with which one is compared; share of its level that its median pixel must show
ALIKE, BEYOND_CHANCE = 0.5, 5.0  # share of the variance, and its errors, that neighbours have in common


class Lines(NamedTuple):
    """Static levels of the lines of one axis, beside a drift.

    Attributes:
        variance_dn2, error_dn2: of the lines that do not lie far off, noise of estimation taken off, and its error.
        next_dn2: half the mean square by which a line differs from the next, the same noise taken off: all of the
            variance if each line has a level of its own, little of it if they follow a curve.
        follow: whether they follow a curve beyond chance.
        exponent: of the spectrum over the lines, by how neighbours resemble each other; 0 and an infinite error if they
            do not, or more than any exponent makes them.
        far, farthest_dn: how many lie far off, and by how much at most, DN.
        parity_dn: odd lines of the sensor less even ones, and its error, if mono frames show it beyond chance; it is in
            none of the above.
    """

    variance_dn2: float
    error_dn2: float
    next_dn2: float
    follow: bool
    exponent: tuple[float, float]
    far: int
    farthest_dn: float
    parity_dn: tuple[float, float] | None = None


def lines_of(
    planes: Sequence[Plane], axis: str, shading: Mapping[str, Shading], frames: int, step: int, first: int = 0
) -> Lines:
    """The static lines of an axis ("row" or "column") in the planes of one channel, means over so many frames.

    step: lines of the sensor from one of a plane to the next; first: number of the first one on the sensor.
    """
    rest = [_rest(getattr(plane, f"{axis}_mean_dn"), shading.get(axis)) for plane in planes]
    parity = _parity(rest[0], first) if step == 1 else None
    if parity is not None:
        rest = [rest[0] - parity[0] * _odd(rest[0], first)]
    near = [_near(of) for of in rest]
    noise = float(np.mean([_noise_dn2(plane, axis, frames) for plane in planes]))
    variance = float(np.mean([of[there].var(ddof=1) for of, there in zip(rest, near, strict=True)]))
    steps = [np.diff(of)[there[1:] & there[:-1]] for of, there in zip(rest, near, strict=True)]
    beside = float(np.mean([0.5 * np.mean(of**2) for of in steps]))
    lines = sum(map(len, rest))
    error, of_beside = variance * np.sqrt(2 / lines), beside * np.sqrt(2 / (EFFICIENCY * lines))
    shared = variance - beside
    follow = shared > max(ALIKE * (variance - noise), BEYOND_CHANCE * float(np.hypot(error, of_beside)))
    sigma, exponent = float(np.hypot(error, of_beside)), (0.0, np.inf)
    if shared > BEYOND_CHANCE * sigma and variance > noise:
        exponent = _exponent(shared / (variance - noise), sigma / (variance - noise), step * len(rest[0]), step)
        error *= widened(np.array(fading_power(step * len(rest[0]), np.float32(exponent[0])), float))
    off = [(plane, of, ~there) for plane, of, there in zip(planes, rest, near, strict=True) if not there.all()]
    far = [np.abs(of[away & _is_whole(plane, axis, of)]) for plane, of, away in off]
    farthest = max((float(of.max()) for of in far if len(of)), default=0.0)
    several = sum(map(len, far)), farthest
    return Lines(variance - noise, float(error), beside - noise, bool(follow), exponent, *several, parity)


def _odd(rest_dn: np.ndarray, first: int) -> np.ndarray:
    return (np.arange(len(rest_dn)) + first) % 2 - 0.5


def _parity(rest_dn: np.ndarray, first: int) -> tuple[float, float] | None:
    """Odd lines less even ones and its error, DN, if it is beyond chance and in both halves of the lines."""
    if len(rest_dn) < FEWEST_LINES:
        return None
    excess = rest_dn[1:-1] - (rest_dn[:-2] + rest_dn[2:]) / 2
    contrast = excess * np.sign(_odd(rest_dn, first)[1:-1])
    middle, sigma = float(np.median(contrast)), _typical_dn(contrast)
    value = float(np.clip(contrast, middle - FAR * sigma, middle + FAR * sigma).mean())
    error = 2 * sigma / np.sqrt(1.5 * len(contrast))  # a value of independent lines has 1.5 times their variance
    halves = [float(np.median(of)) for of in np.array_split(contrast, 2)]
    there = abs(value) > PARITY_THERE * error and min(np.sign(value) * of for of in halves) > abs(value) / 2
    return (value, error) if there else None


def _exponent(correlation: float, error: float, lines: int, step: int) -> tuple[float, float]:
    """By the correlation of lines `step` apart, its error."""
    low, middle, high = (exponent_of(correlation + way * error, lines, step) for way in (-1, 0, 1))
    return middle, np.inf if middle in EXPONENTS else max((high - low) / 2, LEAST_ERROR)


def _near(rest_dn: np.ndarray) -> np.ndarray:
    near = np.abs(rest_dn) <= FAR * _typical_dn(rest_dn)
    return near if near.mean() >= 1 - FEW else np.ones_like(near)


def _level_dn(plane: Plane) -> np.ndarray:
    """Levels of the sampled pixels [row, column]."""
    return plane.halves.level_dn.mean(0, dtype=np.float64).reshape(-1, len(plane.column_mean_dn))


def _is_whole(plane: Plane, axis: str, rest_dn: np.ndarray) -> np.ndarray:
    """Which lines [line] are off as a whole: the median of their pixels is, and not only a hot or a stuck one."""
    level = _level_dn(plane)
    lines = level if axis == "row" else level.T
    if len(lines) != len(rest_dn):  # rows of which only some were sampled
        return np.ones(len(rest_dn), bool)
    middle = np.median(lines, axis=1)
    others = median_filter(middle, AROUND, mode="nearest"), np.median(middle)  # a drift ends in several lines
    off = np.maximum(*((middle - of) * np.sign(rest_dn) for of in others))
    return off > WHOLE * np.abs(rest_dn)


def _rest(means_dn: np.ndarray, shading: Shading | None) -> np.ndarray:
    rest = means_dn if shading is None else shading.left_of(means_dn)
    return rest - np.median(rest)


def _noise_dn2(plane: Plane, axis: str, frames: int) -> float:
    """What pixels, static and over time, and lines over time scatter the static mean of a line, DN^2.

    Outlying pixels, hot or stuck, do so in all lines but those few that they pull far off, which are left out.
    """
    level = _level_dn(plane)
    level -= np.median(level, axis=0)
    level -= np.median(level, axis=1, keepdims=True)
    across = plane.row_mean_dn if axis == "column" else plane.column_mean_dn
    lines = level if axis == "row" else level.T
    pulled = lines.mean(1)
    of_pixels = max(_typical_dn(level) ** 2, float(lines[_near(pulled - np.median(pulled))].var(1).mean()))
    over_time = max(plane.components[f"{axis}_x_frame"].variance_dn2, 0.0)
    return of_pixels / len(across) + over_time / frames


def _typical_dn(values: np.ndarray) -> float:
    """Standard deviation of normal values with the same median deviation."""
    return robust_sigma(values - np.median(values))
