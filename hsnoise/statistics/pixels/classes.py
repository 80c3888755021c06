"""Classes of pixels by the growth of their dark level: chosen in one half of the frames, measured in the other.

With the same frames for both, or classes by level instead of growth, chance and offsets would affect class and
measurement alike, and the gain would come out 15 to 55 % low.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hsnoise._core.robust import robust_sigma
from hsnoise.statistics.pixels.clipping import unclipped
from hsnoise.statistics.pixels.survey import Survey

BODY = (0.0, 0.02, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95)  # quantiles that bound the classes of ordinary pixels
TAIL = (0.98, 0.99, 0.995, 0.998, 0.999, 0.9995, 0.9998, 0.9999)
FEWEST_ALIVE = 200  # pixels of a colour that is not dead
FEWEST_PIXELS = 20  # of a class
FAR_FRAME, MANY_FRAMES = 5.0, 6  # deviations of an odd frame; frames that suffice to know their own scatter
JUMPS = 6.0  # chi2 per degree of freedom of levels over exposure above which pedestals jump
FEWEST_FRAMES = 3  # of an exposure that can be halved
OUTLIER_SIGMAS = 6.0  # deviations beyond which half of a pixel's frames contain a cosmic hit or a telegraph jump
LEAST_SCALE_DN = 0.5
MANY_PIXELS = 500  # of a class that are enough to know its scatter
FILLED = 0.7  # of full scale: above it the response may bend
HOT_TIMES, HOT_SIGMAS = 3.0, 6.0  # times the median growth, and its scatter by chance: beyond both a pixel is hot
NEAR_ZERO_SIGMAS = 4.0  # above 0 counts: from here on clipping does not reduce the noise


@dataclass(frozen=True)
class Classes:
    """Level and temporal variance of classes of pixels in the dark exposures of one channel.

    Classes chosen in the even frames and measured in the odd ones come first, then the reverse.

    Attributes:
        exposure_s [exposure]: of the dark exposures with at least two frames.
        level_dn, variance_dn2, error_dn2 [class, exposure]: mean, mean temporal variance, its standard error; error is
            infinite where a class is clipped, too bright, or has too few pixels.
        pixels [class]: number of pixels.
        hot [class]: whether it grows faster than ordinary pixels.
        limit_dn_per_s: growth above which pixels are hot.
        pedestal_sigma_dn [exposure]: standard error of an exposure's common level, from its frames.
        outlier_share [exposure]: share of the pixels that were set aside for an outlier.
    """

    exposure_s: np.ndarray
    level_dn: np.ndarray
    variance_dn2: np.ndarray
    error_dn2: np.ndarray
    pixels: np.ndarray
    hot: np.ndarray
    limit_dn_per_s: float
    pedestal_sigma_dn: np.ndarray
    outlier_share: np.ndarray

    @property
    def growth_dn_per_s(self) -> np.ndarray:
        """Growth of the level of each class [class], in the measuring frames, DN/s."""
        return slope_over(self.exposure_s, self.level_dn.T)


class Levels(NamedTuple):
    """Every sampled pixel of a channel in the dark exposures; see `Halves`. [exposure, half, pixel], [exposure].

    noisy [half, pixel]: which look in half of the frames as if they jumped.
    """

    exposure_s: np.ndarray
    level: np.ndarray
    variance: np.ndarray
    peak: np.ndarray
    whole_variance: np.ndarray
    n_frames: np.ndarray
    pedestal_sigma_dn: np.ndarray
    noisy: np.ndarray

    @property
    def is_calm(self) -> np.ndarray:
        """Which pixels do not look noisy in both halves [pixel]."""
        return np.logical_not(np.all(self.noisy, axis=0))

    def calm(self) -> Levels:
        """Of the calm pixels."""
        if self.is_calm.all():
            return self
        names = "level", "variance", "peak", "whole_variance", "noisy"
        return self._replace(**{name: getattr(self, name)[..., self.is_calm] for name in names})


def levels_of(found: Survey, channel: int, noisy: np.ndarray | None = None) -> Levels | None:
    """The sampled pixels of one channel that are not stuck; None without two dark exposures of two frames.

    noisy: which look in half of the frames as if they jumped [half, pixel].
    """
    groups = found.repeated_darks
    t = np.array([g.exposure_s for g in groups])
    if len(groups) < 2 or np.ptp(t) == 0:
        return None
    moving = ~found.stuck(channel)
    if moving.sum() < FEWEST_ALIVE:
        return None
    level, variance, peak, whole = (
        np.stack([g.pixels(channel, name)[..., moving] for g in groups])
        for name in ("level_dn", "variance_dn2", "peak_dn", "pair_variance_dn2")
    )
    sigma = _pedestal_sigmas([np.mean([p.halves.frame_means_dn for p in g.of(channel)], axis=0) for g in groups])
    sigma = _off_the_line(t, np.median(level, axis=(1, 2)), sigma)
    noisy = np.zeros((2, int(moving.sum())), bool) if noisy is None else noisy[:, moving]
    return Levels(t, level, variance, peak, whole, np.array([g.n_frames for g in groups]), sigma, noisy)


def is_hot(found: Survey, channel: int) -> np.ndarray:
    """Which sampled pixels of a channel grow faster than ordinary ones in both halves of the frames [pixel]."""
    stuck = found.stuck(channel)
    hot, pixels = np.zeros(len(stuck), bool), levels_of(found, channel)
    if pixels is not None:
        growth = slope_over(pixels.exposure_s, pixels.level)
        hot[~stuck] = growth.min(0) > hot_from(growth)
    return hot


def classes_of(pixels: Levels, full_scale_dn: float) -> Classes:
    """The classes of the pixels of one channel."""
    t = pixels.exposure_s
    growth = slope_over(t, pixels.level)
    limit = hot_from(growth)
    if pixels.n_frames.min() >= FEWEST_FRAMES:
        measuring = [half for half in (0, 1) if pixels.n_frames.min() >= 3 + half]  # two frames at least
        both = [_half(pixels, of) for of in (0, 1)]
        parts = [
            _measured(
                _members(growth[1 - half], _edges(growth[1 - half], limit, True)),
                both[half],
                both[1 - half],
                t,
                (pixels.n_frames + 1 - half) // 2 - 1,
                full_scale_dn,
            )
            for half in measuring
        ]
        grown = [growth[1 - half] for half in measuring]
    else:
        # Differences are independent of the mean of the same frames; ordinary pixels are one class.
        mean = growth.mean(0)
        few = pixels.n_frames[:, None] < 4  # with so few frames one deviation can be all of the variance
        peak = np.sqrt(np.maximum(pixels.whole_variance, 0) * (pixels.n_frames[:, None] - 1))
        peak = np.where(few, peak, pixels.peak.max(1))
        members = _members(mean, _edges(mean, limit, False))
        whole = _Half(pixels.level.mean(1), pixels.whole_variance, peak, pixels.noisy.all(0))
        parts = [_measured(members, whole, whole, t, pixels.n_frames - 1, full_scale_dn)]
        grown = [mean]
    level, variance, error, count, apart = (np.concatenate(x) for x in zip(*[p[:-1] for p in parts], strict=True))
    hot = np.concatenate([[g[m].mean() > limit for m in p[-1]] for g, p in zip(grown, parts, strict=True)])
    share = apart.sum(0) / max(count.sum(), 1)
    return Classes(t, level, variance, error, count, hot.astype(bool), limit, pixels.pedestal_sigma_dn, share)


def _half(pixels: Levels, half: int) -> _Half:
    frames = (pixels.n_frames + 1 - half) // 2
    own = np.sqrt(1 - 1 / np.maximum(frames, 2))[:, None].astype(pixels.peak.dtype)
    return _Half(pixels.level[:, half], pixels.variance[:, half], pixels.peak[:, half] / own, pixels.noisy[half])


def least_hit(sigma_dn: np.ndarray, n_frames: np.ndarray) -> np.ndarray:
    """Charge of single frames from which a pixel is left out [class, exposure], DN; less counts as its noise.

    sigma_dn [class, exposure]: of its class. n_frames [exposure]: of which half measure.
    """
    return OUTLIER_SIGMAS * sigma_dn / np.sqrt(1 - 1 / np.maximum(n_frames / 2, 2))


def slope_over(exposure_s: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Growth of levels [exposure, ...] with exposure, DN/s, by least squares."""
    centred = exposure_s - exposure_s.mean()
    growth = np.zeros(np.shape(level)[1:])
    for weight, of in zip(centred / (centred @ centred), level, strict=True):
        growth += weight * of  # one exposure after the other: no copy of all in double precision
    return growth


