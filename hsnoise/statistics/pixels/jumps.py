"""Pixels that jump (random telegraph noise), from the variance, skewness and kurtosis of each pixel over time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import chi2

from hsnoise.statistics.pixels.classes import is_hot
from hsnoise.statistics.pixels.jump_search import Jumps, Moments, Search
from hsnoise.statistics.pixels.sample import median_share
from hsnoise.statistics.pixels.survey import Group, Survey

ALIKE = 1.15  # factor of the least typical variance up to which exposures have the same noise
RARE = 1e-2, 1e-5  # chance of a variance that high, in each half of the frames and in all
FEWEST_FRAMES, MOST_FRAMES = 8, 64  # of all exposures together
OF_AN_EXPOSURE = 4  # frames, at least
FEWEST, LEAST = 100, 3e-4  # pixels that jump visibly, and their share
TOGETHER = 2.0  # times as many noisy in both halves as by chance: heavy tails strike any pixel
MANY, ROUNDS = 0.1, 3  # share of pixels that move the median; how often it is corrected
SURE = 2.5  # standard errors of fraction and amplitude
FAILS, FAR_BETTER = 2.0, 0.6  # chi-square of normal noise per degree of freedom; how much of it jumps may leave


def jumps_of(found: Survey, channel: int) -> tuple[Jumps | None, np.ndarray]:
    """The jumping pixels of a channel, in DN, and which pixels look so in each half of the frames [half, pixel].

    None if there are few, or they may be noisier without jumping. Hot pixels, which have shot noise, do not count.
    """
    kept = ~(found.stuck(channel) | is_hot(found, channel))
    groups, jumping = _alike(found.repeated_darks, channel, kept), np.zeros((2, len(kept)), bool)
    frames = [group.n_frames for group in groups]
    if sum(frames) < FEWEST_FRAMES:
        return None, jumping
    dof = np.sum([np.array(group.of(channel)[0].halves.n_frames) - 1 for group in groups], axis=0)
    several, chances = np.append(dof, sum(frames) - len(frames)), np.array([RARE[0], RARE[0], RARE[1]])
    limits = chi2.isf(chances, several) / several
    pixels = _pooled(groups, channel, kept)
    is_noisy = pixels.is_noisy(limits)
    if is_noisy.sum() < max(FEWEST, LEAST * len(is_noisy), TOGETHER * pixels.by_chance(limits)):
        return None, jumping
    typical = float(np.mean([_typical(group, channel, kept) for group in groups]))
    best = _best(pixels, limits, frames, typical)
    if best is not None:
        jumping[:, kept] = pixels.look_noisy(limits)
    return best, jumping


def _best(pixels: Moments, limits: np.ndarray, frames: list[int], typical_dn2: float) -> Jumps | None:
    """The jumps that come nearest, unless normal noise of any strength comes as near."""
    noise_dn2 = typical_dn2
    for _ in range(ROUNDS):
        search = Search.of(pixels, limits, frames, noise_dn2)
        normal = search.misfit_of_normal()
        if normal < FAILS * search.normal.size:
            return None
        best, misfit = search.best()
        is_sure = all(value > SURE * error for value, error in (best.fraction, best.amplitude_dn))
        if not is_sure or misfit > FAR_BETTER * normal:
            return None
        if best.fraction[0] < MANY:
            break
        noise_dn2 = typical_dn2 / best.raises(_median, frames[0])  # the typical pixel is noisier by them
    return best


def _median(variances: np.ndarray) -> float:
    return float(np.median(variances))


def _typical(group: Group, channel: int, kept: np.ndarray) -> float:
    """Temporal variance of the typical pixel, DN^2; of few frames the median lies below it."""
    return float(np.median(group.pixels(channel, "pair_variance_dn2")[kept])) / median_share(group.n_frames)


def _alike(groups: Sequence[Group], channel: int, kept: np.ndarray) -> list[Group]:
    """Exposures with hardly more noise than the quietest, the shortest first."""
    typical = {i: _typical(g, channel, kept) for i, g in enumerate(groups) if g.n_frames >= OF_AN_EXPOSURE}
    chosen: list[Group] = []
    for i in sorted(typical, key=lambda i: groups[i].exposure_s):
        if typical[i] <= ALIKE * min(typical.values()) and sum(g.n_frames for g in chosen) < MOST_FRAMES:
            chosen.append(groups[i])
    return chosen


def _pooled(groups: Sequence[Group], channel: int, kept: np.ndarray) -> Moments:
    """Of the kept pixels over the frames of all exposures, in units of the typical pixel's."""
    several = []
    for group in groups:
        scale = max(_typical(group, channel, kept), 1e-6)
        names = ("pair_variance_dn2", "variance_dn2", "third_dn3", "fourth_dn4")
        values = [group.pixels(channel, name)[..., kept] for name in names]
        units = (scale, scale, scale**1.5, scale**2)
        parts = [value / unit for value, unit in zip(values, units, strict=True)]
        several.append((group.of(channel)[0].halves.n_frames, *parts))
    return Moments.of(several)
