"""As much of a survey as tells whether pixels differ, before all frames are read."""

from __future__ import annotations

from hsnoise.frames.lazy import is_dask
from hsnoise.frames.stack import FrameStack
from hsnoise.statistics.pixels.survey import Survey, survey

PROBE_PIXELS, PROBE_FRAMES = 1 << 20, 16  # of each exposure
OF_LARGE = 1 << 19  # pixels of each exposure of larger frames: the probe is in memory beside the survey of the whole


def surveyed(stack: FrameStack) -> Survey:
    """A survey of the stack, or of part of a large one: enough to see whether pixels differ."""
    if any(is_dask(counts) for counts in stack.counts):  # part of a block takes as long to read as all of it
        return survey(stack)
    rows, columns = stack.shape
    frames = slice(0, PROBE_FRAMES)
    if rows * columns <= PROBE_PIXELS:
        return survey(stack if max(stack.n_frames) <= PROBE_FRAMES else stack.select(frames=frames))
    kept = max(OF_LARGE // columns // 4 * 4, 32)
    first = max((rows - kept) // 8 * 4, 0)
    return survey(stack.select(rows=(first, min(first + kept, rows)), frames=frames))


def all_of(stack: FrameStack, found: Survey) -> Survey:
    """The survey of the whole stack; `found` if that already covers it."""
    frames = tuple(group.n_frames for group in found.groups)
    return found if (found.shape, frames) == (stack.shape, stack.n_frames) else survey(stack)
