"""A sample of the pixels in all frames of one exposure, and each pixel's statistics in two halves of the frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from hsnoise.statistics.apart import typical_offset
from hsnoise.statistics.pixels.hits import Hits, hits_of
from hsnoise.statistics.pixels.memory import Memory, memory_of

MOST_PIXELS = 1 << 21  # sampled pixels of an exposure
MOST_OF_ALL = 1 << 22  # of all exposures together
MOST_COUNTS = 1 << 24  # pixels times frames of one exposure in memory
MOST_OF_SPREAD = 100_000  # pixels from which the width of a distribution is taken
CORE_SIGMAS = 4.0  # offsets of frames, rows and columns come from the values within
OUTLYING = 6.0  # deviations beyond which a pixel's temporal variance is not its noise
MOST_LEFT = 8.0  # ratio to the expected power: of a sinusoid, one mean in 3000 has more
NEIGHBOURS = 32  # pixels of a row that are compared with each other
FEWEST_ROWS = 24  # enough for the offset of a column in a frame


def sampled_rows(shape: tuple[int, int], cell: int, exposures: int, most_frames: int) -> np.ndarray:
    """Numbers of the sampled sensor rows: all rows of a small frame, evenly spread (pairs) of a large one."""
    most = min(MOST_PIXELS, MOST_OF_ALL // max(exposures, 1), MOST_COUNTS // max(most_frames, 1))
    cells = shape[0] // cell
    kept = max(1, min(cells, most // (cell * shape[1])))
    first = cell * np.unique(np.linspace(0, cells - 1, kept).round().astype(int))
    return (first[:, None] + np.arange(cell)).ravel()


@dataclass(frozen=True)
class Halves:
    """Statistics of each pixel of one plane and exposure in two halves of the frames (even and odd).

    Common offsets of a frame, and of a row or column in it, are subtracted.

    Attributes:
        n_frames: of each half (2).
        level_dn [half, pixel]: mean, DN.
        variance_dn2 [half, pixel]: unbiased temporal variance, DN^2; NaN where a half has one frame.
        peak_dn [half, pixel]: largest deviation from the mean, DN.
        lowest, highest [pixel]: extreme counts of all frames, DN.
        frame_means_dn [frame]: level of each frame relative to the typical one, DN.
        pair_variance_dn2 [pixel]: temporal variance over all frames, DN^2.
        third_dn3, fourth_dn4 [pixel]: third and fourth central moments over all frames, DN^3, DN^4.
        rows_dn2: variance of rows over frames beside that of their pixels, outliers cut, DN^2.
        frame_noise_dn [frame]: spread over pixels of what changes in a frame, DN, outliers left out.
        hits: pixels far above their level in one frame; None of too few frames.
        memory: what pixels keep of the frame before; None of too few frames.
    """

    n_frames: tuple[int, int]
    level_dn: np.ndarray
    variance_dn2: np.ndarray
    peak_dn: np.ndarray
    lowest: np.ndarray
    highest: np.ndarray
    frame_means_dn: np.ndarray
    pair_variance_dn2: np.ndarray
    third_dn3: np.ndarray
    fourth_dn4: np.ndarray
    rows_dn2: float
    frame_noise_dn: np.ndarray
    hits: Hits | None
    memory: Memory | None


def covariance_of(a: np.ndarray, b: np.ndarray) -> float:
    """Covariance over pixels of two halves of the frames [pixel]: free of the noise of estimation."""
    return float(((a - a.mean()) * (b - b.mean())).mean())


def median_share(n_frames: int) -> float:
    """Median over mean of the variances over so many frames of pixels that are alike."""
    return float(chi2.median(n_frames - 1)) / (n_frames - 1)


def without_outliers(variance: np.ndarray, n_frames: int) -> tuple[float, float]:
    """Mean of the temporal variances [pixel] over so many frames, without outliers, and its standard error."""
    kept = variance[is_no_outlier(variance, n_frames)]
    return float(kept.mean()), float(kept.std() / np.sqrt(len(kept)))


def is_no_outlier(variance: np.ndarray, n_frames: int) -> np.ndarray:
    """Which temporal variances over so many frames are typical, or above that by chance [pixel]."""
    typical = float(np.median(variance)) + 1e-6
    return variance < typical * (1 + OUTLYING * np.sqrt(2 / (n_frames - 1))) ** 2


def halves_of(counts: np.ndarray) -> Halves:
    """Halves of the counts [frame, row, column] of one plane, at least two frames."""
    n = len(counts)
    lowest, highest = counts.min(0).ravel(), counts.max(0).ravel()
    values = counts.astype(np.float32)
    frame_means, share, power, of_lines = _take_off_common(values)
    added = np.float32(share * power)
    flat = values.reshape(n, -1)
    parts = [_moments(flat[half::2], added) for half in (0, 1)]
    level, variance, peak = (np.stack(x) for x in zip(*parts, strict=True))
    # As if a pixel's own noise were in the offsets: they cancel in differences of neighbours then, and the products of
    # two halves, in which the same offsets have opposite signs, are not too small.
    of_other = np.array([[len(flat[1::2])], [len(flat[::2])]], np.float32) / np.float32(n)
    level += np.float32(share) * of_other * (level[::-1] - level)
    level = (level.reshape(2, *values.shape[1:]) - _left_in_lines(values.mean(0), of_lines)).reshape(2, -1)
    whole = flat.var(0, ddof=1) - added
    third, fourth = _higher(flat)
    noise = np.array([_core_spread((frame - values.mean(0)).ravel()) for frame in values]) * np.sqrt(n / (n - 1))
    frames = len(flat[::2]), len(flat[1::2])
    told = frame_means, whole, third, fourth, n * of_lines[0], noise
    return Halves(frames, level, variance, peak, lowest, highest, *told, hits_of(flat), memory_of(flat))


def _higher(flat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Third and fourth central moments of values [frame, pixel], frame by frame: no copy of all of them."""
    mean = flat.mean(0)
    third, fourth = np.zeros_like(mean), np.zeros_like(mean)
    for frame in flat:
        off = frame - mean
        square = off * off
        third += square * off
        fourth += square * square
    return third / np.float32(len(flat)), fourth / np.float32(len(flat))


