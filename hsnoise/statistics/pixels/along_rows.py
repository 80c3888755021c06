"""What a pixel shares of its temporal noise with those read before it: correlated read noise, or a coupled signal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hsnoise.statistics.pixels.sample import CORE_SIGMAS

NEAR, FAR = np.arange(1, 5), np.arange(9, 17)  # pixels apart: what is measured, and what is common to a row
MOST_PAIRS, MOST_PIXELS = 4, 1 << 20  # of frames, and of one frame
NARROWEST = 1.0  # DN: rounding correlates what is narrower
ALIKE = 1.15  # factor of the least variance up to which groups have hardly anything but read noise
FAR_BETTER = 2.0  # chi-square by which an explanation fails more than the other
THERE = 50.0  # chi-square of four correlations by chance: 20 in one of two thousand
FARTHER = 0.2  # of the covariance of neighbours, with the next pixel but one: none acts on the signal so far
LEAST_SHARE = 0.005  # of the read noise; less hardly shows
SIMPLER = 2.0  # factor by which the chi-square of a frequency between slow and alternating must be less
# With less memory than that, only the product of share and memory would show.
FREQUENCIES, MEMORIES = np.linspace(0.0, 0.5, 51), np.linspace(0.2, 0.95, 76)


class Along(NamedTuple):
    """Temporal variance of a group's pixels, and their covariance with those NEAR before them [lag], with its error."""

    variance_dn2: float
    covariance_dn2: np.ndarray
    error_dn2: float


class Ringing(NamedTuple):
    """Correlated part of the read noise, as `correlated_read_noise` has it, each value with its error."""

    share: tuple[float, float]
    frequency: tuple[float, float]
    memory: tuple[float, float]


def along_rows(counts: np.ndarray, colours: int) -> Along | None:
    """Of frames [frame, row, column] of one exposure, `colours` taking turns in a row; None if they do not show it.

    From the change between two frames, without outliers and what rows or columns share.
    """
    pairs, columns = min(len(counts) // 2, MOST_PAIRS), counts.shape[2]
    if not pairs or columns <= 4 * FAR[-1]:
        return None
    frames = counts[: 2 * pairs, : max(MOST_PIXELS // columns, 1)].astype(np.float32)
    several = [_bounded(change, colours) for change in frames[1::2] - frames[::2]]
    variance = float(np.mean([np.mean(x**2, dtype=np.float64) for x in several])) / 2
    if variance < NARROWEST**2:
        return None
    near, far = (np.array([np.mean([_product(x, lag) for x in several]) for lag in lags]) / 2 for lags in (NEAR, FAR))
    common = np.array([far[FAR % 2 == lag % 2].mean() for lag in NEAR])  # even and odd columns may differ in it
    size = sum(x.size for x in several)
    return Along(variance, near - common, float(variance * np.sqrt((1 + 2 / len(FAR)) / size)))


def _bounded(change: np.ndarray, colours: int) -> np.ndarray:
    for first in range(colours):
        part = change[:, first::colours]
        part -= np.median(part, axis=1, keepdims=True)
    change -= np.median(change, axis=0)
    width = CORE_SIGMAS * 1.4826 * float(np.median(np.abs(change)))
    return np.clip(change, -width, width)


def _product(x: np.ndarray, lag: int) -> float:
    return float(np.mean(x[:, lag:] * x[:, :-lag], dtype=np.float64))


def of_read_noise(groups: Sequence[Along], read_dn2: float) -> Ringing | None:
    """The correlated part of the read noise, DN^2, if it is there and does not act on the signal.

    What acts on the signal, such as an amplifier that has not settled, correlates shot noise as much, and reaches one
    pixel far. Where no group has shot noise, and nothing reaches farther, the two cannot be separated: None.
    """
    least = min((one.variance_dn2 for one in groups), default=0.0)
    quiet = [one for one in groups if one.variance_dn2 < ALIKE * least]
    noisy = [one for one in groups if one.variance_dn2 >= ALIKE * least]
    if not quiet:
        return None
    weight = np.array([one.error_dn2**-2.0 for one in quiet])
    covariance = np.average([one.covariance_dn2 for one in quiet], 0, weight)
    variance, error = float(np.average([one.variance_dn2 for one in quiet], 0, weight)), float(weight.sum() ** -0.5)
    if float(np.sum(covariance**2)) < THERE * error**2:
        return None
    if noisy:
        same, growing = (_left(noisy, covariance, error, of) for of in (0.0, 1 / variance))
        of_signal = growing < FAR_BETTER * same + THERE
    else:
        next_but_one = abs(covariance[1])
        of_signal = next_but_one < FARTHER * abs(covariance[0]) or next_but_one**2 < THERE * error**2
    return None if of_signal else _ringing(covariance / read_dn2, error / read_dn2)


def _left(groups: Sequence[Along], covariance: np.ndarray, error: float, per_dn2: float) -> float:
    """Chi-square of groups if their covariance is that of quiet ones, or (per_dn2 > 0) grows with the variance."""
    left = 0.0
    for one in groups:
        growth = one.variance_dn2 * per_dn2 if per_dn2 > 0 else 1.0
        off = one.covariance_dn2 - growth * covariance
        left += float(np.sum(off**2)) / (one.error_dn2**2 + (growth * error) ** 2)
    return left


def _ringing(correlation: np.ndarray, error: float) -> Ringing | None:
    """Share, frequency and memory of correlations at NEAR lags, by least squares; None if the share is negligible."""
    shape = MEMORIES[:, None, None] ** NEAR * np.cos(2 * np.pi * FREQUENCIES[:, None] * NEAR)
    share = np.clip((shape @ correlation) / np.sum(shape**2, -1), 0.0, 1.0)
    left = np.sum((correlation - share[..., None] * shape) ** 2, -1) / error**2
    left[:, 1:-1] *= SIMPLER
    m, f = np.unravel_index(int(left.argmin()), left.shape)
    if share[m, f] * MEMORIES[m] < LEAST_SHARE:
        return None
    found = np.array([share[m, f], FREQUENCIES[f], MEMORIES[m]])
    between = 0 < f < len(FREQUENCIES) - 1
    free = [0, 1, 2] if between else [0, 2]
    slopes = np.array([_correlations(found + step) - _correlations(found - step) for step in 1e-4 * np.eye(3)[free]])
    information = slopes @ slopes.T / (2e-4 * error) ** 2 + 1e-6 * np.eye(len(free))
    errors = np.zeros(3)
    errors[free] = np.sqrt(np.diagonal(np.linalg.inv(information)))
    return Ringing(*((float(value), float(one)) for value, one in zip(found, errors, strict=True)))


def _correlations(values: np.ndarray) -> np.ndarray:
    """At NEAR lags, for (share, frequency, memory)."""
    share, frequency, memory = values
    return share * memory**NEAR * np.cos(2 * np.pi * frequency * NEAR)
