"""Passes over frames. Those of a Dask array are read, checked and reduced where its scheduler runs, such as on the
workers of a cluster; other frames here, one after the other."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import numpy as np

from hsnoise.frames.checks import check_values
from hsnoise.frames.lazy import is_dask
from hsnoise.frames.reading import frame_name, in_sensor_orientation, while_reading

BATCH = 64  # frames of a Dask array that its scheduler is given at a time
MOST_MIB = 256  # of frames that come back whole at a time
Kept = TypeVar("Kept")


def whole_frames(stack: Any, exposure: int) -> Iterator[np.ndarray]:
    """The frames of an exposure in order: of a Dask array several are read at a time, else one."""
    if not is_dask(counts := stack.counts[exposure]):
        yield from (stack.frame(exposure, number) for number in range(counts.shape[0]))
        return
    mib = counts.dtype.itemsize * float(np.prod(counts.shape[1:])) / 2**20
    at_a_time = int(np.clip(MOST_MIB / mib, 2, BATCH))
    blocks = _blocks(counts, range(counts.shape[0]))
    for start in range(0, counts.shape[0], at_a_time):
        numbers = range(counts.shape[0])[start : start + at_a_time]
        yield from _computed(stack, exposure, blocks, numbers, _itself)


def map_frames(
    stack: Any,
    exposure: int,
    function: Callable[[np.ndarray], Any],
    combine: Callable[[Any, Any], Any] | None = None,
    chosen: Sequence[int] | None = None,
) -> Iterator[Any]:
    """See `FrameStack.map_frames`."""
    counts = stack.counts[exposure]
    chosen = range(counts.shape[0]) if chosen is None else chosen
    if not is_dask(counts):
        yield from (function(stack.frame(exposure, number)) for number in chosen)
        return
    blocks = _blocks(counts, chosen)
    for start in range(0, len(chosen), BATCH):
        yield from _computed(stack, exposure, blocks, chosen[start : start + BATCH], function, combine)


def fold_frames(
    stack: Any,
    exposure: int,
    start: Callable[[], Kept],
    add: Callable[[Kept, np.ndarray, int], Kept],
    merge: Callable[[Kept, Kept], Kept],
    tick: Callable[[], object],
) -> Kept:
    """See `FrameStack.fold_frames`."""
    counts, total = stack.counts[exposure], start()
    everything = range(counts.shape[0])
    if not is_dask(counts):
        for number in everything:
            total = add(total, stack.frame(exposure, number), number)
            tick()
        return total
    blocks = _blocks(counts, everything)
    for first in everything[::BATCH]:
        numbers = everything[first : first + BATCH]
        of_frame = [_OfOne(start, add, number) for number in numbers]
        (part,) = _computed(stack, exposure, blocks, numbers, of_frame, merge)
        total = merge(total, part)
        for _ in numbers:
            tick()
    return total


class _OfOne:
    """What is kept of one frame, for `fold_frames`; travels to a worker."""

    def __init__(self, start: Callable[[], Any], add: Callable[[Any, np.ndarray, int], Any], number: int):
        self.start, self.add, self.number = start, add, number

    def __call__(self, frame: np.ndarray) -> Any:
        return self.add(self.start(), frame, self.number)


def _itself(frame: np.ndarray) -> np.ndarray:
    return frame


def _blocks(counts: Any, numbers: Sequence[int]) -> dict[int, Any]:
    """The frames of these numbers, each a block [1, row, column] to be computed; one walk over the array's graph."""
    chosen = counts if len(numbers) == counts.shape[0] else counts[np.asarray(numbers)]
    blocks = chosen.rechunk((1, *counts.shape[1:])).to_delayed().ravel()
    return dict(zip(numbers, blocks, strict=True))


def _computed(
    stack: Any,
    exposure: int,
    blocks: dict[int, Any],
    numbers: Sequence[int],
    function: Callable[[np.ndarray], Any] | Sequence[Callable[[np.ndarray], Any]],
    combine: Callable[[Any, Any], Any] | None = None,
) -> Sequence[Any]:
    """The function, or that of each frame, of some frames of a Dask array; one result if `combine` adds two up."""
    import dask  # only needed for Dask arrays

    names = [frame_name(stack, exposure, number) for number in numbers]
    functions = [function] * len(numbers) if callable(function) else function
    tasks = [
        dask.delayed(_reduced)(blocks[number], name, stack.white_level, stack.row_axis, of_frame)
        for number, name, of_frame in zip(numbers, names, functions, strict=True)
    ]
    while combine is not None and len(tasks) > 1:
        pairs = zip(tasks[::2], tasks[1::2], strict=False)
        tasks = [dask.delayed(combine)(*pair) for pair in pairs] + tasks[len(tasks) // 2 * 2 :]
    with while_reading(names[0]):
        return dask.compute(*tasks)


def _reduced(
    block: np.ndarray, name: str, white_level: float | None, row_axis: int, function: Callable[[np.ndarray], Any]
) -> Any:
    frame = block[0]
    check_values(frame, white_level=white_level, name=name)
    return function(in_sensor_orientation(frame, row_axis))
