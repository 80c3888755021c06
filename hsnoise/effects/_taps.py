"""Which output reads a pixel, where several read blocks of the frame."""

from __future__ import annotations

import jax
import numpy as np

from hsnoise.effects._base import Capture

MOST_TAPS = 65536  # one for each column of the widest sensors


def tap_of(capture: Capture, taps: int, row_taps: int) -> np.ndarray | jax.Array:
    """Number of the output of each pixel, [row or 1, column]."""
    row, column = (
        lines * count // size
        for lines, count, size in zip(
            (capture.rows, capture.columns), (row_taps, taps), capture.sensor_shape, strict=True
        )
    )
    return (row[:, None] if row_taps > 1 else np.zeros((1, 1), int)) * taps + column[None]


def check_taps(name: str, taps: int, row_taps: int) -> None:
    """Raise ValueError, naming the setting, for numbers of outputs that are none."""
    for setting, value in (("taps", taps), ("row_taps", row_taps)):
        if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= MOST_TAPS:
            raise ValueError(f"{name}.{setting}: expected a whole number from 1 to {MOST_TAPS}, got {value!r}.")
    if taps * row_taps < 2:
        raise ValueError(f"{name}.taps: expected at least 2 outputs, over the columns or by row_taps over the rows.")
