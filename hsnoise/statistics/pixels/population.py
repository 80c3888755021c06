"""How pixels differ: the distributions of dark current and offsets over pixels, without the noise of estimation.

Dark current is modelled like the effects that draw it: log-normal (`dark_current_nonuniformity`), with an exponential
extra in a fraction of pixels (`hot_pixels`), whose mean may be log-normal as well. It is fitted to the measured growth
of all pixels by maximum likelihood, with the known noise of a pixel's growth as part of the distribution. Offsets are
normal; their variance is the covariance of two halves of the frames, which noise does not enter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import erfcx, ndtr

from hsnoise._core.quadrature import normal_nodes
from hsnoise.statistics.pixels.classes import Levels, growth_noise, slope_over
from hsnoise.statistics.pixels.sample import of_neighbours

FEWEST_IN_TAIL = 100  # hot pixels from which the shape of their distribution is fitted
TAIL_NODES, MOST_TAIL = 12, 0.9  # of the means of hot pixels; largest logarithm of their spread
NODES = 48  # over the log-normal distribution, or over the noise if that is narrower
WIDE = 0.5  # of the log-normal width: noise above it counts as the wider one
CORE_BINS, TAIL_BINS = 120, 80
APART_SIGMAS, APART_SHARE = 6.0, 0.3  # if the growth in two halves disagrees by more, it is a hit or a jump
SIGNIFICANT = 15.0  # twice the rise in log-likelihood above which pixels differ in dark current
LEAST_SPREAD = 0.02
WINSOR_SIGMAS = 5.0
MOST_HOT, COOL = 0.3, -25.0  # largest share of hot pixels, and the logit that stands for none
HOT_FROM = 2.0  # mean extra of hot pixels, over the mean of the others
MOST_COLD = 0.5  # of the number of warm pixels
WARM_SIGMAS = 6.0  # in units of the noise of the levels, from those below the median
MANY_ROWS = 48  # whose median tells what a column has
FEWEST_HOT, HOT_AGAIN = 20, 0.5  # pixels; share that must be hot in the other frames as well


@dataclass(frozen=True)
class Population:
    """Dark current of the pixels of one channel, DN/s, and offsets, DN; each value with its standard error.

    Attributes:
        mean: of ordinary pixels, independent of the limit above which pixels are called hot.
        spread: of ln dark current of ordinary pixels (0: they do not differ).
        hot_fraction, hot_rate: share of hot pixels (0: none), and mean of their extra dark current, such that
            the mean over all pixels is the measured one; hot_spread: of ln mean over hot pixels (0: exponential).
        at_readout: mean extra charge of hot pixels that is independent of exposure, DN.
        offset_sigma: standard deviation of offsets over pixels, without those of rows and columns.
        median, quantiles: of the measured growth, DN/s; quantiles at 1, 16, 84, 99, 99.9 %.
        noise: standard deviation by chance of the growth of one pixel, DN/s.
    """

    mean: float
    spread: tuple[float, float]
    hot_fraction: tuple[float, float]
    hot_rate: tuple[float, float]
    hot_spread: tuple[float, float]
    at_readout: tuple[float, float]
    offset_sigma: tuple[float, float]
    median: float
    quantiles: tuple[float, ...]
    noise: float


def population_of(
    pixels: Levels, limit: float, ordinary: float, pedestal_dn_per_s: float, pattern: np.ndarray, low_side_dn: float
) -> Population:
    """The population of one channel.

    Args:
        pixels: from `levels_of`.
        limit: growth above which pixels were called hot, DN/s; ordinary: mean growth of those below it, without
            pedestals.
        pedestal_dn_per_s: what moving pedestals add to every pixel's growth.
        pattern [half, pixel]: offset of each pixel minus its row and column, DN, at the shortest exposure.
        low_side_dn: standard deviation of offsets, from pixels below the median.
    """
    halves = slope_over(pixels.exposure_s, pixels.level) - pedestal_dn_per_s
    noise = growth_noise(halves) / np.sqrt(2)
    growth = halves.mean(0)
    apart = np.abs(halves[0] - halves[1])
    steady = (apart < APART_SIGMAS * 2 * noise) | (apart < APART_SHARE * 2 * np.abs(growth))
    growth = growth[steady].astype(np.float64)
    # A pedestal that falls faster than the dark signal rises is common to all pixels: growth is measured from it.
    fallen = min(float(np.median(growth)), 0.0)
    values, errors = _fitted(growth - fallen, noise)
    if not _hot_again(halves, limit - pedestal_dn_per_s):
        values[2:], errors[2:] = 0.0, np.inf
    body, spread, fraction, rate, tail = values
    below = float(growth[growth < limit - pedestal_dn_per_s].mean())
    beyond = 0.0
    if fraction > 0:
        # The log-normal tail above the limit belongs to the ordinary pixels; hot pixels below it do not.
        beyond = body - _mean_below(limit - pedestal_dn_per_s - fallen, noise, values)
    total = float(growth.mean())
    if fraction > 0 and total <= below + beyond:  # the log-normal's tail holds more than all pixels have
        fraction = values[2] = 0.0
        errors[2:] = np.inf
    if fraction <= 0:
        beyond = total - below if spread > 0 else 0.0
    mean = ordinary + beyond
    if fraction > 0:  # keeps the charge of the tail, whatever its shape; moving pedestals are in both means
        scatter = float(growth.std()) / np.sqrt(len(growth))
        rate = max((total - below - beyond) / fraction, 0.0)
        errors[3] = max(errors[3], np.hypot(scatter / fraction, rate * errors[2] / fraction))
    shortest = float(pixels.exposure_s.min())
    return Population(
        mean=mean,
        spread=(spread, errors[1]),
        hot_fraction=(fraction, errors[2]),
        hot_rate=(rate, errors[3]),
        hot_spread=(tail, errors[4]),
        at_readout=_at_readout(pixels, halves, noise, rate),
        offset_sigma=offset_sigma(pattern, spread * body * shortest, low_side_dn),
        median=float(np.median(growth)),
        quantiles=tuple(float(q) for q in np.quantile(growth, (0.01, 0.16, 0.84, 0.99, 0.999))),
        noise=float(noise),
    )


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
    noise = 1.4826 * float(np.median(-extra[extra < 0])) if (extra < 0).any() else 0.0
    if noise <= 0 or not _hot_again(off, WARM_SIGMAS * noise) or _as_cold(off, WARM_SIGMAS * noise):
        return None
    values, errors = _fitted(extra, noise)
    if values[2] <= 0:
        return None
    return Warm(*((float(values[i]), float(errors[i])) for i in (2, 3, 4)))


def _hot_again(halves: np.ndarray, limit: float) -> bool:
    """Whether pixels that are hot in one half of the frames are hot in the other, unlike jumps and hits."""
    once = halves[0] > limit
    return bool(once.sum() > FEWEST_HOT and np.mean(halves[1][once] > limit / 2) > HOT_AGAIN)


def _as_cold(halves: np.ndarray, limit: float) -> bool:
    """Whether pixels lie as far below the others as above them: their offsets have tails then, and are not warm."""
    below, above = ((sign * halves).min(0) > limit for sign in (-1, 1))
    return bool(below.sum() > MOST_COLD * above.sum())


def _mean_below(limit: float, noise: float, values: np.ndarray) -> float:
    """Mean measured growth of the pixels below a limit, under the fitted distribution."""
    x = np.linspace(min(-8 * noise, limit - 1e-9), limit, 400)
    cdf = growth_cdf(x, noise, *values)
    return float(limit - np.trapezoid(cdf, x) / max(cdf[-1], 1e-12))


def growth_cdf(
    x: np.ndarray, noise: float, mean: float, spread: float, fraction: float, rate: float, tail: float = 0.0
) -> np.ndarray:
    """Share of pixels whose measured growth is below x: log-normal, plus exponential in a fraction, plus noise.

    tail: standard deviation of ln of the exponential's mean over pixels.
    """
    z, weight = normal_nodes(NODES)
    body = mean * np.exp(spread * z - spread**2 / 2)
    off = (x[:, None] - body) / noise
    if noise > WIDE * spread * mean:
        plain = ndtr(off) @ weight
    else:  # narrow noise would leave steps between the nodes of the log-normal distribution
        left = np.maximum(x[:, None] - noise * z, 1e-300) / mean
        plain = ndtr(np.log(left) / spread + spread / 2) @ weight
    if fraction > 0 and tail > 0:  # next to so wide an extra, the ordinary part of hot pixels can be taken as normal
        width = np.hypot(noise, spread * mean)
        z, weight = normal_nodes(TAIL_NODES)
        off = (x[:, None] - mean) / width
        warm = (ndtr(off) - _exponential_share(off, width / (rate * np.exp(tail * z - tail**2 / 2)))) @ weight
        plain = (1 - fraction) * plain + fraction * warm
    elif fraction > 0:
        warm = (ndtr(off) - _exponential_share(off, noise / rate)) @ weight
        plain = (1 - fraction) * plain + fraction * warm
    return plain


def _exponential_share(off: np.ndarray, ratio: float | np.ndarray) -> np.ndarray:
    """How much an exponential extra of mean noise / `ratio` lowers the normal distribution function at `off`."""
    # exp(ratio^2 / 2 - ratio off) ndtr(off - ratio), without overflow.
    inner = (ratio - off) / np.sqrt(2)
    low = 0.5 * np.exp(-0.5 * off**2) * erfcx(np.maximum(inner, -25.0))
    return np.where(inner > -25.0, low, np.exp(np.minimum(ratio**2 / 2 - ratio * off, 0.0)))


def _fitted(growth: np.ndarray, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """(mean, spread, fraction, rate, tail) of the growth [pixel], and errors; zeros for what is not significant."""
    middle = float(np.median(growth))
    core = 1.4826 * float(np.median(np.abs(growth - middle)))
    if core <= 0:
        return np.array([max(middle, 0.0), 0.0, 0.0, 0.0, 0.0]), np.full(5, np.inf)
    far = max(growth.max() - middle, 12 * core)
    edges = middle + np.append(np.linspace(-6 * core, 6 * core, CORE_BINS), np.geomspace(6.2 * core, far, TAIL_BINS))
    counts = np.histogram(growth, np.concatenate([[-np.inf], edges, [np.inf]]))[0]

    def natural(theta: np.ndarray) -> tuple[float, ...]:
        if middle <= 0:  # ordinary pixels have no dark current that could differ
            theta = np.array([0.0, np.log(1e-3), *theta[2:]])
        return _natural(theta, core)

    def loss(theta: np.ndarray) -> float:
        cdf = growth_cdf(edges, noise, *natural(theta))
        return -float(counts @ np.log(np.maximum(np.diff(np.concatenate([[0.0], cdf, [1.0]])), 1e-12)))

    excess = growth[growth > middle + 6 * core] - middle
    rate = max(float(excess.mean()) if len(excess) > 10 else 10 * core, core)
    share = float(np.clip(len(excess) / len(growth), 1e-5, 0.1))
    theta = np.array([middle / core, np.log(0.2), np.log(share / (MOST_HOT - share)), np.log(rate / core)])
    theta = _least(loss, theta)
    if len(excess) >= FEWEST_IN_TAIL:
        theta = _with_tail(loss, theta)
    cool = _refit(loss, np.append(theta[:2], [COOL, theta[3]]), 2)
    found = natural(theta)
    there = len(excess) >= 10 and 2 * (loss(cool) - loss(theta)) >= SIGNIFICANT
    # Many pixels that are hardly warmer than the others are their tail, not hot pixels.
    if not there or found[3] < HOT_FROM * found[0] or found[2] > 0.95 * MOST_HOT:
        theta = cool
    values = np.array(natural(theta))
    units = np.array([core, values[1], values[2] * (1 - values[2] / MOST_HOT), values[3], values[4]])
    errors = np.append(_errors(loss, theta), np.full(5 - len(theta), np.inf)) * np.where(units > 0, units, 1.0)
    if len(theta) > 4 and theta[4] >= MOST_TAIL:
        errors[4] = 0.0  # held there
    if theta is cool:
        values[2:], errors[2:] = 0.0, np.inf
    alike = theta.copy()
    alike[1] = np.log(1e-3)
    if values[1] < LEAST_SPREAD or 2 * (loss(_refit(loss, alike, 1)) - loss(theta)) < SIGNIFICANT:
        values[1], errors[1] = 0.0, max(values[1], errors[1])
    return values, errors


def _with_tail(loss, theta: np.ndarray) -> np.ndarray:
    """The numbers with a tail heavier than exponential, if that is significant, else as they are."""
    heavy = _least(loss, np.append(theta, np.log(0.5)))
    return heavy if 2 * (loss(theta) - loss(heavy)) > SIGNIFICANT else theta


def _least(loss, theta: np.ndarray) -> np.ndarray:
    """The numbers with the lowest loss, starting from `theta`."""
    for _ in range(2):  # restarts, because the simplex may have shrunk too early
        theta = minimize(loss, theta, method="Nelder-Mead", options={"maxiter": 800, "xatol": 1e-4, "fatol": 0.02}).x
    return theta


def _natural(theta: np.ndarray, core: float) -> tuple[float, ...]:
    """Mean, spread, fraction, rate and tail from unconstrained numbers in units of the core's width."""
    fraction = MOST_HOT / (1 + np.exp(-np.clip(theta[2], -40, 40)))
    rate = core * float(np.exp(np.clip(theta[3], -12, 12)))
    tail = float(np.exp(np.clip(theta[4], -4, MOST_TAIL))) if len(theta) > 4 else 0.0
    return core * max(float(theta[0]), 1e-3), float(np.exp(np.clip(theta[1], -12, 1.2))), float(fraction), rate, tail


