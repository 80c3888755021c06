"""What is kept of the pixels of an exposure: sums, maps and rare values, taken in few passes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache
from itertools import product
from typing import TypeVar

import numpy as np

from hsnoise.statistics._anova import Lines

GAUSSIAN_ABS = np.sqrt(2 / np.pi)  # mean |x| of a standard normal x
BOUND = 5.0
OUTLIER = 4.0
VARIANCE_FRAMES = 3  # fewest that give a variance over time
TAILS = (4.5, 7.0, 15.0, -4.0, -6.0)
LAGS = ((0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0), (2, 2), (2, -2), (0, 4), (4, 0))
GRID = 8
FAR = min(OUTLIER, *map(abs, TAILS))
Record = TypeVar("Record", bound=Lines)


@dataclass(frozen=True)
class Exposure(Lines):
    """An exposure's lines and what is kept of its pixels; of several exposures all have a leading axis.

    pixel [plane, row, column]: the static map, DN. scale [plane, frame, row]: spread of the residual in each row, DN,
    from its mean absolute value (by rms a cosmic hit would hide itself). variance [plane]: of the residual, DN^2.

    In units of `scale`: noise [plane, row, column], mean of |residual|, and temporal [plane, row, column], its
    variance over time, empty with less than three frames; far [tail] and outliers [plane, row, column], how many
    values lie beyond TAILS and, of the frames of each pixel, beyond OUTLIER. Of the residual cut at +-5:
    powers [plane, 3], means of its square, cube and fourth power; lags [lag], mean products; later, mean product with
    the next frame; grid [plane, frame, 8, 8], sums over blocks, in units of the root of their pixels.

    codes [plane, 4]: see `histogram_shape`.

    half_pixel, half_temporal [parity, plane, row, column]: pixel and temporal of the even and of the odd frames; empty
    where they are not asked for.
    """

    pixel: np.ndarray
    scale: np.ndarray
    variance: np.ndarray
    noise: np.ndarray
    temporal: np.ndarray
    far: np.ndarray
    outliers: np.ndarray
    powers: np.ndarray
    lags: np.ndarray
    later: np.ndarray
    grid: np.ndarray
    codes: np.ndarray
    half_pixel: np.ndarray
    half_temporal: np.ndarray

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """(planes, frames, rows, columns) of each exposure; rows and columns of a plane."""
        planes, frames, rows = self.row_frame.shape[-3:]
        return planes, frames, rows, self.column_frame.shape[-1]

    @cached_property
    def map(self) -> np.ndarray:
        """The static map in units of its own robust spread."""
        return normalised(self.pixel)

    @cached_property
    def bounded_map(self) -> np.ndarray:
        return np.clip(self.map, -BOUND, BOUND)

    @cached_property
    def log_temporal(self) -> np.ndarray:
        return np.log(self.temporal)


def normalised(pixel: np.ndarray) -> np.ndarray:
    """A map [..., row, column] in units of its robust spread."""
    spread = np.abs(pixel).mean((-2, -1), keepdims=True) * np.float32(1 / GAUSSIAN_ABS)
    return pixel / (spread + np.float32(1e-6))


def inner(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Sum over pixels of the products of maps a and b [..., row, column]; rows in their precision, then float64."""
    return np.einsum("...rc,...rc->...r", a, b).sum(-1, dtype=np.float64)


def stacked(ones: Sequence[Record]) -> Record:
    """Records of exposures of one shape as one, with a leading axis [exposure]."""
    kind = type(ones[0])
    return kind(**{one.name: np.stack([getattr(x, one.name) for x in ones]) for one in fields(kind)})


def exposure_of(lines: Lines, pixel: np.ndarray, residual: np.ndarray, codes: np.ndarray, *, halves: bool) -> Exposure:
    """Sums over the residual [plane, frame, row, column], DN, which is overwritten.

    codes [plane, 4]: of `histogram_shape`. halves: whether even and odd frames are compared.
    """
    planes, frames, rows, columns = residual.shape
    squares = np.einsum("pfrc,pfrc->pfr", residual, residual).sum((1, 2), dtype=np.float64)
    size = np.abs(residual)  # the one array as large as the residual: used again below
    scale = np.einsum("pfrc->pfr", size) / np.float32(GAUSSIAN_ABS * columns)
    # A row without noise (gain 0, all clipped) must not blow up what little it has.
    scale = np.maximum(scale, 0.05 * scale.mean((1, 2), keepdims=True) + np.float32(1e-3))
    residual /= scale[..., None]
    half_pixel, half_temporal = _halves(residual, scale, pixel) if halves else (np.zeros(0), np.zeros(0))
    temporal = temporal_variance(residual)
    np.abs(residual, out=size)
    at = np.flatnonzero(size.ravel() >= FAR)
    far = residual.ravel()[at]
    noise = np.einsum("pfrc->prc", np.minimum(size, np.float32(BOUND), out=size)) / np.float32(frames)
    bounded = np.clip(residual, -BOUND, BOUND, out=residual)
    square = np.multiply(bounded, bounded, out=size)
    powers = [np.einsum("pfrc->pfr", square), *(np.einsum("pfrc,pfrc->pfr", square, x) for x in (bounded, square))]
    later = np.einsum("pfrc,pfrc->pfr", bounded[:, 1:], bounded[:, :-1]).sum(dtype=np.float64)
    return Exposure(
        **vars(lines),
        pixel=pixel,
        scale=scale.astype(np.float64),
        variance=squares / (max(frames - 1, 1) * (rows - 1) * (columns - 1)),
        noise=noise,
        temporal=temporal,
        far=beyond_tails(far),
        outliers=_frames_with(at[np.abs(far) > OUTLIER], residual.shape),
        powers=np.stack([power.sum((1, 2), dtype=np.float64) for power in powers], 1) / (frames * rows * columns),
        lags=np.array([lag_product(bounded, lag).mean() for lag in LAGS]),
        later=later / max(planes * (frames - 1) * rows * columns, 1),
        grid=grid_of(bounded),
        codes=codes,
        half_pixel=half_pixel,
        half_temporal=half_temporal,
    )


