"""How much the read noise of pixels differs: if it does, two temporal variances of each pixel are correlated."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.special import digamma

from hsnoise.statistics.pixels.classes import is_hot
from hsnoise.statistics.pixels.sample import covariance_of, is_no_outlier, without_outliers
from hsnoise.statistics.pixels.structure import covariance_terms
from hsnoise.statistics.pixels.survey import Group, Survey

FEWEST_PIXELS = 1000
MOSTLY_READ, ALL_READ = 1.2, 1.03  # largest ratios of the variances of two exposures
TINY_DN2, OUTLYING = 1e-6, 6.0  # the last: times the median variance of a line
SURE = 8.0  # standard errors above which quiet pixels differ: telegraph noise that is not cut reaches 5
NOISIEST = 0.05  # largest share of the pixels that jump or are hit
SIMULATED = 100_000  # pixels
FEWEST_LINES, LINES_THERE, LEAST_OF_LINES = 32, 6.0, 0.01  # the last: spread of rows or columns that matters
FEWEST_OF_TAIL, MOST_STILL = 3, 0.01  # frames, share of the pixels
MOST_OF_SPREAD = 0.6  # of the deviation of ln sigma that a tail must make: rounding skews log-normal noise by a third
MOST_TAIL = 0.44
BESIDE_LINES = 0.5  # of their spread: a smaller one of pixels is what the difference of two nearly equal ones leaves

Number = tuple[float, float]


class NoiseSpread(NamedTuple):
    """Standard deviation of the logarithm of read noise over single pixels, whole rows and whole columns, with errors.

    What rows and columns share is not in that of pixels. tail: mean of an exponential part of it over pixels. An error
    is infinite where nothing is determined.
    """

    pixels: Number
    rows: Number = (0.0, np.inf)
    columns: Number = (0.0, np.inf)
    tail: Number = (0.0, np.inf)


class Tail(NamedTuple):
    """Pixels that are far noisier than log-normal ones: ln sigma = constant + spread z + value E, E exponential.

    raised: variance of all pixels over that of those that pass for no outliers.
    """

    value: Number
    spread: Number
    raised: float


def tail_of(found: Survey, channel: int) -> Tail | None:
    """The noisiest pixels of a channel, where there are more of them than log-normal noise has; None where not.

    From cumulants of the logarithm of read noise L over pixels: two temporal variances of a pixel have errors that are
    independent of it and of each other, so their logarithms a, b give the second as the mean of ab / 4 and the third as
    that of a^2 b / 8, which is 2 tail^3. Pixels that are hit, or jump once, are noisy in one of them only.
    """
    groups = sorted(found.repeated_darks, key=lambda g: g.exposure_s)
    kept = ~found.stuck(channel) & ~is_hot(found, channel) if groups else np.zeros(0, bool)
    if kept.sum() < FEWEST_PIXELS:
        return None
    noise = [float(np.median(g.pixels(channel, "pair_variance_dn2"))) for g in groups[:2]]
    # Shot noise, which pixels share, would make the logarithms differ by less.
    both, frames = _variances(groups if noise[-1] < ALL_READ * noise[0] else groups[:1], channel, kept)
    still = ~(both > TINY_DN2).all(0)  # of quiet pixels, equal in all frames: without them noise looks skewed
    both = both[:, ~still].astype(np.float64)
    if min(frames) < FEWEST_OF_TAIL or still.mean() > MOST_STILL or both.shape[1] < FEWEST_PIXELS:
        return None
    a, b = (of - of.mean() for of in np.log(both))
    second, third = a * b / 4, (a + b) * a * b / 16
    error = float(third.std() / np.sqrt(len(a)))
    value = float(np.cbrt(max(third.mean(), 0.0) / 2))
    square, of_square = float(second.mean()), float(second.std() / np.sqrt(len(a)))
    if third.mean() < SURE * error or value < MOST_OF_SPREAD * np.sqrt(max(square, 0.0)):
        return None
    value = min(value, MOST_TAIL)
    spread = np.sqrt(max(square - value**2, 0.0))
    of_value = error / (6 * value**2)
    # The mean square, from the mean logarithm, which the logarithm of a chi-square moves.
    dof = frames[0] - 1
    typical = np.exp(np.log(both[0]).mean() - digamma(dof / 2) + np.log(dof / 2))
    whole = typical * np.exp(2 * (spread**2 - value)) / (1 - 2 * value)
    raised = max(float(whole / without_outliers(both[0], frames[0])[0]), 1.0)
    of_spread = np.hypot(of_square, 2 * value * of_value) / (2 * max(spread, np.sqrt(of_square)))
    return Tail((value, float(of_value)), (float(spread), float(of_spread)), raised)


def noise_spread_of(found: Survey, channel: int, read_dn2: float, of_pixels: Number | None) -> NoiseSpread:
    """How much read noise differs; of_pixels: over all pixels, if that is known."""
    spread, error = read_noise_spread(found, channel, read_dn2) if of_pixels is None else of_pixels
    rows, columns = _of_lines(found, channel, read_dn2)
    of_lines = rows[0] ** 2 + columns[0] ** 2
    left = float(np.sqrt(max(spread**2 - of_lines, 0.0)))
    return NoiseSpread((left if left > BESIDE_LINES * np.sqrt(of_lines) else 0.0, error), rows, columns)


def _of_lines(found: Survey, channel: int, read_dn2: float) -> tuple[Number, Number]:
    """Spread over rows and over columns, from two mean variances of each, less outliers: 0 within chance.

    Without what follows from the levels of the lines: a glow brings shot noise.
    """
    groups = sorted(found.repeated_darks, key=lambda g: g.exposure_s)
    nothing = (0.0, np.inf)
    if not groups or read_dn2 <= 0:
        return nothing, nothing
    both, frames = _variances(groups, channel, np.ones(groups[0].pixels(channel, "lowest").shape, bool))
    # Shot noise of rows with more dark signal is no read noise.
    if min(frames) < 2 or np.median(both, 1).max() > MOSTLY_READ * read_dn2:
        return nothing, nothing
    noise_dn2 = [without_outliers(of, n)[0] for of, n in zip(both, frames, strict=True)]
    share = min(read_dn2 / float(np.sqrt(np.prod(noise_dn2))), 1.0)  # of the noise, which differs by less
    shape = 2, len(groups[0].of(channel)), -1, len(groups[0].of(channel)[0].column_mean_dn)
    planes, levels = both.reshape(shape), groups[0].pixels(channel, "level_dn").reshape(shape)
    spreads = []
    for axis in (3, 2):
        # Means less outliers: counts are whole, and so are their variances nearly, so medians would jump.
        kept = np.minimum(planes, OUTLYING * np.median(planes, axis, keepdims=True))
        lines = np.log(np.maximum(np.mean(kept, axis), TINY_DN2)) / (2 * share)
        a, b = (lines - lines.mean(2, keepdims=True)).reshape(2, -1)
        terms = covariance_terms(np.stack([a, b]))  # dead lines count little
        level = np.median(levels, axis).astype(np.float64)
        of_level = _explained(a, b, [(level - level.mean(2, keepdims=True)).reshape(2, -1)])
        variance, error = float(terms.mean()) - of_level, float(terms.std() / np.sqrt(len(terms)))
        is_there = len(a) >= FEWEST_LINES and variance > max(LINES_THERE * error, LEAST_OF_LINES**2)
        spreads.append((float(np.sqrt(variance)), error / (2 * np.sqrt(variance))) if is_there else nothing)
    return spreads[0], spreads[1]


def read_noise_spread(found: Survey, channel: int, read_dn2: float) -> tuple[float, float]:
    """Standard deviation of the logarithm of read noise over pixels, and its error; infinite if undetermined.

    read_dn2: mean square of the read noise, DN^2.

    From the covariance of two temporal variances of each pixel, less what follows from its level and dark signal (shot
    noise). First without the noisiest pixels, because those that jump or are hit have another kind of noise; log-normal
    read noise, drawn and cut in the same way, shows how much of its covariance remains. If these quiet pixels differ
    beyond chance, the spread is that of all pixels except outliers.
    """
    groups, moving = sorted(found.repeated_darks, key=lambda g: g.exposure_s), ~found.stuck(channel)
    if not groups or moving.sum() < FEWEST_PIXELS or read_dn2 <= 0:
        return 0.0, np.inf
    (first, second), frames = _variances(groups, channel, moving)
    if min(frames) < 2:
        return 0.0, np.inf
    short, long = (group.pixels(channel, "level_dn")[:, moving] for group in (groups[0], groups[-1]))
    by = [short, long - short][: len(groups)]
    left, error = _together(first, second, by, _is_quiet(first, second))
    spreads, expected = _of_quiet(frames[0] - 1, frames[1] - 1)
    if left - expected[0] < SURE * error:
        return 0.0, float(np.interp(expected[0] + error, expected, spreads))
    usual = is_no_outlier(first, frames[0]) & is_no_outlier(second, frames[1])
    left, error = _together(first, second, by, usual)
    # Read noise is only part of all noise, so it differs by more.
    share = min(read_dn2 / float(np.sqrt(first[usual].mean() * second[usual].mean())), 1.0)
    spread, one_up = (float(np.sqrt(np.log1p(x / share**2)) / 2) for x in (max(left, 0.0), max(left, 0.0) + error))
    return spread, max(one_up - spread, 1e-6)


def _variances(groups: list[Group], channel: int, moving: np.ndarray) -> tuple[np.ndarray, tuple[int, ...]]:
    """Two temporal variances of each pixel [2, pixel], DN^2, and how many frames each is from; the shortest first.

    From two exposures, more precise than two halves of the frames, unless the second is mostly shot noise.
    """
    halves = groups[0].of(channel)[0].halves.n_frames
    if len(groups) > 1:
        whole = np.stack([group.pixels(channel, "pair_variance_dn2")[moving] for group in groups[:2]])
        if np.median(whole[1]) < MOSTLY_READ * np.median(whole[0]) or min(halves) < 2:
            return whole, (groups[0].n_frames, groups[1].n_frames)
    return groups[0].pixels(channel, "variance_dn2")[:, moving], halves


def _together(first: np.ndarray, second: np.ndarray, by: list[np.ndarray], kept: np.ndarray) -> tuple[float, float]:
    """Covariance of two relative variances over the kept pixels, less what follows from `by`, and its error."""
    a, b = (of[kept].astype(np.float64) / of[kept].mean() for of in (first, second))
    terms = (a - a.mean()) * (b - b.mean())
    explained = _explained(a, b, [one[:, kept].astype(np.float64) for one in by])
    return float(terms.mean()) - explained, float(terms.std() / np.sqrt(len(terms)))


def _is_quiet(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Which pixels are not among the noisiest, by two temporal variances [pixel]."""
    both = first / np.median(first) + second / np.median(second)
    return both <= np.quantile(both, 1 - NOISIEST)


@cache
def _of_quiet(*dof: int) -> tuple[np.ndarray, np.ndarray]:
    """Spreads of log-normal read noise, and the covariance of the quiet pixels' relative variances for each."""
    rng = np.random.default_rng(0)
    z, chance = rng.standard_normal(SIMULATED), [rng.chisquare(n, SIMULATED) / n for n in dof]
    spreads = np.linspace(0.0, 1.2, 25)
    expected = []
    for spread in spreads:
        first, second = (np.exp(2 * spread * z) * one for one in chance)
        kept = _is_quiet(first, second)
        expected.append(covariance_of(first[kept] / first[kept].mean(), second[kept] / second[kept].mean()))
    return spreads, np.maximum.accumulate(expected)


def _explained(a: np.ndarray, b: np.ndarray, by: list[np.ndarray]) -> float:
    """Covariance of a and b [pixel] that follows from others [half, pixel], each known from two halves."""
    same = np.array([[covariance_of(one[0], other[1]) for other in by] for one in by])
    of_a, of_b = ([covariance_of(of, one[half]) for one in by] for of, half in ((a, 1), (b, 0)))
    return max(float(of_a @ np.linalg.pinv((same + same.T) / 2, rcond=1e-6) @ of_b), 0.0)
