"""One frame of a `FrameStack`: its name, its checks, its orientation, and what to say if it cannot be read."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from hsnoise.frames.checks import check_values
from hsnoise.frames.lazy import LazyFrames


def check_frame(frame: np.ndarray, stack: Any, *, exposure: int, frame_number: int) -> None:
    """Check the values of one raw frame `[row, column]` of a stack, DN.

    `FrameStack.frame` and `frames` do so for every lazy frame they read, the constructor for every frame in
    memory.

    Raises:
        ValueError: values that are not finite, not integers, negative, all the same, or mostly at the white
            level; the message names the file (or the exposure) and the frame.
    """
    check_values(frame, white_level=stack.white_level, name=frame_name(stack, exposure, frame_number))


def frame_name(stack: Any, exposure: int, number: int) -> str:
    """A frame as error messages call it: its file, or its place in the stack."""
    counts = stack.counts[exposure]
    if isinstance(counts, LazyFrames):
        return counts.names[number]
    return f"counts: frame {number} of {stack.kind[exposure]} exposure {exposure} ({stack.exposure_s[exposure]:g} s)"


def in_sensor_orientation(frame: np.ndarray, row_axis: int) -> np.ndarray:
    """Contiguous uint16, or int32 where the stored type is signed, floating or wider than 16 bits."""
    dtype = np.uint16 if frame.dtype.kind == "u" and frame.dtype.itemsize <= 2 else np.int32
    return np.ascontiguousarray(frame.T if row_axis == 1 else frame, dtype)


@contextmanager
def while_reading(name: str) -> Iterator[None]:
    """Raise RuntimeError if the cluster is lost that computes frames, the first of them called `name`.

    Other errors pass, those of whoever reads the chunks, say, with a note of where it was.
    """
    try:
        yield
    except Exception as error:
        if type(error).__module__.partition(".")[0] != "distributed":  # which is imported only by those who use it
            error.add_note(f"while {name}, or a frame after it, was read")
            raise
        raise RuntimeError(
            f"{name}: the cluster was lost that this frame, or some after it, was read on ({type(error).__name__});"
            " start it again, and run this once more"
        ) from error


def is_dask(counts: Any) -> bool:
    return hasattr(counts, "__dask_graph__")


def checked(frame: np.ndarray, name: str, white_level: float | None, row_axis: int, function: Callable) -> Any:
    check_values(frame, white_level=white_level, name=name)
    return function(in_sensor_orientation(frame, row_axis))
