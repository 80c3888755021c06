"""Frames that are read one at a time, sorted by name, and crops of them."""

from __future__ import annotations

import mmap
import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np


def in_order(path: Path) -> list[Any]:
    """The sort key of frames: their names, with the numbers in them compared as numbers.

    dark2 comes before dark10, and dark_0.05s before dark_0.1s; with several points (1.2.10) each separates two numbers.
    """
    parts = re.split(r"((?<![\d.])\d+\.\d+(?![\d.])|\d+)", path.stem)
    return [[float(part) if i % 2 else part.lower() for i, part in enumerate(parts)], path.suffix.lower()]


class LazyFrames:
    """Frames that are read one at a time; used in place of an array `[frame, row, column]`.

    An int index reads that frame. A slice gives a lazy stack of those frames and reads nothing.

    Args:
        readers: one function per frame that returns the frame `[row, column]`.
        frame_shape: (rows, columns) that every frame must have.
        dtype: dtype of the stored counts.
        names: how errors name each frame, such as by its file.
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


def is_dask(counts: Any) -> bool:
    return hasattr(counts, "__dask_graph__")


def crop(counts: Any, rows: slice, columns: slice, *, frames: slice | None = None) -> Any:
    """Region of frames `[frame, row, column]` in stored orientation; reads and copies nothing."""
    chosen = slice(None) if frames is None else frames
    if isinstance(counts, np.ndarray) or is_dask(counts):
        return counts[chosen, rows, columns]
    indices = range(counts.shape[0])[chosen]
    readers = [partial(_read_region, counts, i, rows, columns) for i in indices]
    names = [counts.names[i] for i in indices] if isinstance(counts, LazyFrames) else None
    taken = [counts.taken[i] for i in indices] if isinstance(counts, LazyFrames) else None
    return LazyFrames(readers, (rows.stop - rows.start, columns.stop - columns.start), counts.dtype, names, taken)


def _read_region(counts: Any, index: int, rows: slice, columns: slice) -> np.ndarray:
    return np.asarray(counts[index])[rows, columns]


def read_mapped(counts: np.memmap, number: int) -> np.ndarray:
    """A copy of one frame of a memory map; its pages then no longer count as this process's memory."""
    frame = np.array(counts[number])
    mapping = getattr(counts, "_mmap", None)
    # Only for maps opened for reading: a private map would lose what was written to it.
    if mapping is not None and counts.mode == "r" and hasattr(mmap, "MADV_DONTNEED"):
        mapping.madvise(mmap.MADV_DONTNEED)
    return frame
