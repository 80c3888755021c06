"""Reading one frame of a `FrameStack`: its name, checks, orientation, and errors."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from hsnoise.frames.checks import check_values
from hsnoise.frames.lazy import LazyFrames


def check_frame(frame: np.ndarray, stack: Any, *, exposure: int, frame_number: int) -> None:
    """Check the values of one raw frame `[row, column]` of a stack, DN.

    `FrameStack.frame` and `frames` check every lazy frame that they read, the constructor every frame in memory.

    Raises:
        ValueError: values that are not finite, not integers, negative, all the same, or mostly at the white
            level; the message names the file (or the exposure) and the frame.
    """
    check_values(frame, white_level=stack.white_level, name=frame_name(stack, exposure, frame_number))


def frame_name(stack: Any, exposure: int, number: int) -> str:
    """The name of a frame in error messages: its file, or its position in the stack."""
    counts = stack.counts[exposure]
    if isinstance(counts, LazyFrames):
        return counts.names[number]
    where = counts.filename if isinstance(counts, np.memmap) else "counts"
    return f"{where}: frame {number} of {stack.kind[exposure]} exposure {exposure} ({stack.exposure_s[exposure]:g} s)"


def in_sensor_orientation(frame: np.ndarray, row_axis: int) -> np.ndarray:
    """Contiguous uint16, or int32 where the stored type is signed, floating or wider than 16 bits."""
    dtype = np.uint16 if frame.dtype.kind == "u" and frame.dtype.itemsize <= 2 else np.int32
    return np.ascontiguousarray(frame.T if row_axis == 1 else frame, dtype)


@contextmanager
def while_reading(name: str) -> Iterator[None]:
    """Raise RuntimeError if the cluster that computes the frames from `name` on is lost.

    Other errors, such as those of a chunk's reader, pass with a note that names the frame.
    """
    try:
        yield
    except Exception as error:
        if type(error).__module__.partition(".")[0] != "distributed":  # by name: it may not be installed
            error.add_note(f"while reading {name} or a frame after it")
            raise
        raise RuntimeError(
            f"{name}: lost the cluster that was reading this frame or some after it ({type(error).__name__});"
            " start it again, and run this once more"
        ) from error
