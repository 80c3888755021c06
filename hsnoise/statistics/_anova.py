"""Exposures read into memory and split by an analysis of variance over frames, rows and columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hsnoise._core.types import cfa_tile, channels_of
from hsnoise.frames.stack import FrameStack

MOST_PIXELS = 1 << 25  # of one exposure: 32 Mpixel, about 0.4 GB at work
MOST_FRAME_PIXELS = 1 << 22  # of one frame
FEWEST_FRAMES = 4
SMALLEST = 32  # rows and columns


@dataclass(frozen=True)
class Layout:
    """What decides which statistics there are: never a count.

    exposures: dark exposure groups in order of time; frames: how many of each are used; rows, columns: the part used.
    """

    cfa: str
    exposures: tuple[int, ...]
    exposure_s: np.ndarray
    frames: tuple[int, ...]
    rows: slice
    columns: slice
    skipped: tuple[str, ...]

    @property
    def letters(self) -> tuple[str, ...]:
        """Colour of each plane; planes are numbered along the rows of the 2x2 cell."""
        return ("mono",) if self.cfa == "mono" else tuple(self.cfa)


@dataclass(frozen=True)
class Lines:
    """Analysis of variance of the counts above black of exposures with one number of frames, DN, but its pixels.

    mean [exposure, plane], frame [exposure, plane, frame], row_frame [exposure, plane, frame, row],
    column_frame [exposure, plane, frame, column], row [exposure, plane, row], column [exposure, plane, column].

    With a single frame there is no difference between static and not: row_frame and column_frame hold what `row` and
    `column` hold.
    """

    mean: np.ndarray
    frame: np.ndarray
    row_frame: np.ndarray
    column_frame: np.ndarray
    row: np.ndarray
    column: np.ndarray


def check_size(stack: FrameStack) -> None:
    """Raise ValueError for frames too small to tell rows from pixels."""
    if min(stack.shape) < SMALLEST:
        rows, columns = stack.shape
        raise ValueError(f"stack: expected frames of at least {SMALLEST} x {SMALLEST} pixels, got {rows} x {columns}")


def layout_of(stack: FrameStack, kind: str = "dark") -> Layout:
    """Which exposures of a kind, frames and pixels of a stack are used, and sentences on what is not."""
    chosen = [i for i, one in enumerate(stack.kind) if one == kind]
    chosen.sort(key=lambda i: stack.exposure_s[i])
    if not chosen:
        raise ValueError("structure: expected at least one dark exposure, got none; its statistics are of dark frames")
    check_size(stack)
    rows, columns = _central(stack.shape)
    most = max(FEWEST_FRAMES, MOST_PIXELS // ((rows.stop - rows.start) * (columns.stop - columns.start)))
    frames = tuple(min(stack.n_frames[i], most) for i in chosen)
    skipped = []
    if (rows.stop - rows.start, columns.stop - columns.start) != stack.shape:
        skipped.append(f"Only rows {rows.start} to {rows.stop} and columns {columns.start} to {columns.stop} are used.")
    if any(n < stack.n_frames[i] for n, i in zip(frames, chosen, strict=True)):
        skipped.append(f"Only the first {most} frames of each exposure are used.")
    return Layout(stack.cfa, tuple(chosen), stack.exposure_s[chosen], frames, rows, columns, tuple(skipped))


def _central(shape: tuple[int, int]) -> tuple[slice, slice]:
    """The middle of a frame too large to use whole; starts and sizes keep Bayer cells and pairs of them."""
    shrink = min(1.0, np.sqrt(MOST_FRAME_PIXELS / (shape[0] * shape[1])))
    if shrink == 1.0:
        return slice(0, shape[0]), slice(0, shape[1])
    sizes = [int(n * shrink) // 4 * 4 for n in shape]
    starts = [(n - size) // 8 * 4 for n, size in zip(shape, sizes, strict=True)]
    return slice(starts[0], starts[0] + sizes[0]), slice(starts[1], starts[1] + sizes[1])


def shape_of(layout: Layout, numbers: Sequence[int]) -> tuple[int, int, int, int, int]:
    """(exposures, planes, frames, rows, columns) of exposures of the layout with one number of frames."""
    step = len(cfa_tile(layout.cfa))
    rows, columns = ((used.stop - used.start) // step for used in (layout.rows, layout.columns))
    return len(numbers), step**2, layout.frames[numbers[0]], rows, columns


def read_counts(stack: FrameStack, layout: Layout, numbers: Sequence[int], out: np.ndarray) -> None:
    """Counts [exposure, plane, frame, row, column] of exposures of the layout with one number of frames, DN."""
    n, planes, frames, rows, columns = out.shape
    step = 1 if planes == 1 else 2
    for i, f in np.ndindex(n, frames):
        frame = stack.frame(layout.exposures[numbers[i]], f)[layout.rows, layout.columns]
        cells = frame[: rows * step, : columns * step].reshape(rows, step, columns, step)
        out[i, :, f].reshape(step, step, rows, columns)[...] = cells.transpose(1, 3, 0, 2)


def signal_of(
    counts: np.ndarray, layout: Layout, black_level_dn: np.ndarray, out: np.ndarray | None = None
) -> np.ndarray:
    """Counts above black [exposure, plane, frame, row, column], DN; black_level_dn [channel] or a scalar, DN."""
    tile = cfa_tile(layout.cfa)
    black = np.broadcast_to(np.asarray(black_level_dn, np.float64), (len(channels_of(layout.cfa)),))[tile.ravel()]
    return np.subtract(counts, black.astype(np.float32)[:, None, None, None], out=out, dtype=np.float32)


def analyse(signal: np.ndarray) -> tuple[Lines, np.ndarray, np.ndarray]:
    """Lines, static map [exposure, plane, row, column] and residual of `signal`, DN, which is overwritten.

    Together they add up to the signal [exposure, plane, frame, row, column]. With a single frame the residual holds
    the static map.
    """
    frames, rows, columns = signal.shape[2:]
    # einsum adds neighbours several times as fast as mean.
    row_frame = np.einsum("epfrc->epfr", signal).astype(np.float64) / columns
    column_frame = np.einsum("epfrc->epfc", signal).astype(np.float64) / rows
    pixel = np.einsum("epfrc->eprc", signal) / np.float32(frames)
    frame = row_frame.mean(3)
    mean = frame.mean(2)
    row_frame -= frame[..., None]
    column_frame -= frame[..., None]
    row, column = row_frame.mean(2), column_frame.mean(2)
    frame = frame - mean[..., None]
    if frames > 1:
        row_frame -= row[:, :, None]
        column_frame -= column[:, :, None]
        signal -= pixel[:, :, None]
        signal -= (row_frame + frame[..., None]).astype(np.float32)[..., None]
        signal -= column_frame.astype(np.float32)[..., None, :]
    pixel -= (row + mean[..., None]).astype(np.float32)[..., None]
    pixel -= column.astype(np.float32)[:, :, None]
    residual = signal if frames > 1 else pixel[:, :, None].copy()
    return Lines(mean, frame, row_frame, column_frame, row, column), pixel, residual
