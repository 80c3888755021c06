"""How pixels differ: the distributions of dark current and offsets over pixels, without the noise of estimation.

The law of the dark current is in `dark_currents`. Offsets are normal; their variance is the covariance of two halves of
the frames, which noise does not enter.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from hsnoise._core.robust import robust_sigma
from hsnoise.statistics.pixels.classes import Levels, growth_noise, slope_over
from hsnoise.statistics.pixels.dark_currents import Noise, fitted, growth_cdf, relative_width
from hsnoise.statistics.pixels.sample import of_neighbours

APART_SIGMAS, APART_SHARE = 6.0, 0.3  # if the growth in two halves disagrees by more, it is a hit or a jump
WINSOR_SIGMAS = 5.0
MOST_COLD = 0.5  # of the number of warm pixels
WARM_SIGMAS = 6.0  # in units of the noise of the levels, from those below the median
DARK_SHARE = 0.1  # of the variance over pixels at the shortest exposure
MANY_ROWS = 48  # whose median tells what a column has
NOISE_RANGE, NOISE_GROUPS, FEWEST_IN_GROUP = (0.02, 0.98), 8, 200  # quantiles of growth at which its noise is measured
MEDIAN_VARIANCE, SURE_SLOPE = 5.4, 5.0  # relative variance of a squared median deviation, times pixels; standard errors
FEWEST_HOT, HOT_AGAIN = 20, 0.5  # pixels; share that must be hot in the other frames as well


@dataclass(frozen=True)
class Population:
    """Dark current of the pixels of one channel, DN/s, and offsets, DN; each value with its standard error.

    Attributes:
        mean: of ordinary pixels, independent of the limit above which pixels are called hot.
        spread, skew: of ln dark current of ordinary pixels (0: they do not differ; 0: log-normal).
        hot_fraction, hot_rate: share of hot pixels (0: none), and mean of their extra dark current, such that
            the mean over all pixels is the measured one; hot_spread: of ln mean over hot pixels (0: exponential).
        at_readout: mean extra charge of hot pixels that is independent of exposure, DN.
        offset_sigma: standard deviation of offsets over pixels, without those of rows and columns.
        median, quantiles: of the measured growth, DN/s; quantiles at 1, 16, 84, 99, 99.9 %.
        noise: standard deviation by chance of the growth of one pixel, DN/s.
    """

    mean: float
    spread: tuple[float, float]
    skew: tuple[float, float]
    hot_fraction: tuple[float, float]
    hot_rate: tuple[float, float]
    hot_spread: tuple[float, float]
    at_readout: tuple[float, float]
    offset_sigma: tuple[float, float]
    median: float
    quantiles: tuple[float, ...]
    noise: float


def population_of(
    pixels: Levels, limit: float, ordinary: float, pedestal_dn_per_s: float, patterns: Patterns
) -> Population:
    """The population of one channel.

    Args:
        pixels: from `levels_of`.
        limit: growth above which pixels were called hot, DN/s; ordinary: mean growth of those below it, without
            pedestals.
        pedestal_dn_per_s: what moving pedestals add to every pixel's growth.
        patterns: of the offsets.
    """
    halves = slope_over(pixels.exposure_s, pixels.level) - pedestal_dn_per_s
    noise = growth_noise(halves) / np.sqrt(2)
    growth = halves.mean(0)
    apart = np.abs(halves[0] - halves[1])
    steady = (apart < APART_SIGMAS * 2 * noise) | (apart < APART_SHARE * 2 * np.abs(growth))
    growth = growth[steady].astype(np.float64)
    # A pedestal that falls faster than the dark signal rises is common to all pixels: growth is measured from it.
    fallen = min(float(np.median(growth)), 0.0)
    of_growth = noise_of(halves[:, steady].astype(np.float64) - fallen)
    values, errors = fitted(growth - fallen, of_growth)
    if not _hot_again(halves, limit - pedestal_dn_per_s):
        values[3:], errors[3:] = 0.0, np.inf
    body, spread, skew, fraction, rate, hot_spread = values
    below = float(growth[growth < limit - pedestal_dn_per_s].mean())
    beyond = 0.0
    if fraction > 0:
        # The log-normal tail above the limit belongs to the ordinary pixels; hot pixels below it do not.
        beyond = body - _mean_below(limit - pedestal_dn_per_s - fallen, of_growth, values)
    total = float(growth.mean())
    if fraction > 0 and total <= below + beyond:  # the log-normal's tail holds more than all pixels have
        fraction = values[3] = 0.0
        errors[3:] = np.inf
    if fraction <= 0:
        beyond = total - below if spread > 0 else 0.0
    mean = ordinary + beyond
    if fraction > 0:  # keeps the charge of the tail, whatever its shape; moving pedestals are in both means
        scatter = float(growth.std()) / np.sqrt(len(growth))
        rate = max((total - below - beyond) / fraction, 0.0)
        errors[4] = max(errors[4], np.hypot(scatter / fraction, rate * errors[3] / fraction))
    shortest = float(pixels.exposure_s.min())
    return Population(
        mean=mean,
        spread=(spread, errors[1]),
        skew=(skew, errors[2]),
        hot_fraction=(fraction, errors[3]),
        hot_rate=(rate, errors[4]),
        hot_spread=(hot_spread, errors[5]),
        at_readout=_at_readout(pixels, halves, noise, rate),
        offset_sigma=_offsets(patterns, relative_width(spread, skew) * body * shortest),
        median=float(np.median(growth)),
        quantiles=tuple(float(q) for q in np.quantile(growth, (0.01, 0.16, 0.84, 0.99, 0.999))),
        noise=float(noise),
    )


def noise_of(halves: np.ndarray) -> Noise:
    """Of the mean growth of two halves of the frames [half, pixel], from how far they are apart, jumps and hits aside.

    The same for all pixels where it does not clearly rise with growth.
    """
    growth = halves.mean(0)
    edges = np.quantile(growth, np.linspace(*NOISE_RANGE, NOISE_GROUPS + 1))
    groups = [np.flatnonzero((growth >= low) & (growth < high)) for low, high in pairwise(edges)]
    groups = [group for group in groups if len(group) >= FEWEST_IN_GROUP]
    usual = Noise(growth_noise(halves) / np.sqrt(2))
    if len(groups) < 2:
        return usual
    x = np.array([np.median(growth[group]) for group in groups])
    variance = np.array([growth_noise(halves[:, group]) ** 2 / 2 for group in groups])
    if variance.min() <= 0:  # most pixels have the same count in both halves
        return usual
    sigma = variance * np.sqrt(MEDIAN_VARIANCE / np.array([len(group) for group in groups]))
    design = np.stack([np.ones_like(x), x], 1) / sigma[:, None]
    covariance = np.linalg.pinv(design.T @ design)
    still, slope = covariance @ design.T @ (variance / sigma)
    if slope <= SURE_SLOPE * np.sqrt(covariance[1, 1]) or still + slope * max(x.min(), 0.0) <= 0:
        return usual
    return Noise(float(np.sqrt(max(still, 0.0))), float(slope))


class Patterns(NamedTuple):
    """Pixels beside their neighbours [half, pixel], DN, and the standard deviation of those below the median.

    shortest: at the shortest exposure; unexposed: extrapolated to none, None where that was none.
    """

    shortest: np.ndarray
    unexposed: np.ndarray | None
    low_side_dn: float


class Warm(NamedTuple):
    """Warm pixels of one exposure, each value with its error: their share, and mean and spread of their extra level.

    growth: of that level in a second, relative to it; infinite error: charge of the exposure cannot be distinguished
    from charge of the readout.
    """

    fraction: tuple[float, float]
    extra_dn: tuple[float, float]
    spread: tuple[float, float]
    growth: tuple[float, float] = (0.0, np.inf)


def beyond_neighbours(levels: np.ndarray, columns: int) -> np.ndarray:
    """Levels [..., pixel] of pixels in rows of `columns`, less what neighbours share, such as shading, and less what a
    whole column has: the first ones that an output reads may lie far off."""
    off = np.stack([one - of_neighbours(one, columns) for one in levels]).astype(np.float64)
    of_column = off.mean(0).reshape(-1, columns)
    if len(of_column) >= MANY_ROWS:
        off -= np.tile(np.median(of_column, axis=0), len(of_column))
    return off


def warm_of(off: np.ndarray) -> Warm | None:
    """The warm pixels of one exposure; None where there are none. off [half, pixel]: levels `beyond_neighbours`."""
    extra = off.mean(0) - np.median(off.mean(0))
    noise = robust_sigma(extra[extra < 0]) if (extra < 0).any() else 0.0
    if noise <= 0 or not _hot_again(off, WARM_SIGMAS * noise) or _as_cold(off, WARM_SIGMAS * noise):
        return None
    values, errors = fitted(extra, Noise(noise))
    if values[3] <= 0:
        return None
    return Warm(*((float(values[i]), float(errors[i])) for i in (3, 4, 5)))


def _hot_again(halves: np.ndarray, limit: float) -> bool:
    """Whether pixels that are hot in one half of the frames are hot in the other, unlike jumps and hits."""
    once = halves[0] > limit
    return bool(once.sum() > FEWEST_HOT and np.mean(halves[1][once] > limit / 2) > HOT_AGAIN)


def _as_cold(halves: np.ndarray, limit: float) -> bool:
    """Whether pixels lie as far below the others as above them: their offsets have tails then, and are not warm."""
    below, above = ((sign * halves).min(0) > limit for sign in (-1, 1))
    return bool(below.sum() > MOST_COLD * above.sum())


def _mean_below(limit: float, noise: Noise, values: np.ndarray) -> float:
    """Mean measured growth of the pixels below a limit, under the fitted distribution."""
    x = np.linspace(min(-8 * float(noise.at(values[0])), limit - 1e-9), limit, 400)
    cdf = growth_cdf(x, noise, *values)
    return float(limit - np.trapezoid(cdf, x) / max(cdf[-1], 1e-12))


def _offsets(patterns: Patterns, dark_sigma_dn: float) -> tuple[float, float]:
    """Standard deviation of offsets; without exposure, where dark current makes much of what pixels have with it."""
    if dark_sigma_dn**2 > DARK_SHARE * shared_variance(patterns.shortest)[0] and patterns.unexposed is not None:
        return offset_sigma(patterns.unexposed, 0.0, patterns.low_side_dn)
    return offset_sigma(patterns.shortest, dark_sigma_dn, patterns.low_side_dn)


def offset_sigma(pattern: np.ndarray, dark_sigma_dn: float, low_side_dn: float) -> tuple[float, float]:
    """Standard deviation of offsets from two halves of the frames [half, pixel], without the part due to dark current.

    At most that of the pixels below the median: warm pixels are not normal offsets.
    """
    variance, error = shared_variance(pattern)
    return root_of(min(variance, low_side_dn**2) - dark_sigma_dn**2, error)


def shared_variance(pattern: np.ndarray) -> tuple[float, float]:
    """Variance over pixels that two halves of the frames [half, pixel] have in common, outliers cut, and its error."""
    a, b = map(winsorised, pattern)
    product = a * b
    return float(product.mean()), float(product.std()) / np.sqrt(len(product))


def winsorised(values: np.ndarray) -> np.ndarray:
    """Values with a median near 0, outliers cut, less their mean."""
    width = WINSOR_SIGMAS * robust_sigma(values)
    cut = np.clip(values, -width, width).astype(np.float64)
    return cut - cut.mean()


def root_of(variance: float, error: float) -> tuple[float, float]:
    """Standard deviation, 0 of a negative variance, and its error."""
    sigma = float(np.sqrt(max(variance, 0.0)))
    return sigma, float(min(error / max(2 * sigma, 1e-12), np.sqrt(error)))


def _at_readout(pixels: Levels, halves: np.ndarray, noise: float, rate: float) -> tuple[float, float]:
    """Extra offset of the hottest pixels per growth, times the mean rate; with its error, DN."""
    if rate <= 0:
        return 0.0, np.inf
    median = np.median(halves)
    hot = halves[0] > median + max(0.5 * rate, 8 * noise)  # chosen in one half, measured in the other
    if hot.sum() < 20:
        return 0.0, np.inf
    t = pixels.exposure_s
    offset = pixels.level[:, 1].mean(0) - halves[1] * t.mean()
    growth = halves[1][hot].astype(np.float64) - median
    extra = offset[hot].astype(np.float64) - np.median(offset)
    ratio = float(np.median(extra / growth))
    scatter = robust_sigma(extra / growth - ratio) / np.sqrt(len(growth))
    return (ratio * rate, scatter * rate) if ratio > 3 * scatter else (0.0, scatter * rate)
