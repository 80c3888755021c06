"""One exposure read into memory and split by an analysis of variance over frames, rows and columns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hsnoise._core.types import cfa_tile, channels_of
from hsnoise.frames.stack import FrameStack

MOST_PIXELS = 1 << 25  # of one exposure: 32 Mpixel, about 0.7 GB at work
MOST_FRAME_PIXELS = 1 << 22  # of one frame
FEWEST_FRAMES = 4
SMALLEST = 32  # rows and columns
GAUSSIAN_ABS = np.sqrt(2 / np.pi)  # mean |x| of a standard normal x
BOUND = 5.0
MOST_CODES = 1 << 16


@dataclass(frozen=True)
class Layout:
    """Everything that determines which statistics exist; it never depends on the counts.

    exposures: dark exposure groups in order of time; frames: how many of each are used; rows, columns: the used part.
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
        """Colour of each plane; planes are numbered row by row in the 2x2 cell."""
        return ("mono",) if self.cfa == "mono" else tuple(self.cfa)


@dataclass(frozen=True)
class Exposure:
    """Analysis of variance of the counts above black [plane, frame, row, column] of one exposure, DN.

    mean [plane], frame [plane, frame], row_frame [plane, frame, row], column_frame [plane, frame, column],
    row [plane, row], column [plane, column], pixel [plane, row, column] (the static map) and a residual add up to the
    counts. scale [plane, frame, row] is the spread of the residual in each row, from its mean absolute value (in the
    rms a cosmic hit would hide itself); residual [plane, frame, row, column] is divided by it, bounded is cut at +-5.
    variance [plane] is the residual's, DN^2. codes: first code and histogram of counts [code] of each plane.

    A single frame cannot separate static from temporal: row_frame, column_frame and residual then equal row, column
    and pixel.
    """

    mean: np.ndarray
    frame: np.ndarray
    row_frame: np.ndarray
    column_frame: np.ndarray
    row: np.ndarray
    column: np.ndarray
    pixel: np.ndarray
    scale: np.ndarray
    residual: np.ndarray
    bounded: np.ndarray
    variance: np.ndarray
    codes: tuple[tuple[int, np.ndarray], ...]

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """(planes, frames, rows, columns); rows and columns of a plane."""
        return self.residual.shape


def check_size(stack: FrameStack) -> None:
    """Raise ValueError for frames too small to separate rows from pixels."""
    if min(stack.shape) < SMALLEST:
        rows, columns = stack.shape
        raise ValueError(f"stack: expected frames of at least {SMALLEST} x {SMALLEST} pixels, got {rows} x {columns}")


def layout_of(stack: FrameStack, kind: str = "dark") -> Layout:
    """The exposures of a kind, frames and pixels of a stack that are used, and sentences on what is skipped."""
    chosen = [i for i, one in enumerate(stack.kind) if one == kind]
    chosen.sort(key=lambda i: stack.exposure_s[i])
    if not chosen:
        raise ValueError("structure: expected at least one dark exposure, got none; its statistics need dark frames")
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
    """The middle of a frame that is too large to use whole; starts and sizes keep pairs of Bayer cells intact."""
    shrink = min(1.0, np.sqrt(MOST_FRAME_PIXELS / (shape[0] * shape[1])))
    if shrink == 1.0:
        return slice(0, shape[0]), slice(0, shape[1])
    sizes = [int(n * shrink) // 4 * 4 for n in shape]
    starts = [(n - size) // 8 * 4 for n, size in zip(shape, sizes, strict=True)]
    return slice(starts[0], starts[0] + sizes[0]), slice(starts[1], starts[1] + sizes[1])


def read_exposure(stack: FrameStack, layout: Layout, number: int, black_level_dn: np.ndarray) -> Exposure:
    """Read and analyse exposure `number` of the layout; black_level_dn [channel] or a scalar, DN."""
    tile = cfa_tile(layout.cfa)
    black = np.broadcast_to(np.asarray(black_level_dn, np.float64), (len(channels_of(layout.cfa)),))[tile.ravel()]
    step = len(tile)
    counts = None
    for f in range(layout.frames[number]):
        frame = stack.frame(layout.exposures[number], f)[layout.rows, layout.columns]
        if counts is None:
            size = (step**2, layout.frames[number], frame.shape[0] // step, frame.shape[1] // step)
            counts = np.empty(size, np.int32)
        for p in range(step**2):
            r, c = divmod(p, step)
            counts[p, f] = frame[r::step, c::step]
    codes = tuple(_histogram(plane) for plane in counts)
    signal = counts.astype(np.float32)
    signal -= black.astype(np.float32)[:, None, None, None]
    return analyse(signal, codes)


def _histogram(counts: np.ndarray) -> tuple[int, np.ndarray]:
    low = int(counts.min())
    return low, np.bincount(np.minimum(counts.ravel() - low, MOST_CODES))


def analyse(signal: np.ndarray, codes: tuple[tuple[int, np.ndarray], ...]) -> Exposure:
    """The analysis of variance of `signal` [plane, frame, row, column], DN, which is overwritten."""
    planes, frames, rows, columns = signal.shape
    row_frame, column_frame = signal.mean(3), signal.mean(2)
    frame = row_frame.mean(2, dtype=np.float64)
    pixel = signal.mean(1)
    mean = frame.mean(1)
    row_frame -= frame[..., None].astype(np.float32)
    column_frame -= frame[..., None].astype(np.float32)
    row, column = row_frame.mean(1), column_frame.mean(1)
    if frames > 1:
        signal -= pixel[:, None]
        row_frame -= row[:, None]
        column_frame -= column[:, None]
        signal -= (row_frame + (frame - mean[:, None])[..., None].astype(np.float32))[..., None]
        signal -= column_frame[:, :, None]
    pixel -= mean.astype(np.float32)[:, None, None]
    pixel -= row[:, :, None]
    pixel -= column[:, None]
    residual = signal if frames > 1 else pixel[:, None].copy()
    dof = max(frames - 1, 1) * (rows - 1) * (columns - 1)
    variance = np.einsum("pfrc,pfrc->pfr", residual, residual).sum((1, 2), dtype=np.float64) / dof
    scale = np.abs(residual).mean(3) / np.float32(GAUSSIAN_ABS)
    # A row without noise (gain 0, all clipped) must not be amplified.
    scale = np.maximum(scale, 0.05 * scale.mean((1, 2), keepdims=True) + np.float32(1e-3))
    residual /= scale[..., None]
    return Exposure(
        mean=mean,
        frame=frame - mean[:, None],
        row_frame=row_frame,
        column_frame=column_frame,
        row=row,
        column=column,
        pixel=pixel,
        scale=scale,
        residual=residual,
        bounded=np.clip(residual, -BOUND, BOUND),
        variance=variance,
        codes=codes,
    )
