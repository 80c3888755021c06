"""Checks of the values of raw frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from hsnoise._core.types import channels_of
from hsnoise.frames.bayer import channel_pixels

WRAPPED = 1e-3  # share of the counts
DEPTHS = (8, 10, 12, 14, 16)  # bits of a count
LIGHT = 0.75  # share of a frame that no subtraction makes negative
STARTS, BETWEEN = 2, 0.1  # DN; share of those that wrapped


def check_values(frame: np.ndarray, *, white_level: float | None = None, name: str = "counts") -> None:
    """Check the values of one raw frame `[row, column]`, DN.

    Args:
        frame: counts as stored, of any real dtype.
        white_level: DN at which the sensor saturates; None: unknown.
        name: what to call the frame in an error.

    Raises:
        ValueError: values that are not finite, not integers, negative, negative before they wrapped around, too large,
            all the same, or mostly at the white level.
    """
    if frame.dtype.kind == "f":
        if not np.isfinite(frame).all():
            raise ValueError(f"{name}: counts must be finite, got NaN or infinity")
        if (frame != np.rint(frame)).any():
            raise ValueError(
                f"{name}: counts must be integers (DN), got fractions; give the raw counts, "
                "do not normalise, scale or average them"
            )
    low, high = frame.min(), frame.max()
    if low < 0:
        raise ValueError(
            f"{name}: counts must be >= 0, got {low:g}; subtracting a dark makes counts negative; give the raw frames"
        )
    if high > np.iinfo(np.int32).max:
        raise ValueError(f"{name}: counts must fit in 31 bits, got {high:g}")
    end = next((2**bits for bits in DEPTHS if high < 2**bits), 2**32)
    if (share := wrapped_share(frame, high, end)) > WRAPPED:
        raise ValueError(
            f"{name}: {share:.1%} of the counts lie just below {end} and the others near 0: "
            "counts below 0 wrapped around, as where a dark is subtracted from unsigned counts; give the raw frames"
        )
    if white_level is not None and high >= white_level:
        saturated = np.mean(frame >= white_level)
        if saturated > 0.5:
            raise ValueError(
                f"{name}: {saturated:.0%} of the pixels reach white_level {white_level:g} DN (saturated); "
                "shorten the exposure, leave it out, or correct white_level"
            )
    if low == high:
        what, or_else = ("all zero", "") if high == 0 else (f"all {high:g}", "; if it is saturated, leave it out")
        raise ValueError(f"{name}: counts are {what}; a frame without any noise cannot be raw sensor data{or_else}")


def wrapped_share(frame: np.ndarray, highest: int, end: int) -> float:
    """Share of counts that were below 0 and have wrapped around: far above, just below `end`.

    The others must begin at 0, and next to none lie between; pixels that saturate at the highest count are none of
    them, and neither are most pixels of a frame: those are light.
    """
    if highest < end - end // 8:
        return 0.0
    values = _thin(frame.ravel())
    above, below = values >= end - end // 8, values < end // 8
    share, between = float(np.mean(above & (values < highest))), 1.0 - float(np.mean(above | below))
    continues = share < LIGHT and below.any() and int(values[below].min()) <= STARTS
    return float(above.mean()) if continues and between < BETWEEN * share else 0.0


def check_black_level(frames: Sequence[np.ndarray], black_level: Any, cfa: str) -> None:
    """Check that black lies below the counts of at least one exposure.

    A black level above the median of every exposure must be wrong. The margin is the noise, because rounding, or a
    camera that subtracts its dark current, may put the median slightly below black.

    Args:
        frames: one frame `[row, column]` of each exposure, DN.
        black_level: DN; None, one value or one per channel.
        cfa: "mono" or Bayer order of the frames' first pixel.

    Raises:
        ValueError: the black level lies above the data.
    """
    if black_level is None:
        return
    channels = channels_of(cfa)
    for channel, level in zip(channels, np.broadcast_to(black_level, len(channels)), strict=True):
        quantiles = [np.percentile(_thin(channel_pixels(frame, cfa, channel)), [16, 50, 84]) for frame in frames]
        if all(level > median + max(1.0, (high - low) / 2) for low, median, high in quantiles):
            highest = max(median for _, median, _ in quantiles)
            raise ValueError(
                f"black_level {level:g} DN lies above the data: the median of channel {channel} is at most "
                f"{highest:g} DN in all exposures; give the true level in DN, or None to have it estimated"
            )


def _thin(values: np.ndarray, limit: int = 1_000_000) -> np.ndarray:
    """About `limit` of the values, evenly spread: enough for a median."""
    return values[:: max(1, values.size // limit)]
