"""Whether pixels differ: static structure of single pixels beyond rows, columns and smooth shading."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d

from hsnoise._core.robust import NORMAL, robust_sigma
from hsnoise.statistics.pixels.classes import HOT_SIGMAS
from hsnoise.statistics.pixels.sample import covariance_of, median_share
from hsnoise.statistics.pixels.survey import Group, Plane, Survey

WINSOR_SIGMAS = 5.0
PIECE = 65  # pixels of a row
LOW_SIDE_SIGMAS = 3.0  # standard errors
SIGNIFICANT = 5.0  # standard errors
SMALL_SHARE = 0.01  # of the temporal variance: less static structure does not bias a fit that pools pixels
GROWN = 0.1  # of the variance of the shortest exposure
HITS = 10.0  # ratio of the mean temporal variance to that of the typical pixel
SMALL_PATTERN = 0.001  # of the temporal variance
MANY_HOT = 0.003  # share of hot pixels that is too large for a component of outliers
ROWS_DOMINATE = 4.0  # ratio of the variance of rows over frames to that of pixels at the shortest exposure
STREAKS = 0.05  # growth of the variance of row means over that of pixels, above which streaks dominate
MOST_ALIKE = 0.99  # correlation of rows
MOST_DN_PER_E = 50.0  # no camera has such a gain: variance that grows by more of it grows without a signal
CLIPPED = 0.6  # share of clipped counts above which moments over time say too little about the noise


class Static(NamedTuple):
    """Static variance of single pixels and its standard error, DN^2; temporal variance, DN^2."""

    variance_dn2: float
    error_dn2: float
    temporal_dn2: float


def static_of(found: Survey, group: Group, channel: int) -> Static | None:
    """The static variance of the pixels of one channel in one exposure; None if frames are too few to halve."""
    planes = group.of(channel)
    if group.n_frames < 2:
        return None
    products, temporal = [], []
    for plane in planes:
        pattern = double_differences(plane.halves.level_dn, len(found.sampled_rows) * plane_rows(found))
        products.append(covariance_terms(pattern))
        temporal.append(float(np.median(plane.halves.pair_variance_dn2)))
    terms = np.concatenate(products)
    # Of the typical pixel, where hits in a few make up the mean; of few frames, the median lies below it.
    typical_dn2 = np.mean(temporal) / median_share(group.n_frames)
    noise = min(np.mean([p.components["temporal"].variance_dn2 for p in planes]), typical_dn2)
    return Static(float(terms.mean()), float(terms.std() / np.sqrt(len(terms))), float(noise))


def plane_rows(found: Survey) -> float:
    """Rows of a plane for each sampled row of the sensor."""
    return 1.0 if found.cfa == "mono" else 0.5


def double_differences(level: np.ndarray, rows: float) -> np.ndarray:
    """Differences of pixels in 2 x 2 blocks beyond rows and columns [half, block], with the variance of a pixel.

    level [half, pixel]: of `rows` rows. Smooth shading, row and column patterns cancel.
    """
    return within_blocks(level, rows, 2)[0][..., 0]  # the other three differ in sign


def within_blocks(level: np.ndarray, rows: float, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [half, block, pixel] of square blocks beyond their rows and columns, with a pixel's variance, and the
    means of the blocks [half, block].

    level [half, pixel]: of `rows` rows. Smooth shading, row and column patterns cancel, the better the smaller `side`;
    (side - 1)^2 values of each block are independent.
    """
    maps = level.reshape(2, int(rows), -1)
    height, width = (size // side * side for size in maps.shape[1:])
    blocks = maps[:, :height, :width].reshape(2, height // side, side, width // side, side).swapaxes(2, 3)
    mean = blocks.mean((3, 4), keepdims=True)
    apart = blocks - blocks.mean(3, keepdims=True) - blocks.mean(4, keepdims=True) + mean
    return apart.reshape(2, -1, side * side) * np.float32(side / (side - 1)), mean.reshape(2, -1)


def beside_neighbours(level: np.ndarray, rows: float) -> np.ndarray:
    """Pixels [half, pixel] less their column's median and the mean of a piece of their row, with a pixel's variance.

    Smooth shading, row and column patterns cancel, as in `double_differences`; of white patterns this tells four times
    as much, and a pattern in which neighbours resemble each other keeps its variance.
    """
    maps = level.reshape(2, int(rows), -1)
    _, height, width = maps.shape
    maps = maps - np.median(maps, axis=1, keepdims=True)
    piece = min(PIECE, width)
    starts = np.clip(np.arange(width) - piece // 2, 0, width - piece)  # near the edges, the last whole piece
    around = uniform_filter1d(maps, piece, axis=2)[..., starts + piece // 2]
    kept = (1 - 1 / piece if piece > 1 else 1.0) * (1 - (2 - np.pi / 2) / height)  # of the variance of a white pattern
    return (np.float32(max(kept, 0.5) ** -0.5) * (maps - around)).reshape(2, -1)


def low_side_sigma(level: np.ndarray, rows: float, frames: int) -> float:
    """Most that the offsets of pixels [half, pixel] may deviate, from those below the median, DN.

    Warm pixels only lie above it. Row and column medians are subtracted; two halves remove the noise of estimation.
    frames: of a half. Means of so few whole counts lie on a lattice, on which quantiles would jump: they are blurred.
    """
    blur = np.random.default_rng(0).uniform(-0.5, 0.5, level.shape) / frames
    maps = (level + blur).reshape(2, int(rows), -1)
    mean = maps.mean(0)
    mean = mean - np.median(mean, axis=0, keepdims=True)
    mean = mean - np.median(mean, axis=1, keepdims=True)
    apart = (maps[0] - maps[1]) / 2
    low, middle = np.quantile(mean, (0.1587, 0.5))
    low_noise, high_noise = np.quantile(apart, (0.1587, 0.8413))
    whole, noise = (middle - low) ** 2, ((high_noise - low_noise) / 2) ** 2
    error = 4 * whole / np.sqrt(mean.size)  # of the difference of two squared deviations from quantiles
    return float(np.sqrt(max(whole - noise, 0.0) + LOW_SIDE_SIGMAS * error))


def covariance_terms(pattern: np.ndarray) -> np.ndarray:
    """Winsorised products of two halves [half, place], whose mean is the variance of what both share."""
    width = WINSOR_SIGMAS * NORMAL * np.median(np.abs(pattern), axis=1, keepdims=True) + 1e-6
    a, b = np.clip(pattern, -width, width).astype(np.float64)
    return (a - a.mean()) * (b - b.mean())


def pixels_differ(found: Survey) -> bool:
    """Whether static structure of single pixels is significant, and large compared with temporal noise."""
    for c in range(len(found.channels)):
        for group in found.darks:
            one = static_of(found, group, c)
            if one is not None and one.variance_dn2 > max(SIGNIFICANT * one.error_dn2, SMALL_SHARE * one.temporal_dn2):
                return True
        if _always_bright(found, c) > MANY_HOT:
            return True
    return False


def variance_grows(found: Survey) -> bool:
    """Whether the temporal variance of the typical pixel grows with exposure beyond chance, in some colour."""
    groups = sorted(found.repeated_darks, key=lambda g: g.exposure_s)
    for c in range(len(found.channels)):
        ends = []
        for group in (groups[0], groups[-1]):
            variance = group.pixels(c, "pair_variance_dn2")
            middle = float(np.median(variance))
            width = robust_sigma(variance - middle)
            # With few frames the median lies below the mean, by the same factor for all pixels.
            share = median_share(group.n_frames)
            ends.append((middle / share, 1.25 * width / share / np.sqrt(len(variance))))
        (low, low_error), (high, high_error) = ends
        if high - low > max(SIGNIFICANT * np.hypot(low_error, high_error), GROWN * low):
            return True
    return False


def full_of_hits(found: Survey) -> bool:
    """Whether temporal noise is mostly hits in a few pixels, which a likelihood with outliers fits better."""
    planes = [p for g in found.darks if g.n_frames > 1 for p in g.planes]
    typical = [float(np.median(p.halves.pair_variance_dn2)) for p in planes]
    changing = [p.components["temporal"].variance_dn2 for p in planes]
    return any(all_of > HITS * max(of, 1e-6) for all_of, of in zip(changing, typical, strict=True))


def fall_of(found: Survey) -> tuple[Group, Group, float] | None:
    """A shorter and a longer dark exposure, the longer darker by more than a pixel's noise, and by how much.

    By no more than their frames differ is by chance.
    """
    darks = sorted(found.repeated_darks, key=lambda g: g.exposure_s)
    for one, other in zip(darks, darks[1:], strict=False):
        if other.exposure_s == one.exposure_s:
            continue
        fall = -rise_dn(one, other)
        noise = np.sqrt(np.mean([p.components["temporal"].variance_dn2 for p in one.planes]))
        channels = {p.channel for p in one.planes}
        chance = np.sqrt(sum(np.mean([g.level_error_dn(c) ** 2 for c in channels]) for g in (one, other)))
        if fall > max(noise, SIGNIFICANT * chance):
            return one, other, fall
    return None


def rise_dn(one: Group, other: Group) -> float:
    """How much brighter the frames of another exposure are, DN, mean over the planes."""
    pairs = zip(one.planes, other.planes, strict=True)
    return float(np.mean([q.frame_means_dn.mean() - p.frame_means_dn.mean() for p, q in pairs]))


def noise_spread(found: Survey, channel: int) -> float:
    """Relative spread over pixels of the temporal variance at the shortest exposure, from two halves."""
    groups = [g for g in found.darks if min(g.n_frames // 2, g.n_frames - g.n_frames // 2) > 1]
    if not groups:
        return 0.0
    shortest = min(groups, key=lambda g: g.exposure_s)
    a, b = shortest.pixels(channel, "variance_dn2").astype(np.float64)
    top = np.quantile(np.concatenate([a, b]), 0.999)
    a, b = np.minimum(a, top), np.minimum(b, top)
    return float(np.sqrt(max(covariance_of(a, b), 0.0)) / max(a.mean(), 1e-12))


def has_patterns(found: Survey) -> bool:
    """Whether the shortest darks have frame, row or column patterns that a row gain cannot make."""
    for plane in found.shortest.planes if found.shortest is not None else ():
        noise = plane.components["temporal"].variance_dn2
        for name in ("row", "column", "row_x_frame", "column_x_frame", "frame"):
            one = plane.components[name]
            if one.variance_dn2 > max(SIGNIFICANT * one.chance_dn2, SMALL_PATTERN * noise):
                return True
    return False


def responses_differ(found: Survey) -> bool:
    """Whether the response of pixels to light differs beyond chance, or flats have rows that no row gain makes."""
    for group in found.groups:
        for c in range(len(found.channels)) if group.kind == "flat" else ():
            one = static_of(found, group, c)
            if one is not None and one.variance_dn2 > max(SIGNIFICANT * one.error_dn2, SMALL_SHARE * one.temporal_dn2):
                return True
    return False


def rows_dominate(found: Survey) -> bool:
    """Whether rows vary far more than pixels without signal.

    No row gain does that, and a likelihood that explains it by one is slow and wrong.
    """
    if found.shortest is None:
        return False
    parts = [plane.components for plane in found.shortest.planes]
    return all(of["row_x_frame"].variance_dn2 > ROWS_DOMINATE * of["temporal"].variance_dn2 for of in parts)


def _always_bright(found: Survey, channel: int) -> float:
    """Share of pixels that stand out in every frame of the longest exposure, unlike hits and jumps."""
    several = found.repeated_darks
    if not several:
        return 0.0
    longest = max(several, key=lambda g: g.exposure_s)
    lowest = longest.pixels(channel, "lowest").astype(np.float64)
    sigma = float(np.sqrt(np.median(longest.pixels(channel, "pair_variance_dn2"))))
    level = float(np.median(longest.pixels(channel, "level_dn")))
    return float(np.mean((lowest > level + HOT_SIGMAS * max(sigma, 0.5))[~found.stuck(channel)]))


def can_be_transferred(found: Survey) -> bool:
    """Whether pixels over time show their noise: they are hardly clipped, and row streaks do not dominate."""
    groups = found.repeated_darks
    if not groups or max(g.clipped_share.max() for g in groups) > CLIPPED:
        return False
    # Row offsets are subtracted, but a row gain grows with the signal and changes the noise within rows.
    for planes in zip(*[g.planes for g in groups], strict=True):
        streaks = np.array([plane.components["row_x_frame"].variance_dn2 for plane in planes])
        noise = np.array([plane.components["temporal"].variance_dn2 for plane in planes])
        least = float(streaks.min())
        chance = np.sqrt(2) * max(least, 0.0) * np.array([_scatter_of_rows(plane) for plane in planes])
        if (streaks - least > np.maximum(STREAKS * noise, SIGNIFICANT * chance)).any():
            return False
    return True


def _scatter_of_rows(plane: Plane) -> float:
    """Relative error of the variance of rows over frames: larger where rows resemble the next, and few are independent.

    By the correlations of a series that fades exponentially, and by how frames differ.
    """
    rows = plane.components["row_x_frame"]
    variance = max(rows.variance_dn2, 1e-12)
    square = min(max(abs(of.variance_dn2) for of in plane.rows_together) / variance, MOST_ALIKE) ** 2
    alike = rows.standard_error_dn2 * np.sqrt((1 + square) / (1 - square))
    return float(max(alike, plane.rows_error_dn2) / variance)