def hot_from(growth: np.ndarray) -> float:
    """Growth [half, pixel] beyond which a pixel is called hot, in DN/s.

    Ordinary dark current comes from many weak generation centres in each pixel; hot pixels hold a strong one.
    """
    median = float(np.median(growth))
    return max(HOT_TIMES * median, median + HOT_SIGMAS * growth_noise(growth))


def growth_noise(growth: np.ndarray) -> float:
    """Standard deviation by chance of a pixel's growth in one half of the frames, DN/s; growth [half, pixel]."""
    apart = growth[0] - growth[1]
    return robust_sigma(apart - np.median(apart)) / np.sqrt(2)


def _pedestal_sigmas(offsets: list[np.ndarray]) -> np.ndarray:
    """Standard error of the common level of each exposure, DN: the scatter of its frames' levels, or their drift.

    The scatter is pooled over exposures, because each has few frames; outlying frames do not count.
    """
    near, scatter = [], []
    for of in offsets:
        off = np.abs(of - np.median(of))
        near.append(of[off <= FAR_FRAME * robust_sigma(off)] if len(of) > 3 else of)
        scatter.append(near[-1].var(ddof=1) if len(near[-1]) > 1 else 0.0)
    dof = np.array([len(of) - 1 for of in near])
    pooled = float(dof @ scatter / max(dof.sum() - 2, 1))  # for few frames, as wide as Student's t
    found = []
    for of, own in zip(offsets, scatter, strict=True):
        half = len(of) // 2
        drift = abs(float(np.median(of[:half]) - np.median(of[half:]))) / 2 if half > 1 else 0.0
        variance = max(pooled, own if len(of) >= MANY_FRAMES else 0.0)
        # By noise alone, the halves of n frames differ by 2 deviations over the root of n.
        found.append(np.hypot(np.sqrt(variance / len(of)), max(drift - 2 * np.sqrt(variance / len(of)), 0.0)))
    return np.array(found)


