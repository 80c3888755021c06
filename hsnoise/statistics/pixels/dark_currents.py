"""The law of dark current over pixels, and its fit to what was measured with noise.

Dark current is modelled like the effects that draw it: log-normal, or of a generalised gamma distribution where it is
skewed more or less (`dark_current_nonuniformity`), and an exponential extra in a fraction of pixels (`hot_pixels`),
whose mean may be log-normal as well. It is fitted to the measured growth of all pixels by maximum likelihood, with the
known noise of a pixel's growth as part of the distribution.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.special import erfcx, kl_div, ndtr

from hsnoise._core.quadrature import normal_nodes
from hsnoise._core.robust import robust_sigma

Residuals = Callable[[np.ndarray], np.ndarray]

SKEW, FRACTION, HOT_SPREAD = 2, 3, 5  # places in the vector of numbers that is fitted
ABSENT, STARTS = np.nan, {SKEW: (0.5, -0.5), HOT_SPREAD: (np.log(0.5),)}
SEARCH = {"x_scale": "jac", "diff_step": 1e-4, "ftol": 1e-7, "xtol": 1e-6, "gtol": None, "max_nfev": 60}
LOOSE = 1e-3  # weight with which numbers stay where they start: some tell nothing, as a skew beyond its bounds
FEWEST_IN_TAIL = 100  # hot pixels from which the shape of their distribution is fitted
HOT_NODES, MOST_HOT_SPREAD = 12, 0.9  # over hot pixels' means, and what others have; largest log of their spread
LEAST_NOISE = 1e-3  # over the width of ordinary pixels
LEAST_MEAN = 1e-3  # of ordinary pixels, over the width of all growth: with less they have no dark current
NODES = 48  # over the log-normal distribution, or over the noise if that is narrower
LOGS = np.linspace(-30.0, 30.0, 601)  # of skewed dark currents, in units of their spread
MOST_SKEW, MOST_TAIL = 2.0, 0.45  # of either sign; skew times spread: the variance is infinite from 0.5 on
LEAST_WEIGHT = 1e-9  # of nodes that count
AS_NORMAL, LEAST_SKEW = 0.01, 0.1  # below which the logarithm is normal; which counts
WIDE = 0.5  # of the log-normal width: noise above it counts as the wider one
CORE_BINS, TAIL_BINS = 120, 80
SIGNIFICANT = 15.0  # twice the rise in log-likelihood above which pixels differ in dark current
LEAST_SPREAD = 0.02
MOST_HOT, COOL = 0.3, -25.0  # largest share of hot pixels, and the logit that stands for none
HOT_FROM = 2.0  # mean extra of hot pixels, over the mean of the others


class Noise(NamedTuple):
    """Noise of the measured growth of a pixel: standard deviation without any, and variance per growth (shot noise)."""

    still: float
    per_growth: float = 0.0

    def at(self, growth: np.ndarray | float) -> np.ndarray | float:
        """Standard deviation."""
        return np.sqrt(self.still**2 + self.per_growth * np.maximum(growth, 0.0))


def growth_cdf(
    x: np.ndarray,
    noise: Noise,
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
    width = mean * relative_width(spread, skew)
    plain = (_wide_noise if noise.at(mean) > WIDE * width else _narrow_noise)(x, noise, mean, spread, skew)
    if fraction <= 0:
        return plain
    z, of_kind = normal_nodes(HOT_NODES) if hot_spread > 0 else (np.zeros(1), np.ones(1))
    body, of_body = _bodies(spread, skew)
    usual = max(float(noise.at(mean)), LEAST_NOISE * width, 1e-12)
    off = ((x[:, None] - mean * body) / usual)[:, :, None]
    warm = ndtr(off) - _exponential_share(off, usual / (rate * np.exp(hot_spread * z - hot_spread**2 / 2)))
    return (1 - fraction) * plain + fraction * ((warm @ of_kind) @ of_body)


def _bodies(spread: float, skew: float) -> tuple[np.ndarray, np.ndarray]:
    """The ordinary dark currents of hot pixels, over their mean, and weights: few, as the extra is wide."""
    z, weight = normal_nodes(HOT_NODES)
    if skew == 0:
        return np.exp(spread * z - spread**2 / 2), weight
    of_logs = _of_logs(skew)
    logs = np.interp(ndtr(z), np.cumsum(of_logs) - of_logs / 2, LOGS)
    return np.exp(spread * logs) / (of_logs @ np.exp(spread * LOGS)), weight


def _wide_noise(x: np.ndarray, noise: Noise, mean: float, spread: float, skew: float) -> np.ndarray:
    """Share of ordinary pixels below x, by nodes over their dark currents."""
    if skew == 0:
        z, weight = normal_nodes(NODES)
        body = np.exp(spread * z - spread**2 / 2)
    else:
        there = (weight := _of_logs(skew)) > LEAST_WEIGHT
        body, weight = np.exp(spread * LOGS[there]), weight[there] / weight[there].sum()
        body /= weight @ body
    return ndtr((x[:, None] - mean * body) / noise.at(mean * body)) @ weight


def _narrow_noise(x: np.ndarray, noise: Noise, mean: float, spread: float, skew: float) -> np.ndarray:
    """The same by nodes over the noise: narrow noise would leave steps between those over the dark currents."""
    z, weight = normal_nodes(NODES)
    # Without noise the growth g that z of its standard deviations leave at x: g + z noise(g) = x.
    shift = noise.per_growth * z / 2
    still = x[:, None] + z * (shift - np.sqrt(np.maximum(noise.still**2 + noise.per_growth * x[:, None] + shift**2, 0)))
    logs = np.log(np.maximum(still, 1e-300) / mean) / spread
    if skew == 0:
        return ndtr(logs + spread / 2) @ weight
    of_logs = _of_logs(skew)
    below = np.cumsum(of_logs) - of_logs / 2
    return np.interp(logs + np.log(of_logs @ np.exp(spread * LOGS)) / spread, LOGS, below) @ weight


@lru_cache(maxsize=1)  # the width and the distribution of one skew follow each other
def _of_logs(skew: float) -> np.ndarray:
    """Probability of each of LOGS: those of the logarithm of a gamma number of shape 1 / skew^2, standardised.

    Reference: Prentice, "A log gamma model and its maximum likelihood estimation", Biometrika 61, 1974 (q = -skew).
    """
    shape, logs = skew**-2, -skew * LOGS
    density = np.exp(shape * (logs - np.expm1(np.minimum(logs, 50.0))))
    return density / density.sum()


def relative_width(spread: float, skew: float) -> float:
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


def fitted(growth: np.ndarray, noise: Noise) -> tuple[np.ndarray, np.ndarray]:
    """(mean, spread, skew, fraction, rate, hot spread) of the growth [pixel], and errors; zeros for what is not
    significant."""
    middle = float(np.median(growth))
    core = robust_sigma(growth - middle)
    if core <= 0:
        return np.array([max(middle, 0.0), *np.zeros(5)]), np.full(6, np.inf)
    is_dark = middle > LEAST_MEAN * core
    far = max(growth.max() - middle, 12 * core)
    edges = middle + np.append(np.linspace(-6 * core, 6 * core, CORE_BINS), np.geomspace(6.2 * core, far, TAIL_BINS))
    counts = np.histogram(growth, np.concatenate([[-np.inf], edges, [np.inf]]))[0]

    def natural(theta: np.ndarray) -> tuple[float, ...]:
        if not is_dark:  # ordinary pixels have no dark current that could differ
            theta = np.array([0.0, np.log(1e-3), ABSENT, *theta[3:]])
        return _natural(theta, core)

    def off(theta: np.ndarray) -> np.ndarray:
        """Deviance residuals: the sum of their squares is least where the likelihood is largest."""
        cdf = growth_cdf(edges, noise, *natural(theta))
        expected = len(growth) * np.maximum(np.diff(np.concatenate([[0.0], cdf, [1.0]])), 1e-12)
        return np.sign(counts - expected) * np.sqrt(2 * np.maximum(kl_div(counts, expected), 0.0))

    excess = growth[growth > middle + 6 * core] - middle
    rate = max(float(excess.mean()) if len(excess) > 10 else 10 * core, core)
    share = float(np.clip(len(excess) / len(growth), 1e-5, 0.1))
    plain = [middle / core, np.log(0.2), ABSENT, np.log(share / (MOST_HOT - share)), np.log(rate / core), ABSENT]
    start, of_body = np.array(plain), [SKEW] * is_dark
    of_hot = [HOT_SPREAD] * (len(excess) >= FEWEST_IN_TAIL)
    cool = np.append(start[:FRACTION], [COOL, start[4], ABSENT])
    cool = _likeliest(off, [cool], of_body, (FRACTION, 4))
    # Hot pixels beside the body as it is without them, too: a skew may stand for them, or they for it.
    theta = _likeliest(off, [start, np.append(cool[:FRACTION], start[FRACTION:])], of_body + of_hot)
    found = natural(theta)
    there = len(excess) >= 10 and _deviance(off, cool) - _deviance(off, theta) >= SIGNIFICANT
    # Many pixels that are hardly warmer than the others are their tail, not hot pixels.
    if not there or found[4] < HOT_FROM * found[0] or found[3] > 0.95 * MOST_HOT:
        theta = cool
    values = np.array(natural(theta))
    units = np.array([core, values[1], 1.0, values[3] * (1 - values[3] / MOST_HOT), values[4], values[5]])
    at_bound = not np.isnan(theta[SKEW]) and values[SKEW] != theta[SKEW]
    errors = _errors(off, theta, (SKEW,) if at_bound else ()) * np.where(units > 0, units, 1.0)
    if at_bound:
        errors[SKEW] = 0.0  # held there
    if theta[HOT_SPREAD] >= MOST_HOT_SPREAD:
        errors[HOT_SPREAD] = 0.0  # held there
    if theta is cool:
        values[3:], errors[3:] = 0.0, np.inf
    alike = _least(off, np.array([theta[0], np.log(1e-3), ABSENT, *theta[3:]]), (1,))
    if (values[1] < LEAST_SPREAD and values[2] == 0) or _deviance(off, alike) - _deviance(off, theta) < SIGNIFICANT:
        values[1:3], errors[1:3] = 0.0, np.maximum(values[1:3], errors[1:3])
    return values, errors


def _likeliest(off: Residuals, starts: list[np.ndarray], shapes: list[int], held: tuple[int, ...] = ()) -> np.ndarray:
    """The numbers that are likeliest, with those of `shapes` that make them significantly likelier.

    A small skew is left out: it is hardly ever real.
    """

    def misfit(theta: np.ndarray) -> float:
        return np.inf if abs(theta[SKEW]) < LEAST_SKEW else _deviance(off, theta) + SIGNIFICANT * len(_free(theta))

    found = [_least(off, start, held) for start in starts]
    for of in shapes:
        best = min(found, key=misfit)
        without = [theta for theta in found if np.isnan(theta[of]) and (theta is best or theta is found[0])]
        several = [(theta, value) for theta in without for value in STARTS[of]]
        found += [_least(off, np.where(np.arange(len(theta)) == of, value, theta), held) for theta, value in several]
    return min(found, key=misfit)


def _least(off: Residuals, theta: np.ndarray, held: tuple[int, ...] = ()) -> np.ndarray:
    """The likeliest numbers, starting from `theta`."""
    free = [i for i in _free(theta) if i not in held]

    def whole(some: np.ndarray) -> np.ndarray:
        out = theta.copy()
        out[free] = some
        return out

    def residuals(some: np.ndarray) -> np.ndarray:
        return np.append(off(whole(some)), LOOSE * (some - theta[free]))

    return whole(least_squares(residuals, theta[free], **SEARCH).x)


def _deviance(off: Residuals, theta: np.ndarray) -> float:
    """Twice the difference in log-likelihood from a perfect fit."""
    return float(np.sum(off(theta) ** 2))


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
    return core * max(float(theta[0]), LEAST_MEAN), spread, skew, float(fraction), rate, hot_spread


def _errors(off: Residuals, theta: np.ndarray, held: tuple[int, ...] = ()) -> np.ndarray:
    """Standard errors from the curvature of the likelihood; infinite where it is flat, and of numbers not there."""
    free, step = [i for i in _free(theta) if i not in held], 0.02
    n, out = len(free), np.full(len(theta), np.inf)
    hessian = np.empty((n, n))
    unit = step * np.eye(len(theta))[free]
    for i in range(n):
        for j in range(i, n):
            at = [theta + a * unit[i] + b * unit[j] for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))]
            parts = [_deviance(off, one) for one in at]
            hessian[i, j] = hessian[j, i] = (parts[0] - parts[1] - parts[2] + parts[3]) / (8 * step**2)
    values, vectors = np.linalg.eigh(hessian)
    variance = (vectors**2 / np.maximum(values, 1e-9)) @ np.ones(n)
    out[free] = np.sqrt(np.minimum(variance, 1e6))
    return out
