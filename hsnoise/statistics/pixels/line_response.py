"""How whole rows and columns differ in their response to light: at random, and even from odd ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hsnoise._core.robust import NORMAL, robust_sigma

LEAST_LIT = 0.2  # of the mean signal: corners that get less tell little
OUTLYING = 5.0  # deviations beyond which a line does not count more
CORE_SIGMAS = 4.0  # pixels of a line further off are dust, defects or hot pixels
FEWEST_LINES = 24
LEAST_OF_LINE = 0.25  # of the pixels of the best lit line
TINY = 1e-16
PIECES = 8  # of the lines, in all of which odd ones lie on one side of even ones
PARITY_THERE = 5.0  # standard errors
BESIDE = 1.5  # variance of a line less the mean of the two beside it, in variances of a line
ALIKE = 1.94  # sum of the squared correlations of such differences, which are -2/3 and 1/6
NONE = (0.0, np.inf)


class LineResponse(NamedTuple):
    """Relative responses of rows or columns, each with its standard error; infinite where nothing tells.

    variance: over lines, beside that of even and odd ones. parity: odd lines less even ones.
    """

    variance: tuple[float, float] = NONE
    parity: tuple[float, float] = NONE


class LitPlane(NamedTuple):
    """One plane under a level of light, mean over its frames.

    signal [row, column], DN; noise_dn2: variance of a pixel of it by chance; lines_dn2: what rows and columns add to
    that; evened: the factor by which differences of response appear, less than 1 where the response bends.
    """

    signal: np.ndarray
    noise_dn2: float
    lines_dn2: tuple[float, float]
    evened: float


def line_response(
    levels: Sequence[LitPlane], pixel_variance: float, *, axis: int, numbers: np.ndarray | None
) -> LineResponse:
    """The response of the rows (axis 0) or columns (1) of one plane under levels of light.

    Args:
        pixel_variance: relative variance of the response over pixels, whose mean over a line is not the line's.
        numbers: of the lines on the sensor, among those of their colour; None if they are not next to each other.

    A line less the mean of those beside it: light that varies smoothly cancels.
    """
    profiles, lit = zip(*(_profile(np.moveaxis(level.signal, axis, 0)) for level in levels), strict=True)
    pixels = np.min(lit, axis=0)
    kept = pixels > LEAST_OF_LINE * pixels.max()
    if kept.sum() < FEWEST_LINES:  # of which some are even and some odd
        return LineResponse()
    places = float(pixels[kept].mean())
    noise = np.array([_noise(level, axis, places) for level in levels])
    several = np.array([profile[kept] / level.evened for profile, level in zip(profiles, levels, strict=True)])
    weight = 1 / noise / (1 / noise).sum()
    # Even and odd lines apart: the median of both would be one or the other.
    is_odd = (np.arange(len(kept)) if numbers is None else numbers[1:-1])[kept] % 2 == 1
    middle = (np.median(several[:, is_odd], axis=1) + np.median(several[:, ~is_odd], axis=1)) / 2
    mean = weight @ (several - middle[:, None])
    parity, odd = NONE, np.where(is_odd, 1.0, -1.0)
    if numbers is not None:
        parity = _parity(mean * odd)
        if abs(parity[0]) > PARITY_THERE * parity[1]:
            mean = mean - parity[0] * odd
    square = np.minimum(mean**2, (OUTLYING * robust_sigma(mean)) ** 2)
    error = square.std() * np.sqrt(ALIKE / len(square))
    return LineResponse(
        (float(square.mean() / BESIDE - weight**2 @ noise - pixel_variance / places), error / BESIDE), parity
    )


def _noise(level: LitPlane, axis: int, places: float) -> float:
    """Relative variance of a line of so many pixels by chance, evened out as it is."""
    of_line = level.noise_dn2 / places + level.lines_dn2[axis]
    return max(of_line / (float(level.signal.mean()) * level.evened) ** 2, TINY)


def _profile(signal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Logarithm of each line over those beside it [line], outliers cut, and its pixels in light [line].

    signal [line, place].
    """
    around = (signal[:-2] + signal[2:]) / 2
    least = max(LEAST_LIT * float(signal.mean()), TINY)
    lit = around > least
    number = lit.sum(1)
    lit[:, 0] |= number == 0  # has a value, and does not count
    excess = np.where(lit, np.log(np.maximum(signal[1:-1], least / 2) / np.maximum(around, least)), np.nan)
    middle = np.nanmedian(excess, axis=1, keepdims=True)
    off = excess - middle
    width = CORE_SIGMAS * NORMAL * float(np.nanmedian(np.abs(off)))
    return middle[:, 0] + np.nanmean(np.clip(off, -width, width), axis=1), number


def _parity(contrast: np.ndarray) -> tuple[float, float]:
    """Mean of what odd lines have more and even ones less [line], if it is so everywhere, and its standard error.

    Each line is in three of these values with the same sign: their mean is less certain than if they were independent.
    """
    middle = float(np.median(contrast))
    sigma = robust_sigma(contrast - middle)
    middle = float(np.clip(contrast, middle - OUTLYING * sigma, middle + OUTLYING * sigma).mean())
    pieces = np.array([np.median(of) for of in np.array_split(contrast, PIECES)])
    error = 2 * sigma / np.sqrt(BESIDE * len(contrast))
    middle = 2 * float(np.tanh(middle / 2))  # of logarithms
    return (middle, error) if (np.sign(pieces) == np.sign(middle)).all() else (0.0, max(abs(middle), error))
