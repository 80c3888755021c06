"""Frames of one exposure taken apart: what stays in each pixel, and what changes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hsnoise._core.robust import robust_sigma
from hsnoise.statistics.spectra import periodogram

CORE_SIGMAS = 4.0  # offsets of frames, rows and columns come from values within
USUAL_FRAME = 3.0  # deviations up to which a frame's offset counts
FAR_FRAME = 5.0  # deviations beyond which a frame's offset is an outlier
HIT_SIGMAS = 8.0  # deviation of one frame from all others of a pixel that is a hit, such as a cosmic ray
FEWEST_FRAMES = 4  # of which one can be told to be a hit
ORDINARY = 0.999  # of the pixels
ROUNDING_DN = 1 / 12**0.5  # standard deviation of rounding: counts apart by one are no outliers
MOST_OF_SPREAD = 200_000  # values from which a width is taken


def core_sigma(values: np.ndarray) -> float:
    """`robust_sigma` of some of the values: as many as tell it."""
    thin = values.ravel()[:: max(1, values.size // MOST_OF_SPREAD)]
    return robust_sigma(thin)


@dataclass(frozen=True)
class Apart:
    """Frames [frame, row, column] of one exposure taken apart, DN.

    Attributes:
        exposure_s: their exposure, s.
        mean: of each pixel [row, column], without hits; halves [half, row, column]: of the even and the odd frames.
        frame [frame], row [frame, row], column [frame, column]: offsets that change from frame to frame.
        rest: what is left of each count [frame, row, column]; 0 for hits.
        is_hit: whether a frame of the pixel was left out of the mean [row, column].
        hits: how far off these frames are [hit].
    """

    exposure_s: float
    mean: np.ndarray
    halves: np.ndarray
    frame: np.ndarray
    row: np.ndarray
    column: np.ndarray
    rest: np.ndarray
    is_hit: np.ndarray
    hits: np.ndarray

    @staticmethod
    def of(frames: np.ndarray, exposure_s: float) -> Apart:
        """Take at least two frames apart."""
        x = frames.astype(np.float32)
        mean = x.mean(0)
        rest = x - mean
        at, level = _hits(x, max(core_sigma(rest), ROUNDING_DN))
        rest[:, *at[1:]], mean[at[1:]] = x[:, *at[1:]] - level, level
        is_hit, hits = np.zeros(mean.shape, bool), rest[at]
        is_hit[at[1:]], rest[at] = True, 0
        width = CORE_SIGMAS * max(core_sigma(rest), ROUNDING_DN)
        clean = np.clip(rest, -width, width)
        frame = clean.mean((1, 2), dtype=np.float64)
        row = clean.mean(2, dtype=np.float64) - frame[:, None]
        column = clean.mean(1, dtype=np.float64) - frame[:, None]
        rest -= (frame[:, None, None] + row[:, :, None] + column[:, None, :]).astype(np.float32)
        rest[at] = 0
        usual = typical_offset(frame)
        mean = mean + np.float32(usual)
        halves = mean + np.stack([rest[half::2].mean(0) for half in (0, 1)])
        return Apart(exposure_s, mean, halves, frame - usual, row, column, rest, is_hit, hits)

    @property
    def n_frames(self) -> int:
        return len(self.rest)

    @property
    def freedom(self) -> float:
        """Share of the variance that is left after the mean over the frames was taken off."""
        return 1 - 1 / self.n_frames

    @cached_property
    def variance(self) -> np.ndarray:
        """Temporal variance of each pixel [row, column], DN^2, without hits."""
        return np.einsum("frc,frc->rc", self.rest, self.rest) / (self.n_frames - 1 - self.is_hit)

    def ordinary_variance(self, at: tuple = ()) -> float:
        """Mean temporal variance of the pixels of a part, DN^2, without hits; the few noisiest count as their least."""
        variance = self.variance[at]
        return float(np.minimum(variance, np.quantile(variance, ORDINARY)).mean(dtype=np.float64))

    @cached_property
    def powers(self) -> dict[str, np.ndarray]:
        """Mean periodograms of rows, columns, and pixels along rows [frequency], and the variance of frames, DN^2.

        "gain" is the variance over rows of the logarithm of their noise power: rows whose gain differs.
        """
        width = CORE_SIGMAS * max(core_sigma(self.rest), ROUNDING_DN)
        pixels = np.clip(self.rest, -width, width).reshape(-1, self.rest.shape[2])
        usual = USUAL_FRAME * core_sigma(self.frame)
        found = {"row": periodogram(self.row), "column": periodogram(self.column), "pixel": periodogram(pixels)}
        found["frame"] = np.array([np.mean(np.clip(self.frame, -usual, usual) ** 2)])
        found = {axis: power / self.freedom for axis, power in found.items()}
        loudness = np.log(np.mean(pixels**2, axis=1, dtype=np.float64) + 1e-12)
        return {**found, "gain": np.array([loudness.var()])}

    def series_of(self, axis: str) -> float:
        """Number of independent series of which a spectrum of `powers` is the mean."""
        return (self.n_frames - 1) * (self.mean.shape[0] if axis in ("pixel", "gain") else 1)


def typical_offset(frame: np.ndarray) -> float:
    """Mean of the offsets of frames [frame], or their median where one is far from all others."""
    middle = float(np.median(frame))
    off = np.abs(frame - middle)
    return middle if off.max() > FAR_FRAME * robust_sigma(off) else float(frame.mean())


def _hits(x: np.ndarray, sigma: float) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """Frames, rows and columns of counts that are far from all others of their pixel, and the mean of these others.

    None of fewer than FEWEST_FRAMES frames.
    """
    if len(x) < FEWEST_FRAMES:
        nowhere = np.zeros(0, int)
        return (nowhere, nowhere, nowhere), np.zeros(0, np.float32)
    peak = np.max(np.abs(x - np.median(x, axis=0)), axis=0)
    row, column = np.nonzero(peak > HIT_SIGMAS * sigma)
    values = x[:, row, column]
    worst = np.argmax(np.abs(values - np.median(values, axis=0)), axis=0)
    others, n = np.arange(len(x))[:, None] != worst, len(x) - 1
    level = np.where(others, values, 0).sum(0) / n
    spread = np.sqrt((np.where(others, values - level, 0) ** 2).sum(0) / (n - 1))
    off = np.abs(values[worst, np.arange(len(worst))] - level)
    is_hit = off > HIT_SIGMAS * np.maximum(spread, sigma)
    return (worst[is_hit], row[is_hit], column[is_hit]), level[is_hit]
