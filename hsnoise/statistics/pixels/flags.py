"""Flags of defective pixels (stuck, dead, hot, telegraph-like) from their behaviour over time."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from hsnoise.statistics.pixels.classes import is_hot
from hsnoise.statistics.pixels.sample import of_neighbours
from hsnoise.statistics.pixels.survey import Group, Survey

FLAGS = {"stuck": 1, "dead": 2, "hot": 4, "telegraph": 8}  # bits of a map
DIM = 0.5  # of the median response of its neighbours: below it a pixel is dead
LIT_SIGMAS = 5.0  # a signal below this, in units of a level's noise, is no light
FEWEST = 20  # pixels of a class
RARE = 1e-3  # chance of a variance that high, in each half of the frames
NOISIER = 2.0  # times the variance of others of its level, at least: many frames show any small difference
SPREADS = 3.0  # of the logarithm of the variance over pixels, beyond chance: read noise differs, as log-normal numbers
ONE_BELOW = 0.1587  # of normal numbers lie a standard deviation below the mean


def flags_of(found: Survey, channel: int) -> np.ndarray:
    """Bits of FLAGS of each sampled pixel of one channel [pixel]; flags that the frames cannot show are not set."""
    halves = [[p.halves for p in g.of(channel)] for g in found.groups if g.n_frames > 1]
    if not halves or halves[0][0] is None:
        return np.zeros(0, np.uint8)
    flags = np.zeros(sum(h.level_dn.shape[1] for h in halves[0]), np.uint8)
    stuck = found.stuck(channel)
    flags[stuck] |= FLAGS["stuck"]
    if found.repeated_flats:
        flags[is_dead(found, channel) & ~stuck] |= FLAGS["dead"]
    flags[is_hot(found, channel)] |= FLAGS["hot"]
    flags[_jumping(found.repeated_darks, channel, len(flags)) & ~stuck] |= FLAGS["telegraph"]
    return flags


def counts_of(flags: np.ndarray) -> dict[str, float]:
    """Share of the pixels with each flag."""
    return {name: float(np.mean(flags & bit > 0)) if flags.size else float("nan") for name, bit in FLAGS.items()}


def is_dead(found: Survey, channel: int) -> np.ndarray:
    """Pixels [pixel] that hardly respond to light, or lie where none falls, such as overscan.

    They are compared with their neighbours in the row: light may fall off by any factor over a frame.
    """
    flats = found.repeated_flats
    level = [g.pixels(channel, "level_dn").mean(0) for g in flats]
    bright = int(np.argmax([np.median(x) for x in level]))
    darks, noise = found.repeated_darks, flats[bright].noise_dn / np.sqrt(flats[bright].n_frames)
    black = np.zeros_like(level[bright])
    if darks:
        black = darks[0].pixels(channel, "level_dn").mean(0)
        noise = float(np.hypot(noise, darks[0].noise_dn / np.sqrt(darks[0].n_frames)))
    signal = level[bright] - black
    least = LIT_SIGMAS * noise
    if np.median(signal) < least:
        return np.zeros(len(signal), bool)
    width = len(found.groups[0].of(channel)[0].column_mean_dn)
    nearby = of_neighbours(signal, width)
    return are_dim(signal.reshape(-1, width), noise).ravel() | ((nearby < least) & (signal < least))


def are_dim(signal: np.ndarray, noise: float) -> np.ndarray:
    """Pixels [row, column] of one colour with less than half the signal of their row's neighbours, not by chance.

    noise: standard deviation of a pixel's signal.
    """
    nearby = of_neighbours(signal.ravel(), signal.shape[1]).reshape(signal.shape)
    return (signal < DIM * nearby) & (nearby > LIT_SIGMAS / DIM * noise)


def _jumping(groups: tuple[Group, ...], channel: int, pixels: int) -> np.ndarray:
    """Pixels much noisier than others of their level, in both halves of an exposure's frames."""
    found = np.zeros(pixels, bool)
    for group in groups:
        dof = np.array(group.of(channel)[0].halves.n_frames) - 1
        if dof.min() < 1:
            continue
        level = group.pixels(channel, "level_dn").mean(0)
        variance = group.pixels(channel, "pair_variance_dn2")
        expected = np.maximum(_of_their_level(level, variance), 0.25)
        spread = _spread_below(variance / expected, group.n_frames - 1)
        limit = np.maximum(chi2.isf(RARE, dof) / dof * np.exp(SPREADS * spread), NOISIER)
        found |= (group.pixels(channel, "variance_dn2") / expected > limit[:, None]).all(0)
    return found


def _spread_below(variance: np.ndarray, dof: int) -> float:
    """Standard deviation over pixels of the logarithm of their true variance, from the quieter half of the pixels.

    Jumps make pixels noisier, never quieter. variance [pixel]: measured, with so many degrees of freedom each.
    """
    low, middle = np.quantile(variance, (ONE_BELOW, 0.5))
    if low <= 0:
        return 0.0
    chance = np.log(chi2.median(dof) / chi2.ppf(ONE_BELOW, dof))
    return float(np.sqrt(max(np.log(middle / low) ** 2 - chance**2, 0.0)))


def _of_their_level(level: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Typical variance of pixels of a level [pixel]: of classes the mean below the 90 % quantile, interpolated.

    The brightest pixels are one class, if they are few. Brighter ones than its mean follow the growth up to it, as shot
    noise does.
    """
    edges = np.unique(np.quantile(level, np.concatenate([[0, 0.5, 0.9], 1 - np.geomspace(0.05, 1e-4, 10)])))
    number = np.clip(np.searchsorted(edges, level, side="right") - 1, 0, len(edges) - 1)
    from_here_on = np.cumsum(np.bincount(number)[::-1])[::-1]
    number = np.minimum(number, np.flatnonzero(from_here_on > FEWEST).max(initial=0))
    classes = [number == i for i in range(len(edges))]
    classes = [inside for inside in classes if np.count_nonzero(inside) > FEWEST]
    if not classes:
        return np.full(len(level), np.median(variance))
    at = np.array([level[inside].mean() for inside in classes])
    typical = np.array([np.minimum(v, np.quantile(v, 0.9)).mean() for v in (variance[inside] for inside in classes)])
    growth = max((typical[-1] - typical[0]) / (at[-1] - at[0]), 0.0) if len(at) > 1 else 0.0
    return np.interp(level, at, typical) + growth * np.maximum(level - at[-1], 0)