def temporal_variance(residual: np.ndarray) -> np.ndarray:
    """Mean square over the frames, dof counted, of a residual [plane, frame, row, column] of mean 0; kept from 0."""
    frames = residual.shape[1]
    if frames < VARIANCE_FRAMES:
        return np.zeros(0, np.float32)
    return np.einsum("pfrc,pfrc->prc", residual, residual) / np.float32(frames - 1) + np.float32(1e-3)


def _halves(residual: np.ndarray, scale: np.ndarray, pixel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Static map, DN, and variance over time of the even and of the odd frames: [parity, plane, row, column]."""
    some = [residual[:, parity::2] for parity in (0, 1)]
    pixels = [pixel + np.einsum("pfrc,pfr->prc", x, scale[:, parity::2]) / x.shape[1] for parity, x in enumerate(some)]
    fewest = residual.shape[1] // 2
    some = [x - x.mean(1, keepdims=True) if fewest >= VARIANCE_FRAMES else x[:, :0] for x in some]
    return np.stack(pixels), np.stack([temporal_variance(x) for x in some])


def beyond_tails(values: np.ndarray) -> np.ndarray:
    """How many values lie beyond each of TAILS."""
    return np.array([np.count_nonzero(values > limit if limit > 0 else values < limit) for limit in TAILS])


def _frames_with(places: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Number of frames [plane, row, column] among flat places in [plane, frame, row, column]."""
    planes, frames, rows, columns = shape
    plane, pixel = places // (frames * rows * columns), places % (rows * columns)
    number = np.bincount(plane * rows * columns + pixel, minlength=planes * rows * columns)
    return number.astype(np.uint16).reshape(planes, rows, columns)


def lag_product(x: np.ndarray, lag: tuple[int, int]) -> np.ndarray:
    """Mean product [n] of pixels `lag` (rows, columns of the sensor) apart, from planes x [plane, n, row, column]."""
    step = 1 if len(x) == 1 else 2
    x = x.reshape(step, step, *x.shape[1:])
    total, size = np.zeros(x.shape[2]), 0
    for (r, next_r, rows), (c, next_c, columns) in product(_neighbours(lag[0], step), _neighbours(lag[1], step)):
        a = x[r, c, :, : x.shape[3] - rows, max(-columns, 0) : x.shape[4] - max(columns, 0)]
        b = x[next_r, next_c, :, rows:, max(columns, 0) : x.shape[4] + min(columns, 0)]
        total += np.einsum("ijnrc,ijnrc->ijnr", a, b).sum((0, 1, 3), dtype=np.float64)
        size += a.size // len(total)
    return total / size


@lru_cache
def _neighbours(lag: int, step: int) -> list[tuple[slice, slice, int]]:
    """Parities of lines, those of their neighbours `lag` lines on, and how many lines of the plane lie between."""
    if lag % step == 0:
        return [(slice(None), slice(None), lag // step)]
    ends = [(line, *divmod(line + lag, step)) for line in range(step)]
    return [(slice(line, line + 1), slice(after, after + 1), apart) for line, apart, after in ends]


def grid_of(x: np.ndarray) -> np.ndarray:
    """Sums over an 8 x 8 grid of blocks of x [..., row, column], in units of the root of their pixels."""
    rows, columns = x.shape[-2] // GRID, x.shape[-1] // GRID
    x = x[..., : rows * GRID, : columns * GRID]
    # Rows first: sums over short runs of neighbours are slow.
    over_rows = x.reshape(*x.shape[:-2], GRID, rows, columns * GRID).sum(-2)
    over_columns = over_rows.reshape(*x.shape[:-2], GRID, GRID, columns).sum(-1)
    return over_columns / np.float32(np.sqrt(rows * columns))
