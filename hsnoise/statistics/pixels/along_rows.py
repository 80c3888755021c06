"""What a pixel shares of its temporal noise with those read before it: correlated read noise, or a coupled signal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import chi2

from hsnoise._core.robust import robust_sigma
from hsnoise.statistics.pixels.sample import CORE_SIGMAS
from hsnoise.statistics.pixels.waves import Wave, without_waves

NEAR, FAR = np.arange(1, 5), np.arange(9, 17)  # pixels apart: what is measured, and what is common to a row
MOST_PAIRS, MOST_PIXELS = 4, 1 << 20  # of frames, and of one frame
BESIDE = 2  # pixels beside an outlier that are left out with it
NARROWEST = 1.0  # DN: rounding correlates what is narrower
ALIKE = 1.15  # factor of the least variance up to which groups have hardly anything but read noise
FAR_BETTER = 2.0  # chi-square by which an explanation fails more than the other
THERE = 50.0  # chi-square of four correlations by chance: 20 in one of two thousand
FARTHER = 0.2  # of the covariance of neighbours, with the next pixel but one: none acts on the signal so far
SIGNIFICANT, WITHIN = 5.0, 3.0  # standard errors of a correlation of shot noise: from which it is there; of its limits
BY_CHANCE = 0.1  # probability of a scatter between exposures below which it widens that error
LEAST_SHARE = 0.005  # of the read noise; less hardly shows
MOST_LEFT = 0.2  # of the squares of the correlations, by a ringing that describes them
SIMPLER = 2.0  # factor by which the chi-square of a frequency between slow and alternating must be less
# With less memory than that, only the product of share and memory would show.
FREQUENCIES, MEMORIES = np.linspace(0.0, 0.5, 51), np.linspace(0.2, 0.95, 76)


class Along(NamedTuple):
    """Temporal variance of a group's pixels, and their covariance with those NEAR before them [lag], with its error.

    above_dn2: covariance with the pixel above; NaN where no neighbouring rows were kept.
    """

    variance_dn2: float
    covariance_dn2: np.ndarray
    error_dn2: float
    above_dn2: float = float("nan")


class Limits(NamedTuple):
    """Between which the correlation of shot noise with that of neighbours lies: along rows, and down columns."""

    along: tuple[float, float]
    down: tuple[float, float]


class Ringing(NamedTuple):
    """Correlated part of the read noise, as `correlated_read_noise` has it, each value with its error."""

    share: tuple[float, float]
    frequency: tuple[float, float]
    memory: tuple[float, float]


def along_rows(
    counts: np.ndarray, colours: int, rows: np.ndarray | None = None, waves: Sequence[Wave] = ()
) -> Along | None:
    """Of frames [frame, row, column] of one exposure, `colours` taking turns in a row; None if they do not show it.

    From the change between two frames, without outliers and what rows or columns share. rows: their numbers on the
    sensor; None if they follow each other. waves: that cross these frames, and are no part of it.
    """
    pairs, columns = min(len(counts) // 2, MOST_PAIRS), counts.shape[2]
    if not pairs or columns <= 4 * FAR[-1]:
        return None
    frames = counts[: 2 * pairs, : max(MOST_PIXELS // columns, 1)].astype(np.float32)
    numbers = np.arange(frames.shape[1]) if rows is None else rows[: frames.shape[1]]
    changes = frames[1::2] - frames[::2]
    changes = without_waves(changes, waves, numbers) if waves else changes
    several = [_bounded(change, colours) for change in changes]
    variance = float(np.mean([np.mean(x**2, dtype=np.float64) for x in several])) / 2
    if variance < NARROWEST**2:
        return None
    near, far = (np.array([np.mean([_product(x, lag) for x in several]) for lag in lags]) / 2 for lags in (NEAR, FAR))
    common = np.array([far[FAR % 2 == lag % 2].mean() for lag in NEAR])  # even and odd columns may differ in it
    size = sum(x.size for x in several)
    error = float(variance * np.sqrt((1 + 2 / len(FAR)) / size))
    return Along(variance, near - common, error, _above(several, numbers))


def _above(changes: list[np.ndarray], rows: np.ndarray) -> float:
    """Covariance of pixels with those above them, less that of pixels some rows apart, DN^2."""
    next_row = np.flatnonzero(np.diff(rows) == 1)
    if not len(next_row):
        return float("nan")
    near = np.mean([np.mean(x[next_row + 1] * x[next_row], dtype=np.float64) for x in changes])
    apart = [lag for lag in FAR if lag < len(rows)]
    common = [np.mean(x[lag:] * x[:-lag], dtype=np.float64) for x in changes for lag in apart]
    return float(near - (np.mean(common) if common else 0.0)) / 2


def _bounded(change: np.ndarray, colours: int) -> np.ndarray:
    for first in range(colours):
        part = change[:, first::colours]
        part -= np.median(part, axis=1, keepdims=True)
    change -= np.median(change, axis=0)
    far = np.abs(change) > CORE_SIGMAS * robust_sigma(change)
    near = far.copy()
    for step in range(1, BESIDE + 1):  # tracks of particles are as faint at their ends as noise
        near[:, step:] |= far[:, :-step]
        near[:, :-step] |= far[:, step:]
    change[near] = 0.0
    return change


def _product(x: np.ndarray, lag: int) -> float:
    return float(np.mean(x[:, lag:] * x[:, :-lag], dtype=np.float64))


def neighbours_share(counts: np.ndarray) -> float:
    """Correlation along rows of the change between the first two frames, without outliers and row offsets."""
    if len(counts) < 2:
        return float("nan")
    change = counts[1].astype(np.float32) - counts[0]
    change -= np.median(change, axis=1, keepdims=True)
    change -= np.median(change, axis=0)
    width = CORE_SIGMAS * robust_sigma(change)
    change = np.clip(change, -width, width)
    variance = float(np.mean(change**2, dtype=np.float64))
    return float(np.mean(change[:, 1:] * change[:, :-1], dtype=np.float64)) / variance if variance > 0 else 0.0


def of_read_noise(groups: Sequence[Along], read_dn2: float, *, unlit: bool = False) -> Ringing | None:
    """The correlated part of the read noise, DN^2, if it is there and does not act on the signal.

    What acts on the signal, such as an amplifier that has not settled, correlates shot noise as much, and reaches one
    pixel far. Where no group has shot noise, and nothing reaches farther, the two cannot be separated: None, unless all
    frames are `unlit` (bias frames), which have no signal that it could act on.
    """
    quiet, noisy = _by_noise(groups)
    if quiet is None or float(np.sum(quiet.covariance_dn2**2)) < THERE * quiet.error_dn2**2:
        return None
    if noisy:
        same, growing = (_left(noisy, quiet, grows=grows) for grows in (False, True))
        of_signal = growing < max(FAR_BETTER * same, same + THERE)
    else:
        near, farther = np.abs(quiet.covariance_dn2[:2])
        of_signal = not unlit and (farther < FARTHER * near or farther**2 < THERE * quiet.error_dn2**2)
    return None if of_signal else _ringing(quiet.covariance_dn2 / read_dn2, quiet.error_dn2 / read_dn2)


def of_the_signal(groups: Sequence[Along]) -> tuple[float, float]:
    """Correlation along rows, and down columns, that shot noise of neighbours has, so that the signal is coupled.

    0 where it is not, or is not known.
    """
    shared, error = _of_shot_noise(groups)
    along, down = np.nan_to_num(shared) * (np.abs(shared) > SIGNIFICANT * error).any()
    return float(along), float(down)


def limits_of_the_signal(groups: Sequence[Along], ringing: Ringing | None) -> Limits:
    """Between which that correlation lies; infinite where it is not known.

    ringing: of the read noise. Where it is told from the signal, and shot noise may have nothing of it, it has nothing:
    what a ringing does not describe would else pass for a coupled signal.
    """
    shared, error = _of_shot_noise(groups)
    known = np.isfinite(shared)
    low, high = np.where(known, shared - WITHIN * error, -np.inf), np.where(known, shared + WITHIN * error, np.inf)
    if ringing is not None and known[0] and low[0] < 0 < high[0]:
        low[0] = high[0] = 0.0
    return Limits(*((float(a), float(b)) for a, b in zip(low, high, strict=True)))


def _of_shot_noise(groups: Sequence[Along]) -> tuple[np.ndarray, np.ndarray]:
    """Correlation of shot noise along rows and down columns, and its errors [2]; NaN where it is not known."""
    if not _by_noise(groups)[1]:
        return np.full(2, np.nan), np.full(2, np.nan)
    variance, error = (np.array([one[i] for one in groups]) for i in (0, 2))
    # What the read noise adds stays as it is: the slope is that of the shot noise.
    design = np.stack([np.ones(len(groups)), variance], 1) / error[:, None]
    covariance = np.linalg.inv(design.T @ design)
    shared = np.array([[one.covariance_dn2[0], one.above_dn2] for one in groups]) / error[:, None]
    both = covariance @ design.T @ shared
    # Bands of random phases scatter more than pixels; a few exposures do so by chance, too.
    free = max(len(groups) - 2, 1)
    apart = np.nan_to_num(((shared - design @ both) ** 2).sum(0))
    wider = np.where(chi2.sf(apart, free) < BY_CHANCE, np.maximum(apart / free, 1.0), 1.0)
    return both[1], np.sqrt(covariance[1, 1] * wider)


def _by_noise(groups: Sequence[Along]) -> tuple[Along | None, list[Along]]:
    """The mean of the groups that have hardly anything but read noise, and the others."""
    least = min((one.variance_dn2 for one in groups), default=0.0)
    quiet = [one for one in groups if one.variance_dn2 < ALIKE * least]
    if not quiet:
        return None, []
    weight = np.array([one.error_dn2**-2.0 for one in quiet])
    variance, covariance = (np.average([one[i] for one in quiet], 0, weight) for i in (0, 1))
    mean = Along(float(variance), covariance, float(weight.sum() ** -0.5))
    return mean, [one for one in groups if one.variance_dn2 >= ALIKE * least]


def _left(groups: Sequence[Along], quiet: Along, *, grows: bool) -> float:
    """Chi-square of groups if their covariance is that of quiet ones, or grows with the variance."""
    left = 0.0
    for one in groups:
        growth = one.variance_dn2 / quiet.variance_dn2 if grows else 1.0
        off = one.covariance_dn2 - growth * quiet.covariance_dn2
        left += float(np.sum(off**2)) / (one.error_dn2**2 + (growth * quiet.error_dn2) ** 2)
    return left


def _ringing(correlation: np.ndarray, error: float) -> Ringing | None:
    """Share, frequency and memory of correlations at NEAR lags, by least squares.

    None if the share is negligible, or one ringing does not describe them.
    """
    shape = _shape(FREQUENCIES[:, None], MEMORIES[:, None, None])
    share = np.clip((shape @ correlation) / np.sum(shape**2, -1), 0.0, 1.0)
    left = np.sum((correlation - share[..., None] * shape) ** 2, -1)
    left[:, 1:-1] *= SIMPLER
    m, f = np.unravel_index(int(left.argmin()), left.shape)
    best = float(np.sum((correlation - share[m, f] * shape[m, f]) ** 2))
    if share[m, f] * MEMORIES[m] < LEAST_SHARE or best > MOST_LEFT * float(np.sum(correlation**2)):
        return None
    between = 0 < f < len(FREQUENCIES) - 1
    start, low, high = np.array([share[m, f], MEMORIES[m], FREQUENCIES[f]]), [0.0, MEMORIES[0], 0.0], [1.0, 0.99, 0.5]
    free = slice(None) if between else slice(0, 2)

    def off(some: np.ndarray) -> np.ndarray:
        share, memory, *frequency = some
        return (share * _shape(frequency[0] if between else start[2], memory) - correlation) / error

    bounds = np.array(low)[free], np.array(high)[free]
    found = least_squares(off, np.clip(start[free], bounds[0] + 1e-6, bounds[1] - 1e-6), bounds=bounds, x_scale=0.1)
    n = len(found.x)
    worse = max(1.0, 2 * found.cost / (len(NEAR) - n))  # one ringing does not describe every amplifier
    inside = found.active_mask == 0  # a memory at its bound is held there
    jac, errors = found.jac[:, inside], np.zeros(n)
    errors[inside] = np.sqrt(worse * np.diagonal(np.linalg.inv(jac.T @ jac + 1e-6 * np.eye(jac.shape[1]))))
    pairs = [(float(value), float(one)) for value, one in zip(found.x, errors, strict=True)]
    return Ringing(share=pairs[0], frequency=pairs[2] if between else (float(start[2]), 0.0), memory=pairs[1])


def _shape(frequency: np.ndarray | float, memory: np.ndarray | float) -> np.ndarray:
    """Correlation at NEAR lags of a ringing [..., lag], less its own part of what FAR lags have in common."""
    near, far = (memory**lags * np.cos(2 * np.pi * frequency * lags) for lags in (NEAR, FAR))
    common = np.stack([far[..., lag % 2 == FAR % 2].mean(-1) for lag in NEAR], -1)
    return near - common


def shared_by_row(of: Ringing, columns: int, step: int) -> float:
    """What the mean of every `step`-th pixel of a row varies more than independent pixels, over the read variance."""
    lags = step * np.arange(1, columns)
    together = of.memory[0] ** lags * np.cos(2 * np.pi * of.frequency[0] * lags) * (1 - lags / (step * columns))
    return 2 * of.share[0] * float(np.sum(together)) / columns
