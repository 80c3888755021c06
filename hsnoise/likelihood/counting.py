"""Histograms of the rows of a frame, and their sums: where a pass over the pixels spends its time."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

BLOCK_PIXELS = 1 << 19  # counted at a time, so that the histograms stay in the cache
MOST_CODES_FLOAT32 = 1 << 21  # up to here a quotient rounded in float32 is in its bin


class Bins(NamedTuple):
    """Bins of whole codes, for each place in the colour pattern [row, column] of a frame.

    `width` codes each from `low` on; the first bin holds all below, the last all from `end` on.
    """

    low: np.ndarray
    width: np.ndarray
    end: np.ndarray


def count_rows(frame: np.ndarray, bins: Bins, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Histograms in `number` bins [row, column of the pattern, bin], and exact sums of the codes and of their squares.

    frame [row, column]: counts, uint16 or int32, whose sides are multiples of the pattern's. Sums are
    [2, row, column of the pattern].
    """
    rows, step = len(frame), len(bins.low)
    height = min(rows, max(1, BLOCK_PIXELS // (frame.shape[1] * step)) * step)
    wide = bool((bins.end - bins.low).max() > MOST_CODES_FLOAT32)
    counts, sums = np.empty((rows, step, number), np.int32), np.empty((2, rows, step))
    # All blocks are of one height and share a program: the last one goes over rows of the one before again.
    for start in [*range(0, rows - height, height), rows - height]:
        at = slice(start, start + height)
        with jax.enable_x64(True):
            counts[at], sums[0, at], sums[1, at] = _count(frame[at], bins, number, wide)
    return counts, sums


@partial(jax.jit, static_argnames=("number", "wide"))
def _count(frame: jax.Array, bins: Bins, number: int, wide: bool) -> tuple[jax.Array, jax.Array, jax.Array]:
    (rows, columns), step = frame.shape, bins.low.shape[1]
    whole = jnp.int32 if frame.dtype == np.uint16 else jnp.int64
    low, width, end = (jnp.tile(x, (rows // step, 1))[:, None, :].astype(whole) for x in bins)
    codes = frame.astype(whole).reshape(rows, columns // step, step)
    above = jnp.clip(codes, low - 1, end) - low
    share = 1 / width.astype(jnp.float64 if wide else jnp.float32)
    # Many times as fast as a division of whole numbers.
    at = jnp.floor((above.astype(share.dtype) + 0.5) * share).astype(jnp.int32) + 1
    at = jnp.where(codes >= end, number - 1, at)
    first = number * jnp.arange(rows * step, dtype=jnp.int32).reshape(rows, 1, step)
    counts = jnp.zeros(number * rows * step, jnp.int32).at[(at + first).ravel()].add(1, mode="promise_in_bounds")
    exact = codes.astype(jnp.int64 if frame.dtype == np.uint16 else jnp.float64)
    return counts.reshape(rows, step, number), exact.sum(1), (exact**2).sum(1)
