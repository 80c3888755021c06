"""Overscan: columns or rows at the edge of a frame that see no light, or are read without pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hsnoise._core.arguments import span
from hsnoise._core.naming import named, setting
from hsnoise.frames.io._recording import Recording
from hsnoise.frames.joining import replaced
from hsnoise.frames.stack import FrameStack

LEAST, MOST = 3, 128  # columns of an overscan
WIDEST = 0.25  # of the frame: a wider strip is not an edge
UNLIT, LIT = 0.3, 0.7  # of the signal beside it
LEAST_LIGHT, BESIDE = 0.3, 32  # of the median signal beside an overscan, in so many lines
BLURRED = 3  # columns at most between unlit and lit: vignetting is more gradual
LEAST_SIGNAL_DN = 10.0
SOME_FRAMES = 3  # of a group, from which the mean of its overscan is taken

Overscan = str | tuple[Any, Any] | None


@dataclass(frozen=True)
class Strip:
    """Rows (axis 0) or columns (axis 1) from `start` to `stop` (excluded) at an edge of a frame with `size` of them."""

    axis: int
    start: int
    stop: int
    size: int

    def __str__(self) -> str:
        which = "first" if self.start == 0 else "last"
        return f"the {which} {self.stop - self.start} {('rows', 'columns')[self.axis]}"

    @property
    def rest(self) -> tuple[int, int]:
        """The rest of the axis."""
        return (self.stop, self.size) if self.start == 0 else (0, self.start)

    def pixels(self, frame: np.ndarray) -> np.ndarray:
        """Pixels of the outer half of the strip in a frame [row, column]; the inner half holds charge left behind."""
        margin = (self.stop - self.start) // 2
        start, stop = (self.start, self.stop - margin) if self.start == 0 else (self.start + margin, self.stop)
        return frame[start:stop] if self.axis == 0 else frame[:, start:stop]


def with_overscan(stack: FrameStack, overscan: Overscan, read: Sequence[Recording] = ()) -> FrameStack:
    """The stack without its overscan, whose means are kept in `overscan_dn`; None keeps it and only names it.

    Args:
        stack: frames.
        overscan: "auto": find it; ((first row, end row), (first column, end column)) of the overscan, None for
            all rows or all columns; None: only name what is found.
        read: the frames' recordings, whose headers may name the overscan.

    Raises:
        ValueError: `overscan` is none of these, or not at an edge.
    """
    if overscan is not None and not isinstance(overscan, str):
        return _without(stack, [_given(overscan, stack.shape)])
    if overscan not in (None, "auto"):
        raise ValueError(f"{named('overscan')}: expected 'auto', None or spans of rows and columns, got {overscan!r}")
    strips = find(stack) or stated(stack, read)
    if overscan == "auto" and strips:
        return _without(stack, strips)
    told = [f"{str(one).capitalize()} look like overscan: {setting('overscan', 'auto')} removes them" for one in strips]
    return replaced(stack, assumed=(*stack.assumed, *told)) if told else stack


def find(stack: FrameStack) -> list[Strip]:
    """Strips at the edges that do not follow the light of the brightest flats; none without flats."""
    flats = [i for i, kind in enumerate(stack.kind) if kind == "flat"]
    if not flats:
        return []
    dark = [i for i, kind in enumerate(stack.kind) if kind == "dark"][:1] or flats[:1]
    brightest = max(flats, key=lambda i: (stack.exposure_s[i], i))
    lit = stack.frame(brightest, 0).astype(float)
    signal = lit - stack.frame(dark[0], 0) if dark[0] != brightest else lit
    if np.median(signal) < LEAST_SIGNAL_DN:
        return []
    period = 1 if stack.cfa == "mono" else 2
    strips = []
    for axis in (0, 1):
        profile = signal.mean(1 - axis)
        profile = profile[: len(profile) // period * period].reshape(-1, period).mean(1) / np.median(profile)
        size = stack.shape[axis]
        first, last = (_dark_end(one) * period for one in (profile, profile[::-1]))
        if first:
            strips.append(Strip(axis, 0, first, size))
        if last:
            strips.append(Strip(axis, size - last, size, size))
    return strips


def _dark_end(profile: np.ndarray) -> int:
    """The number of dark values at the start, if the step to lit values is sharp; otherwise 0."""
    first_lit = int(np.argmax(profile > UNLIT * LEAST_LIGHT))  # the level of an overscan may fall with the light
    beside = float(np.median(profile[first_lit : first_lit + BESIDE]))  # light may fall toward the edge
    if beside < LEAST_LIGHT:
        return 0
    unlit, lit = np.abs(profile) < UNLIT * beside, profile > LIT * beside
    if unlit.all() or not lit.any():
        return 0
    n, until = int(np.argmin(unlit)), int(np.argmax(lit))
    is_edge = LEAST <= n <= min(MOST, WIDEST * len(profile)) and until - n <= BLURRED
    return until if is_edge else 0


def stated(stack: FrameStack, read: Sequence[Recording]) -> list[Strip]:
    """The overscan in the headers, if all agree. Without flats it cannot be verified."""
    sections = {recording.overscan for recording in read}
    if len(sections) != 1 or None in sections or "flat" in stack.kind:
        return []
    spans = sections.pop()
    try:
        return [_given(spans[::-1] if stack.row_axis == 1 else spans, stack.shape)]
    except ValueError:  # a header of frames that were cropped
        return []


def levels_dn(stack: FrameStack, strips: Sequence[Strip]) -> np.ndarray:
    """Mean overscan of each group [exposure], DN, over up to SOME_FRAMES of its frames."""
    means = []
    for i, n in enumerate(stack.n_frames):
        frames = [stack.frame(i, j) for j in sorted({k * (n - 1) // (SOME_FRAMES - 1) for k in range(SOME_FRAMES)})]
        means.append(np.mean([strip.pixels(frame).mean() for frame in frames for strip in strips]))
    return np.array(means)


def _given(overscan: Any, shape: tuple[int, int]) -> Strip:
    """Spans of rows and columns as a strip. Raises ValueError unless they form a strip at an edge."""
    if not isinstance(overscan, Sequence) or len(overscan) != 2:
        raise ValueError(
            f"{named('overscan')}: expected ((first row, end row), (first column, end column)), got {overscan!r}"
        )
    spans = [span("overscan", one, size) for one, size in zip(overscan, shape, strict=True)]
    narrow = [axis for axis, one in enumerate(spans) if one.stop - one.start < shape[axis]]
    if len(narrow) == 1:
        axis = narrow[0]
        strip = Strip(axis, spans[axis].start, spans[axis].stop, shape[axis])
        if strip.start == 0 or strip.stop == strip.size:
            return strip
    raise ValueError(
        f"{named('overscan')}: expected columns at an edge of all rows, or rows at an edge of all columns, got"
        f" {overscan!r} for frames of {shape[0]} x {shape[1]}"
    )


def without(shape: tuple[int, int], strips: Sequence[Strip]) -> list[tuple[int, int]]:
    """Spans of rows and columns that remain without the strips."""
    rest = [(0, size) for size in shape]
    for one in strips:
        rest[one.axis] = max(rest[one.axis][0], one.rest[0]), min(rest[one.axis][1], one.rest[1])
    return rest


def _without(stack: FrameStack, strips: Sequence[Strip]) -> FrameStack:
    rows, columns = without(stack.shape, strips)
    told = [f"{str(one).capitalize()} were removed as overscan" for one in strips]
    part = stack.select(rows=rows, columns=columns)
    return replaced(part, overscan_dn=levels_dn(stack, strips), assumed=(*part.assumed, *told))