def _refit(loss, theta: np.ndarray, held: int) -> np.ndarray:
    """The numbers with the lowest loss, one of them fixed."""
    free = [i for i in range(len(theta)) if i != held]

    def whole(some: np.ndarray) -> np.ndarray:
        out = theta.copy()
        out[free] = some
        return out

    options = {"maxiter": 400, "fatol": 0.05}
    return whole(minimize(lambda some: loss(whole(some)), theta[free], method="Nelder-Mead", options=options).x)


def _errors(loss, theta: np.ndarray) -> np.ndarray:
    """Standard errors from the curvature of the loss; infinite where it is flat."""
    n, step = len(theta), 0.02
    hessian = np.empty((n, n))
    unit = step * np.eye(n)
    for i in range(n):
        for j in range(i, n):
            parts = [loss(theta + a * unit[i] + b * unit[j]) for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))]
            hessian[i, j] = hessian[j, i] = (parts[0] - parts[1] - parts[2] + parts[3]) / (4 * step**2)
    values, vectors = np.linalg.eigh(hessian)
    variance = (vectors**2 / np.maximum(values, 1e-9)) @ np.ones(n)
    return np.sqrt(np.minimum(variance, 1e6))


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
    width = WINSOR_SIGMAS * 1.4826 * float(np.median(np.abs(values)))
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
    scatter = 1.4826 * float(np.median(np.abs(extra / growth - ratio))) / np.sqrt(len(growth))
    return (ratio * rate, scatter * rate) if ratio > 3 * scatter else (0.0, scatter * rate)