def _left_in_lines(mean: np.ndarray, of_lines: tuple[float, float]) -> np.ndarray:
    """What the mean over frames [row, column] expects to hold of row and column noise, DN: the same in both halves.

    Such a mean is not the level of a row's pixels, and a gain from levels would come out too small. As rows also differ
    in truth, each is moved towards the others by the share of noise in the variance of rows; columns likewise. Bands
    and slow noise have few degrees of freedom, and a mean may hold MOST_LEFT times what is expected. To subtract too
    much makes a gain less certain, not wrong.

    of_lines: variance of rows and of columns over frames, in the mean, DN^2.
    """
    left = np.zeros_like(mean)
    for axis, noise_dn2 in zip((1, 0), of_lines, strict=True):
        lines = np.median(mean, axis=axis, keepdims=True)
        lines = lines - lines.mean(dtype=np.float64)
        left += np.float32(min(MOST_LEFT * noise_dn2 / max(float(lines.var()), 1e-12), 1.0)) * lines.astype(np.float32)
    return left


def _take_off_common(values: np.ndarray) -> tuple[np.ndarray, float, float, tuple[float, float]]:
    """Subtract the offsets of frames, and of rows and columns in a frame, from `values` in place.

    A pixel's offsets come from the other pixels of its row and column, so that none of its own noise is subtracted.
    Returns the offsets of the frames, DN; the share of a pixel's variance that the offsets' own noise adds to it; the
    typical such variance, DN^2; and the variance of rows and of columns in the mean over frames, DN^2.
    """
    n, h, w = values.shape
    mean = values.mean(0)
    offsets, power, of_rows, of_columns = np.empty(n), 0.0, 0.0, 0.0
    for k, frame in enumerate(values):
        rest = frame - mean
        spread = _core_spread(rest) + np.float32(1e-3)  # frames may differ in noise
        offsets[k] = _middle(rest)  # and by more than any noise
        rest = np.clip(rest - np.float32(offsets[k]), -CORE_SIGMAS * spread * 4, CORE_SIGMAS * spread * 4)
        beyond = _clipped_mean(rest, spread)
        offsets[k] += beyond
        rest = np.clip(rest - np.float32(beyond), -CORE_SIGMAS * spread, CORE_SIGMAS * spread)
        frame -= np.float32(offsets[k])
        if w > 1:
            frame -= (rest.sum(1, keepdims=True) - rest) / np.float32(w - 1)
        of_rows += float(np.mean(rest.mean(1) ** 2))
        rest -= rest.mean(1, keepdims=True)
        of_columns += float(np.mean(rest.mean(0) ** 2))
        if h >= FEWEST_ROWS:
            frame -= (rest.sum(0, keepdims=True) - rest) / np.float32(h - 1)
            rest -= rest.mean(0, keepdims=True)
        power += float(np.mean(rest**2))
    typical = typical_offset(offsets)
    values += np.float32(typical)
    share = (1 / (w - 1) if w > 1 else 0.0) + (1 / (h - 1) if h >= FEWEST_ROWS else 0.0)
    of_pixels = power / (n - 1)
    of_lines = tuple(
        max(of / (n - 1) - of_pixels / of_each, 0.0) / n for of, of_each in ((of_rows, w), (of_columns, h))
    )
    return offsets - typical, share, of_pixels, of_lines


def _middle(rest: np.ndarray) -> float:
    return float(np.median(rest[:: max(1, len(rest) // 64)]))


def _clipped_mean(rest: np.ndarray, spread: np.float32) -> float:
    """Mean of the values near the median."""
    middle = np.float32(_middle(rest))
    return float(np.clip(rest, middle - CORE_SIGMAS * spread, middle + CORE_SIGMAS * spread).mean(dtype=np.float64))


def _core_spread(rest: np.ndarray) -> np.float32:
    """Half the distance between the 16 % and 84 % quantiles, which hot pixels and cosmic rays hardly move."""
    thin = rest.ravel()[:: max(1, rest.size // MOST_OF_SPREAD)]
    low, high = np.quantile(thin, (0.1587, 0.8413))
    return np.float32((high - low) / 2)


def _moments(flat: np.ndarray, added: np.float32) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    level = flat.mean(0)
    off = flat - level
    peak = np.abs(off).max(0)
    if len(flat) < 2:
        return level, np.full_like(level, np.nan), peak
    return level, np.einsum("fp,fp->p", off, off) / np.float32(len(flat) - 1) - added, peak


def of_neighbours(values: np.ndarray, columns: int) -> np.ndarray:
    """Median of the run of NEIGHBOURS pixels of its row in which each pixel lies; the last run may be longer."""
    rows, out = values.reshape(-1, columns), np.empty(values.shape, values.dtype).reshape(-1, columns)
    starts = np.arange(0, max(columns - NEIGHBOURS + 1, 1), NEIGHBOURS)
    for start, stop in zip(starts, [*starts[1:], columns], strict=True):
        out[:, start:stop] = np.median(rows[:, start:stop], axis=1, keepdims=True)
    return out.ravel()
