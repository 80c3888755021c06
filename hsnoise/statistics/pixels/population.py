"""How pixels differ: the distributions of dark current and offsets over pixels, without the noise of estimation.

Dark current is modelled like the effects that draw it: log-normal, or of a generalised gamma distribution where it is
skewed more or less (`dark_current_nonuniformity`), and an exponential extra in a fraction of pixels (`hot_pixels`),
whose mean may be log-normal as well. It is fitted to the measured growth of all pixels by maximum likelihood, with the
known noise of a pixel's growth as part of the distribution. Offsets are normal; their variance is the covariance of two
halves of the frames, which noise does not enter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import erfcx, ndtr

from hsnoise._core.quadrature import normal_nodes
from hsnoise.statistics.pixels.classes import Levels, growth_noise, slope_over
from hsnoise.statistics.pixels.sample import of_neighbours

Loss = Callable[[np.ndarray], float]

SKEW, FRACTION, HOT_SPREAD = 2, 3, 5  # places in the vector of numbers that is fitted
ABSENT, STARTS = np.nan, {SKEW: (0.5, -0.5), HOT_SPREAD: (np.log(0.5),)}
QUICK = (400,)  # iterations
FEWEST_IN_TAIL = 100  # hot pixels from which the shape of their distribution is fitted
HOT_NODES, MOST_HOT_SPREAD = 12, 0.9  # of the means of hot pixels; largest logarithm of their spread
NODES = 48  # over the log-normal distribution, or over the noise if that is narrower
LOGS = np.linspace(-30.0, 30.0, 1201)  # of skewed dark currents, in units of their spread
MOST_SKEW, MOST_TAIL = 2.0, 0.45  # of either sign; skew times spread: the variance is infinite from 0.5 on
LEAST_WEIGHT = 1e-9  # of nodes that count
AS_NORMAL, LEAST_SKEW = 0.01, 0.1  # below which the logarithm is normal; which counts
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
        values[3:], errors[3:] = 0.0, np.inf
    body, spread, skew, fraction, rate, hot_spread = values
    below = float(growth[growth < limit - pedestal_dn_per_s].mean())
    beyond = 0.0
    if fraction > 0:
        # The log-normal tail above the limit belongs to the ordinary pixels; hot pixels below it do not.
        beyond = body - _mean_below(limit - pedestal_dn_per_s - fallen, noise, values)
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
        offset_sigma=offset_sigma(pattern, _width(spread, skew) * body * shortest, low_side_dn),
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


def _mean_below(limit: float, noise: float, values: np.ndarray) -> float:
    """Mean measured growth of the pixels below a limit, under the fitted distribution."""
    x = np.linspace(min(-8 * noise, limit - 1e-9), limit, 400)
    cdf = growth_cdf(x, noise, *values)
    return float(limit - np.trapezoid(cdf, x) / max(cdf[-1], 1e-12))


def growth_cdf(
    x: np.ndarray,
    noise: float,
    mean: float,
    spread: float,
    skew: float,
    fraction: float,
    rate: float,
    hot_spread: float = 0.0,
) -> np.ndarray:
    """Share of pixels whose measured growth is below x: ordinary ones, plus exponential in a fraction, plus noise.

    spread, skew: of ln growth; hot_spread: standard deviation of ln of the hot pixels' mean.
    """
    width = mean * _width(spread, skew)
    plain = (_wide_noise if noise > WIDE * width else _narrow_noise)(x, noise, mean, spread, skew)
    if fraction <= 0:
        return plain
    # Next to so wide an extra, the ordinary part of hot pixels can be taken as normal.
    width = float(np.hypot(noise, width))
    z, weight = normal_nodes(HOT_NODES) if hot_spread > 0 else (np.zeros(1), np.ones(1))
    off = (x[:, None] - mean) / width
    warm = ndtr(off) - _exponential_share(off, width / (rate * np.exp(hot_spread * z - hot_spread**2 / 2)))
    return (1 - fraction) * plain + fraction * (warm @ weight)


def _wide_noise(x: np.ndarray, noise: float, mean: float, spread: float, skew: float) -> np.ndarray:
    """Share of ordinary pixels below x, by nodes over their dark currents."""
    if skew == 0:
        z, weight = normal_nodes(NODES)
        body = np.exp(spread * z - spread**2 / 2)
    else:
        there = (weight := _of_logs(skew)) > LEAST_WEIGHT
        body, weight = np.exp(spread * LOGS[there]), weight[there] / weight[there].sum()
        body /= weight @ body
    return ndtr((x[:, None] - mean * body) / noise) @ weight


def _narrow_noise(x: np.ndarray, noise: float, mean: float, spread: float, skew: float) -> np.ndarray:
    """The same by nodes over the noise: narrow noise would leave steps between those over the dark currents."""
    z, weight = normal_nodes(NODES)
    logs = np.log(np.maximum(x[:, None] - noise * z, 1e-300) / mean) / spread
    if skew == 0:
        return ndtr(logs + spread / 2) @ weight
    of_logs = _of_logs(skew)
    below = np.cumsum(of_logs) - of_logs / 2
    return np.interp(logs + np.log(of_logs @ np.exp(spread * LOGS)) / spread, LOGS, below) @ weight


def _of_logs(skew: float) -> np.ndarray:
    """Probability of each of LOGS: those of the logarithm of a gamma number of shape 1 / skew^2, standardised.

    Reference: Prentice, "A log gamma model and its maximum likelihood estimation", Biometrika 61, 1974 (q = -skew).
    """
    shape, logs = skew**-2, -skew * LOGS
    density = np.exp(shape * (logs - np.expm1(np.minimum(logs, 50.0))))
    return density / density.sum()


def _width(spread: float, skew: float) -> float:
    """Standard deviation of the dark current of ordinary pixels, relative to its mean."""
    if skew == 0:
        return float(np.sqrt(np.expm1(spread**2)))
    of_logs, body = _of_logs(skew), np.exp(spread * LOGS)
    return float(np.sqrt(max(of_logs @ body**2 / (of_logs @ body) ** 2 - 1, 0.0)))


def _exponential_share(off: np.ndarray, ratio: float | np.ndarray) -> np.ndarray:
    """How much an exponential extra of mean noise / `ratio` lowers the normal distribution function at `off`."""
    # exp(ratio^2 / 2 - ratio off) ndtr(off - ratio), without overflow.
    inner = (ratio - off) / np.sqrt(2)
    low = 0.5 * np.exp(-0.5 * off**2) * erfcx(np.maximum(inner, -25.0))
    return np.where(inner > -25.0, low, np.exp(np.minimum(ratio**2 / 2 - ratio * off, 0.0)))


def _fitted(growth: np.ndarray, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """(mean, spread, skew, fraction, rate, hot spread) of the growth [pixel], and errors; zeros for what is not
    significant."""
    middle = float(np.median(growth))
    core = 1.4826 * float(np.median(np.abs(growth - middle)))
    if core <= 0:
        return np.array([max(middle, 0.0), *np.zeros(5)]), np.full(6, np.inf)
    far = max(growth.max() - middle, 12 * core)
    edges = middle + np.append(np.linspace(-6 * core, 6 * core, CORE_BINS), np.geomspace(6.2 * core, far, TAIL_BINS))
    counts = np.histogram(growth, np.concatenate([[-np.inf], edges, [np.inf]]))[0]

    def natural(theta: np.ndarray) -> tuple[float, ...]:
        if middle <= 0:  # ordinary pixels have no dark current that could differ
            theta = np.array([0.0, np.log(1e-3), ABSENT, *theta[3:]])
        return _natural(theta, core)

    def loss(theta: np.ndarray) -> float:
        cdf = growth_cdf(edges, noise, *natural(theta))
        return -float(counts @ np.log(np.maximum(np.diff(np.concatenate([[0.0], cdf, [1.0]])), 1e-12)))

    excess = growth[growth > middle + 6 * core] - middle
    rate = max(float(excess.mean()) if len(excess) > 10 else 10 * core, core)
    share = float(np.clip(len(excess) / len(growth), 1e-5, 0.1))
    start = [middle / core, np.log(0.2), ABSENT, np.log(share / (MOST_HOT - share)), np.log(rate / core), ABSENT]
    shapes = [SKEW] * (middle > 0) + [HOT_SPREAD] * (len(excess) >= FEWEST_IN_TAIL)
    theta = _likeliest(loss, np.array(start), shapes)
    cool = np.append(theta[:SKEW], [ABSENT, COOL, theta[4], ABSENT])
    cool = _likeliest(loss, cool, shapes[: middle > 0], (FRACTION, 4))
    found = natural(theta)
    there = len(excess) >= 10 and 2 * (loss(cool) - loss(theta)) >= SIGNIFICANT
    # Many pixels that are hardly warmer than the others are their tail, not hot pixels.
    if not there or found[4] < HOT_FROM * found[0] or found[3] > 0.95 * MOST_HOT:
        theta = cool
    values = np.array(natural(theta))
    units = np.array([core, values[1], 1.0, values[3] * (1 - values[3] / MOST_HOT), values[4], values[5]])
    errors = _errors(loss, theta) * np.where(units > 0, units, 1.0)
    if theta[HOT_SPREAD] >= MOST_HOT_SPREAD:
        errors[HOT_SPREAD] = 0.0  # held there
    if theta is cool:
        values[3:], errors[3:] = 0.0, np.inf
    alike = _least(loss, np.array([theta[0], np.log(1e-3), ABSENT, *theta[3:]]), (1,), QUICK)
    if (values[1] < LEAST_SPREAD and values[2] == 0) or 2 * (loss(alike) - loss(theta)) < SIGNIFICANT:
        values[1:3], errors[1:3] = 0.0, np.maximum(values[1:3], errors[1:3])
    return values, errors


def _likeliest(loss: Loss, plain: np.ndarray, shapes: list[int], held: tuple[int, ...] = ()) -> np.ndarray:
    """The numbers that are likeliest, with those of `shapes` that make them significantly likelier.

    A small skew is left out: the noise of growth, which is larger where growth is, makes one of 0.04.
    """
    found = [_least(loss, plain, held)]
    for of in shapes:
        starts = [np.where(np.arange(len(plain)) == of, start, theta) for theta in found for start in STARTS[of]]
        found += [_least(loss, theta, held) for theta in starts]
    found = [theta for theta in found if not abs(theta[SKEW]) < LEAST_SKEW]
    return min(found, key=lambda theta: 2 * loss(theta) + SIGNIFICANT * len(_free(theta)))


def _least(
    loss: Loss, theta: np.ndarray, held: tuple[int, ...] = (), iterations: tuple[int, ...] = (800, 800)
) -> np.ndarray:
    """The numbers with the lowest loss, starting from `theta`.

    iterations: of each restart, because the simplex may have shrunk too early.
    """
    free = [i for i in _free(theta) if i not in held]

    def whole(some: np.ndarray) -> np.ndarray:
        out = theta.copy()
        out[free] = some
        return out

    for most in iterations:
        options = {"maxiter": most, "xatol": 1e-4, "fatol": 0.02}
        theta = whole(minimize(lambda some: loss(whole(some)), theta[free], method="Nelder-Mead", options=options).x)
    return theta


def _free(theta: np.ndarray) -> list[int]:
    """Which numbers are there."""
    return list(np.flatnonzero(~np.isnan(theta)))


def _natural(theta: np.ndarray, core: float) -> tuple[float, ...]:
    """Mean, spread, skew, fraction, rate and hot spread from unconstrained numbers in units of the core's width."""
    fraction = MOST_HOT / (1 + np.exp(-np.clip(theta[FRACTION], -40, 40)))
    rate = core * float(np.exp(np.clip(theta[4], -12, 12)))
    spread = float(np.exp(np.clip(theta[1], -12, 1.2)))
    skew = 0.0 if np.isnan(theta[SKEW]) else float(np.clip(theta[SKEW], -MOST_SKEW, min(MOST_SKEW, MOST_TAIL / spread)))
    hot_spread = 0.0 if np.isnan(theta[HOT_SPREAD]) else float(np.exp(min(theta[HOT_SPREAD], MOST_HOT_SPREAD)))
    skew = 0.0 if abs(skew) < AS_NORMAL else skew
    return core * max(float(theta[0]), 1e-3), spread, skew, float(fraction), rate, hot_spread


def _errors(loss: Loss, theta: np.ndarray) -> np.ndarray:
    """Standard errors from the curvature of the loss; infinite where it is flat, and of numbers that are not there."""
    free, step = _free(theta), 0.02
    n, out = len(free), np.full(len(theta), np.inf)
    hessian = np.empty((n, n))
    unit = step * np.eye(len(theta))[free]
    for i in range(n):
        for j in range(i, n):
            parts = [loss(theta + a * unit[i] + b * unit[j]) for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))]
            hessian[i, j] = hessian[j, i] = (parts[0] - parts[1] - parts[2] + parts[3]) / (4 * step**2)
    values, vectors = np.linalg.eigh(hessian)
    variance = (vectors**2 / np.maximum(values, 1e-9)) @ np.ones(n)
    out[free] = np.sqrt(np.minimum(variance, 1e6))
    return out


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
