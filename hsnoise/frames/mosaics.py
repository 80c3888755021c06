"""Detecting frames that are read as mono but look like those of a colour sensor."""

from __future__ import annotations

import warnings

import numpy as np

from hsnoise._core.naming import named, setting

MOSAIC_SIGMA, LEAST_PIXELS, MOST_PIXELS = 6.0, 1024, 1 << 20
MOSAIC_MEAN, MOSAIC_VARIANCE = 0.15, 0.04  # of a pixel's noise and variance: taps of a mono CCD leave 0.09, 0.01


def mosaic_in_words() -> str:
    """What is odd about frames that look like a mosaic, and what to do."""
    return (
        "read as mono, but the four pixels of each 2 x 2 block differ, as those of a colour sensor do; if it is one,"
        f" give its Bayer order: {setting('cfa', 'RGGB')}, say"
    )


def warn_of_a_mosaic(frame: np.ndarray) -> None:
    """Warn if a frame [row, column] that is read as mono looks like a colour mosaic."""
    if looks_like_a_mosaic(frame):
        warnings.warn(f"{named('cfa')}: {mosaic_in_words()}", stacklevel=4)


def looks_like_a_mosaic(frame: np.ndarray) -> bool:
    """Whether the pixels of 2 x 2 blocks of a frame [row, column] differ as those of a colour mosaic do.

    Beyond offsets of rows and columns, they agree in mean and in noise on a mono sensor, and differ in both if three
    colours have different gains. A small difference, however significant, is a pattern of the readout.
    """
    rows, columns = (size // 2 * 2 for size in frame.shape)
    if rows * columns < LEAST_PIXELS:
        return False
    blocks_of_rows = frame[:rows, :columns].reshape(rows // 2, 2, columns // 2, 2)
    # Only part of a large frame: as floats, all of it would take many times its memory.
    pixels = blocks_of_rows[:: -(-rows * columns // MOST_PIXELS)].astype(float)
    # Hot pixels would mask the pattern of all others.
    low, high = np.quantile(pixels, (0.001, 0.999))
    pixels = np.clip(pixels, low, high)
    squares = (pixels - pixels.mean((0, 2), keepdims=True)) ** 2
    variance = max(float(squares.mean()), 1e-12)
    sign = np.array([[1, -1], [-1, 1]])[None, :, None, :]
    for values, least in ((pixels, MOSAIC_MEAN * np.sqrt(variance)), (squares, MOSAIC_VARIANCE * variance)):
        block = (sign * values).sum((1, 3)).ravel()
        mean, error = abs(float(block.mean())), max(float(block.std()) / np.sqrt(block.size), 1e-12)
        if mean > MOSAIC_SIGMA * error and mean > 4 * least:
            return True
    return False
