"""What a pixel keeps of the frame before: a filter over frames in the camera, or image lag."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hsnoise._core.robust import robust_sigma

FEWEST_FRAMES = 4
PARTS, MOST_PIXELS = 16, 1 << 18  # of a plane, which tell the error
WIDTH = 4.0  # deviations at which differences are cut: jumping and hit pixels say nothing here
LEAST_NOISE_DN = 0.5  # of a pixel; where a count is wider than the noise, levels decide which frames agree
LEAST, SURE = 0.01, 5.0  # share that matters, and its standard errors


class Memory(NamedTuple):
    """Share of its temporal noise that a pixel has in common with the frame before, and the error."""

    share: float
    error: float

    @property
    def sentence(self) -> str:
        return (
            f"Pixels have {self.share:.1%} of their noise in common with the frame before: a filter over frames"
            " (temporal noise reduction in the camera), or image lag (hsnoise diagnose may name it). Variances come out"
            f" too small by {2 * self.share:.0%} or more, and so do gain or noise. Switch a filter off."
        )


def together(told: Sequence[Memory]) -> Memory | None:
    """Of all planes and exposures; None where it may be chance, or is too little to matter."""
    if not told:
        return None
    weight = np.array([max(one.error, 1e-6) for one in told]) ** -2.0
    share, error = float(weight @ [one.share for one in told] / weight.sum()), float(weight.sum() ** -0.5)
    return Memory(share, error) if share > max(LEAST, SURE * error) else None


def memory_of_region(counts: np.ndarray) -> Memory | None:
    """Of counts [frame, row, column], of which some rows suffice."""
    rows = counts[:, : max(MOST_PIXELS // counts.shape[2], 1)].astype(np.float32)
    rows -= rows.mean(0)
    rows -= np.median(rows, axis=2, keepdims=True)
    rows -= np.median(rows, axis=1, keepdims=True)
    return memory_of(rows.reshape(len(rows), -1))


def memory_of(values: np.ndarray) -> Memory | None:
    """Of values [frame, pixel] without what frames, rows and columns share; None of too few frames or still pixels.

    By D(k), the mean square difference of frames k apart: (2 D(2) - D(1) - D(3)) / D(3). What decays from frame to
    frame makes it positive; levels that wander leave it at 0, and levels that drift make it negative.
    """
    if len(values) < FEWEST_FRAMES or values.shape[1] < PARTS:
        return None
    thin = values[:, :: max(1, values.shape[1] // MOST_PIXELS)]
    width = WIDTH * robust_sigma(thin[1] - thin[0])
    if width <= 0:
        return None
    square = [_mean_square(thin, apart, width) for apart in (1, 2, 3)]
    shares = (2 * square[1] - square[0] - square[2]) / square[2].mean()
    return Memory(float(shares.mean()), float(shares.std(ddof=1) / np.sqrt(PARTS)))


def _mean_square(values: np.ndarray, apart: int, width: float) -> np.ndarray:
    """Of the differences of frames that are so far apart [part of the pixels]."""
    square = np.zeros(values.shape[1])
    for one, later in zip(values, values[apart:], strict=False):
        square += np.clip(later - one, -width, width) ** 2
    parts = np.array_split(square, PARTS)
    return np.array([float(part.mean()) for part in parts]) / (len(values) - apart)
