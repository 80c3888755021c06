"""What can be done with frames one at a time: lazy reading, value checks, Bayer orders, crops."""

from __future__ import annotations

import mmap
import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hsnoise._types import channels_of


def in_order(path: Path) -> list[Any]:
    """What frames are sorted by: their names, numbers in them by their size.

    dark2 comes before dark10, and dark_0.05s before dark_0.1s; of several points (1.2.10) each separates two numbers.
    """
    parts = re.split(r"((?<![\d.])\d+\.\d+(?![\d.])|\d+)", path.stem)
    return [*(float(part) if i % 2 else part.lower() for i, part in enumerate(parts)), path.suffix.lower()]


class LazyFrames:
    """Frames that are read one at a time; stands in for an array `[frame, row, column]`.

    An int index reads that frame; a slice gives the lazy stack of those frames, nothing is read.

    Args:
        readers: one function a frame, each returns the frame `[row, column]`.
        frame_shape: (rows, columns) that every frame must have.
        dtype: dtype of the stored counts.
        names: what to call each frame in an error, such as its file.
        taken: time of each exposure, ISO 8601; None where unknown.
    """

    def __init__(
        self,
        readers: Sequence[Callable[[], Any]],
        frame_shape: tuple[int, int],
        dtype: Any,
        names: Sequence[str] | None = None,
        taken: Sequence[str | None] | None = None,
    ):
        self.readers = tuple(readers)
        self.shape = (len(self.readers), *frame_shape)
        self.dtype = np.dtype(dtype)
        self.names = tuple(names) if names else tuple(f"frame {i}" for i in range(len(self.readers)))
        self.taken = tuple(taken) if taken else (None,) * len(self.readers)

    def __len__(self) -> int:
        return len(self.readers)

    def __getitem__(self, index: int | slice) -> Any:
        if isinstance(index, slice):
            return LazyFrames(self.readers[index], self.shape[1:], self.dtype, self.names[index], self.taken[index])
        frame = np.asarray(self.readers[index]())
        if frame.shape != self.shape[1:]:
            raise ValueError(f"{self.names[index]}: read {frame.shape} pixels, expected {self.shape[1:]}")
        return frame

    def __repr__(self) -> str:
        return f"LazyFrames(shape={self.shape}, dtype={self.dtype})"


def crop(counts: Any, rows: slice, columns: slice, *, frames: slice | None = None) -> Any:
    """Region of frames `[frame, row, column]` in stored orientation; reads and copies nothing."""
    chosen = slice(None) if frames is None else frames
    if isinstance(counts, np.ndarray):
        return counts[chosen, rows, columns]
    indices = range(counts.shape[0])[chosen]
    readers = [partial(_read_region, counts, i, rows, columns) for i in indices]
    names = [counts.names[i] for i in indices] if isinstance(counts, LazyFrames) else None
    taken = [counts.taken[i] for i in indices] if isinstance(counts, LazyFrames) else None
    return LazyFrames(readers, (rows.stop - rows.start, columns.stop - columns.start), counts.dtype, names, taken)


def _read_region(counts: Any, index: int, rows: slice, columns: slice) -> np.ndarray:
    return np.asarray(counts[index])[rows, columns]


def read_mapped(counts: np.memmap, number: int) -> np.ndarray:
    """A copy of one frame of a memory map, whose pages then no longer count as this process's memory."""
    frame = np.array(counts[number])
    mapping = getattr(counts, "_mmap", None)
    # Only of files opened to read: a private map would lose what was written to it.
    if mapping is not None and counts.mode == "r" and hasattr(mmap, "MADV_DONTNEED"):
        mapping.madvise(mmap.MADV_DONTNEED)
    return frame


def check_values(frame: np.ndarray, *, white_level: float | None = None, name: str = "counts") -> None:
    """Check the values of one raw frame `[row, column]`, DN.

    Args:
        frame: counts as stored, of any real dtype.
        white_level: DN at which the sensor saturates; None: unknown.
        name: what to call the frame in an error.

    Raises:
        ValueError: values that are not finite, not integers, negative, too large, all the same, or mostly at
            the white level.
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
    if low == high:
        what = "all zero" if high == 0 else f"all {high:g}"
        raise ValueError(f"{name}: counts are {what}; a frame without any noise cannot be raw sensor data")
    if white_level is not None and high >= white_level:
        saturated = np.mean(frame >= white_level)
        if saturated > 0.5:
            raise ValueError(
                f"{name}: {saturated:.0%} of the pixels reach white_level {white_level:g} DN (saturated); "
                "shorten the exposure or correct white_level"
            )


def check_black_level(frames: Sequence[np.ndarray], black_level: Any, cfa: str) -> None:
    """Check that black lies below the counts of some exposure.

    A black level above the median of every exposure (by more than the noise: rounding and a camera that
    subtracts its dark current may put the median a little below black) cannot be right.

    Args:
        frames: one frame `[row, column]` of each exposure, DN.
        black_level: DN, None, one value or one a channel.
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


def channel_planes(cfa: str, channel: str) -> list[tuple[int, int]]:
    """(row, column) offsets in the 2x2 cell of the pixels of a channel; mono has one plane."""
    if cfa == "mono":
        return [(0, 0)]
    return [divmod(i, 2) for i, letter in enumerate(cfa) if letter == channel]


def channel_pixels(frame: np.ndarray, cfa: str, channel: str) -> np.ndarray:
    """All pixels `[pixel]` of one channel of a frame `[row, column]`."""
    if cfa == "mono":
        return frame.ravel()
    return np.concatenate([frame[row::2, column::2].ravel() for row, column in channel_planes(cfa, channel)])


def transpose_cfa(cfa: str) -> str:
    """Bayer order of the transposed frame."""
    return cfa if cfa == "mono" else cfa[0] + cfa[2] + cfa[1] + cfa[3]


def shift_cfa(cfa: str, rows: int, columns: int) -> str:
    """Bayer order of a frame cropped to start at (rows, columns)."""
    if cfa == "mono":
        return cfa
    return "".join(cfa[2 * ((i + rows) % 2) + (j + columns) % 2] for i in (0, 1) for j in (0, 1))


def channel_rows(frame: np.ndarray, cfa: str, channel: str) -> np.ndarray:
    """Pixels of a channel as [colour row, pixel]: R and B every second sensor row, G all of them."""
    if cfa == "mono":
        return frame
    planes = channel_planes(cfa, channel)
    if len(planes) == 1:
        (r, c) = planes[0]
        return frame[r::2, c::2]
    rows = np.empty((frame.shape[0], frame.shape[1] // 2), frame.dtype)
    for r, c in planes:
        rows[r::2] = frame[r::2, c::2]
    return rows
