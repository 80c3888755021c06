"""What a pixel keeps of the frame before: a filter over frames in the camera, or image lag."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

FEWEST_FRAMES = 4
PARTS, MOST_PIXELS = 16, 1 << 18  # of a plane, which tell the error
WIDTH = 4.0  # deviations at which differences are cut: jumping and hit pixels say nothing here


class Memory(NamedTuple):
    """Share of its temporal noise that a pixel has in common with the frame before, and the error."""

    share: float
    error: float

    def exceeds(self, least: float, sigmas: float) -> bool:
        return self.share > max(least, sigmas * self.error)


def memory_of(values: np.ndarray) -> Memory | None:
    """Of values [frame, pixel] without what frames, rows and columns share; None of too few frames or still pixels.

    By D(k), the mean square difference of frames k apart: (2 D(2) - D(1) - D(3)) / D(3). What decays from frame to
    frame makes it positive; levels that wander leave it at 0, and levels that drift make it negative.
    """
    if len(values) < FEWEST_FRAMES or values.shape[1] < PARTS:
        return None
    thin = values[:, :: max(1, values.shape[1] // MOST_PIXELS)]
    width = WIDTH * 1.4826 * float(np.median(np.abs(thin[1] - thin[0])))
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