def _off_the_line(exposure_s: np.ndarray, level: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """The errors of levels [exposure], widened where the levels do not follow a non-falling straight line of exposure.

    In that case pedestals jump between exposures. The shortest keeps its error: shifts are relative to it.
    """
    weight = 1 / np.maximum(sigma, 1e-6)
    design = np.stack([np.ones_like(exposure_s), exposure_s], 1) * weight[:, None]
    for columns in (design, design[:, :1]):
        theta, *_ = np.linalg.lstsq(columns, level * weight, rcond=None)
        if theta[-1] >= 0:
            break
    dof = len(set(exposure_s)) - len(theta)
    chi2 = float((((level * weight) - columns @ theta) ** 2).sum()) / max(dof, 1)
    jumps = (dof > 0 and chi2 > JUMPS) & (exposure_s > exposure_s.min())
    return sigma * np.where(jumps, np.sqrt(chi2), 1.0)


def _edges(growth: np.ndarray, limit: float, of_body: bool) -> np.ndarray:
    """Lower edges of the classes: quantiles, and the limit of hot pixels, which no class straddles."""
    tail = tuple(q for q in TAIL if len(growth) * (1 - q) > 2 * FEWEST_PIXELS)
    edges = np.quantile(growth, (BODY if of_body else BODY[:1]) + tail)
    if not of_body:
        edges = np.append(edges[:1], edges[1:][edges[1:] > limit])
    if growth.max() > limit:
        edges = np.append(edges[np.abs(edges - limit) > 0.02 * abs(limit)], limit)
    return np.unique(edges)


def _members(growth: np.ndarray, edges: np.ndarray) -> list[np.ndarray]:
    """Indices of the pixels in each class, without classes of few pixels."""
    number = np.searchsorted(edges, growth, side="right")
    order = np.argsort(number, kind="stable")
    bounds = np.flatnonzero(np.diff(number[order])) + 1
    return [inside for inside in np.split(order, bounds) if len(inside) >= FEWEST_PIXELS]


class _Half(NamedTuple):
    """Every pixel in half of the frames, [exposure, pixel]; see `Halves`.

    peak: largest deviation from the mean, in units of the deviation that it has of the mean of so few frames.
    noisy [pixel]: whether it looks as if it jumped.
    """

    level: np.ndarray
    variance: np.ndarray
    peak: np.ndarray
    noisy: np.ndarray


def _measured(members: list[np.ndarray], found: _Half, other: _Half, t: np.ndarray, dof, full_scale_dn: float):
    """Level, variance, its error [class, exposure], pixels [class], outliers [class, exposure]; the members.

    found, other: in the measuring and in the choosing frames. dof [exposure]: degrees of freedom of a pixel's variance.
    """
    level, variance = found.level, found.variance
    size = (len(members), len(level))
    mean, spread, error, apart = np.zeros(size), np.ones(size), np.full(size, np.inf), np.zeros(size)
    ordinary = np.median(level, axis=1)
    floor = np.median(variance, axis=1)
    scatter, exposures = _level_scatter(members, level, other.level, t), range(len(level))
    for c, inside in enumerate(members):
        bright = (other.level[:, inside] - ordinary[:, None]).astype(np.float64)
        kept, outliers = _calm(
            _Half(*(of[..., inside] for of in found)), _Half(*(of[..., inside] for of in other)), bright
        )
        apart[c] = outliers.sum(1)
        for e in exposures:
            v, y = variance[e, inside].astype(np.float64), level[e, inside].astype(np.float64)
            mean[c, e] = y[kept].mean() if kept.any() else y.mean()
            if kept.sum() < FEWEST_PIXELS or np.quantile(y, 0.999) > FILLED * full_scale_dn:
                continue
            spread[c, e] = v[kept].mean()
            if spread[c, e] <= 0:
                spread[c, e] = 1.0
                continue
            error[c, e] = _chance_error(v[kept], bright[e, kept], floor[e], dof[e])
            if np.quantile(y, 0.001) < NEAR_ZERO_SIGMAS * np.sqrt(spread[c, e]):
                mean[c, e], spread[c, e], growth = unclipped(mean[c, e], spread[c, e], scatter[c, e])
                error[c, e] *= growth
    lost = ~np.isfinite(mean)
    mean[lost], spread[lost] = 0.0, 1.0
    return mean, spread, error, np.array([len(m) for m in members], float), apart, members


def _calm(found: _Half, other: _Half, bright: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which pixels of a class count [pixel], the same at all exposures, and which are outliers [exposure, pixel].

    Pixels that are noisy in the choosing frames do not count: without signal they are outliers, beside its noise they
    are not, and the signal would seem to have made theirs. In the measuring frames only those do not that are far off
    for the pixel itself: a cut that is closer at some exposures than at others would do the same.

    bright [exposure, pixel]: level above that of ordinary pixels, in the choosing frames.
    """
    limit = OUTLIER_SIGMAS * np.stack([_expected_scale(v, of) for v, of in zip(found.variance, bright, strict=True)])
    own = np.sqrt(np.maximum(np.nan_to_num(other.variance), 0))  # NaN of single frames
    apart = found.peak >= np.maximum(limit, OUTLIER_SIGMAS * own)
    kept = (other.peak < limit) & ~apart
    return kept.all(0) & ~other.noisy, apart


def _chance_error(variance: np.ndarray, excess: np.ndarray, floor: float, dof: int) -> float:
    """Standard error of the mean variance of a class [pixel] by chance.

    In a small class a mean that is low by chance also scatters less and would get more weight, so its error is that of
    normal noise of the class's mean. Brighter pixels (excess [pixel], in the other frames) are noisier.
    """
    if len(variance) > MANY_PIXELS:
        return float(variance.std(ddof=1) / np.sqrt(len(variance)))
    mean, share = float(variance.mean()), excess / max(float(excess.mean()), 1e-9)
    each = np.maximum(floor + (mean - floor) * share, 0.1 * mean) if mean > 2 * floor else np.full(1, mean)
    square = float((each.astype(np.float64) ** 2).mean())
    return float(np.sqrt(2 * square / (max(dof, 1) * len(variance))))


def _expected_scale(variance: np.ndarray, excess: np.ndarray) -> np.ndarray:
    """Expected temporal deviation of each pixel of a class [pixel]: brighter pixels are noisier.

    excess [pixel]: level above that of ordinary pixels, in other frames.
    """
    middle = max(float(np.median(excess)), 1e-6)
    brighter = np.maximum(excess / middle, 1.0) if middle > LEAST_SCALE_DN else 1.0
    usual = max(float(np.median(variance)), 0.0)  # saturated pixels may fall below 0 after subtraction
    return np.maximum(np.sqrt(usual * np.broadcast_to(brighter, excess.shape)), LEAST_SCALE_DN)


def _level_scatter(members: list[np.ndarray], level, other, t) -> np.ndarray:
    """Standard deviation of the levels of the pixels of each class at each exposure [class, exposure], DN.

    Large classes are measured. Small classes take the offsets of the largest, and the spread of growth from their
    brightest exposure.
    """
    measured = np.array([[_scatter(one[m], of[m]) for one, of in zip(level, other, strict=True)] for m in members])
    count = np.array([len(m) for m in members])
    brightest, shortest = int(np.argmax(level.mean(1))), int(np.argmin(t))
    offsets = measured[int(np.argmax(count)), shortest]
    of_growth = np.maximum(measured[:, brightest] ** 2 - offsets**2, 0)
    share = (t / max(t[brightest], 1e-30)) ** 2
    scaled = np.sqrt(offsets**2 + of_growth[:, None] * share)
    return np.where(count[:, None] > MANY_PIXELS, measured, scaled)


def _scatter(one: np.ndarray, other: np.ndarray) -> float:
    """Standard deviation of the levels of pixels [pixel], from two halves of the frames."""
    a, b = one.astype(np.float64), other.astype(np.float64)
    return float(np.sqrt(max(((a - a.mean()) * (b - b.mean())).mean(), 0.0)))
