"""What is kept of the pixels of exposures: sums, maps and rare values, taken in few passes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache
from itertools import product

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


@dataclass(frozen=True)
class Exposures(Lines):
    """Lines of exposures with one number of frames, and what is kept of their pixels.

    pixel [exposure, plane, row, column]: the static map, DN. scale [exposure, plane, frame, row]: spread of the
    residual in each row, DN, from its mean absolute value (by rms a cosmic hit would hide itself).
    variance [exposure, plane]: of the residual, DN^2.

    In units of `scale`: noise [exposure, plane, row, column], mean of |residual|, cut at 5, and temporal, its variance
    over time, empty with less than three frames; far [exposure, tail] and outliers [exposure, plane, row, column], how
    many values lie beyond TAILS and, of the frames of each pixel, beyond OUTLIER. Of the residual cut at +-5:
    powers [exposure, plane, 3], means of its square, cube and fourth power; lags [exposure, lag], mean products;
    later [exposure], mean product with the next frame; grid [exposure, plane, frame, 8, 8], sums over blocks, in units
    of the root of their pixels. codes [exposure, plane, 5]: see `histogram_shape`.

    half_pixel, half_temporal [exposure, parity, plane, row, column]: pixel and temporal of the even and of the odd
    frames; empty where they are not asked for.
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
        return *self.row_frame.shape[1:], self.column_frame.shape[-1]

    @cached_property
    def map(self) -> np.ndarray:
        """The static map in units of its own robust spread."""
        return normalised(self.pixel)

    @cached_property
    def bounded_map(self) -> np.ndarray:
        return np.clip(self.map, -BOUND, BOUND)

    @cached_property
    def far_on_map(self) -> np.ndarray:
        """How many values of the static map lie beyond TAILS: [exposure, tail]."""
        flat = self.map.reshape(len(self.map), -1)
        at = np.flatnonzero(np.abs(flat) >= FAR)
        return _beyond_tails(flat.ravel()[at], at // flat.shape[1], len(flat))


def normalised(pixel: np.ndarray) -> np.ndarray:
    """A map [..., row, column] in units of its robust spread."""
    spread = np.abs(pixel).mean((-2, -1), keepdims=True) * np.float32(1 / GAUSSIAN_ABS)
    return pixel / (spread + np.float32(1e-6))


def inner(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Sum over pixels of the products of maps a and b [..., row, column]; rows in their precision, then float64."""
    return np.einsum("...rc,...rc->...r", a, b).sum(-1, dtype=np.float64)


def joined(some: Sequence[Exposures]) -> Exposures:
    """Exposures of one shape together."""
    if len(some) == 1:
        return some[0]
    return Exposures(**{one.name: np.concatenate([getattr(x, one.name) for x in some]) for one in fields(Exposures)})


def exposures_of(
    lines: Lines, pixel: np.ndarray, residual: np.ndarray, codes: np.ndarray, spare: np.ndarray, *, halves: bool
) -> Exposures:
    """Sums over the residual [exposure, plane, frame, row, column], DN; it and `spare`, as large, are overwritten.

    codes [exposure, plane, 5]: of `histogram_shape`. halves: whether even and odd frames are compared.
    """
    n, _, frames, rows, columns = residual.shape
    squares = np.einsum("epfrc,epfrc->epfr", residual, residual).sum((2, 3), dtype=np.float64)
    size = np.abs(residual, out=spare)
    scale = np.einsum("epfrc->epfr", size) / np.float32(GAUSSIAN_ABS * columns)
    # A row without noise (gain 0, all clipped) must not blow up what little it has.
    scale = np.maximum(scale, 0.05 * scale.mean((2, 3), keepdims=True) + np.float32(1e-3))
    residual /= scale[..., None]
    half_pixel, half_temporal = _halves(residual, scale, pixel) if halves else (np.zeros((n, 0)),) * 2
    temporal = _temporal_variance(residual)
    np.abs(residual, out=size)
    at = np.flatnonzero(size >= FAR)
    far = residual.ravel()[at]
    # Few values lie far out: bound those alone.
    bounded = residual
    bounded.reshape(-1)[at], size.reshape(-1)[at] = np.clip(far, -BOUND, BOUND), np.minimum(np.abs(far), BOUND)
    noise = np.einsum("epfrc->eprc", size) / np.float32(frames)
    square = np.multiply(bounded, bounded, out=size)
    powers = [np.einsum("epfrc->epfr", square), *(np.einsum("epfrc,epfrc->epfr", square, x) for x in (bounded, square))]
    later = np.einsum("epfrc,epfrc->epfr", bounded[:, :, 1:], bounded[:, :, :-1]).sum((1, 2, 3), dtype=np.float64)
    return Exposures(
        **vars(lines),
        pixel=pixel,
        scale=scale.astype(np.float64),
        variance=squares / (max(frames - 1, 1) * (rows - 1) * (columns - 1)),
        noise=noise,
        temporal=temporal,
        far=_beyond_tails(far, at // residual[0].size, n),
        outliers=_frames_with(at[np.abs(far) > OUTLIER], residual.shape),
        powers=np.stack([power.sum((2, 3), dtype=np.float64) for power in powers], 2) / (frames * rows * columns),
        lags=np.stack([lag_product(bounded, lag) for lag in LAGS], 1),
        later=later / max(residual[0, :, 1:].size, 1),
        grid=grid_of(bounded),
        codes=codes,
        half_pixel=half_pixel,
        half_temporal=half_temporal,
    )


def _temporal_variance(residual: np.ndarray) -> np.ndarray:
    """Variance over the frames of a residual [exposure, plane, frame, row, column] of mean 0, kept from 0."""
    frames = residual.shape[2]
    if frames < VARIANCE_FRAMES:
        return np.zeros((len(residual), 0), np.float32)
    return np.einsum("epfrc,epfrc->eprc", residual, residual) / np.float32(frames - 1) + np.float32(1e-3)


def _halves(residual: np.ndarray, scale: np.ndarray, pixel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Static map, DN, and variance over time of the even and of the odd frames."""
    enough = residual.shape[2] // 2 >= VARIANCE_FRAMES
    pixels, variances = [], []
    for parity in (0, 1):
        some = residual[:, :, parity::2]
        pixels.append(pixel + np.einsum("epfrc,epfr->eprc", some, scale[:, :, parity::2]) / some.shape[2])
        variances.append(_temporal_variance(some - some.mean(2, keepdims=True) if enough else some[:, :, :0]))
    return np.stack(pixels, 1), np.stack(variances, 1)


def _beyond_tails(values: np.ndarray, exposure: np.ndarray, n: int) -> np.ndarray:
    """How many values of each of n exposures lie beyond each of TAILS: [exposure, tail]."""
    beyond = (values > limit if limit > 0 else values < limit for limit in TAILS)
    return np.stack([np.bincount(exposure[some], minlength=n) for some in beyond], 1)


def _frames_with(places: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Number of frames [..., row, column] among a few flat places in an array of a shape [..., frame, row, column]."""
    number = np.zeros((*shape[:-3], *shape[-2:]), np.uint16)
    size = shape[-2] * shape[-1]
    np.add.at(number.reshape(-1), places // (shape[-3] * size) * size + places % size, 1)
    return number


def lag_product(x: np.ndarray, lag: tuple[int, int]) -> np.ndarray:
    """Mean product [exposure] of pixels `lag` (rows, columns of the sensor) apart.

    x: planes [exposure, plane, frame, row, column].
    """
    step = 1 if x.shape[1] == 1 else 2
    x = x.reshape(len(x), step, step, *x.shape[2:])
    total, size = np.zeros(len(x)), 0
    for (r, next_r, rows), (c, next_c, columns) in product(_neighbours(lag[0], step), _neighbours(lag[1], step)):
        a = x[:, r, c, :, : x.shape[4] - rows, max(-columns, 0) : x.shape[5] - max(columns, 0)]
        b = x[:, next_r, next_c, :, rows:, max(columns, 0) : x.shape[5] + min(columns, 0)]
        total += np.einsum("eijfrc,eijfrc->eijfr", a, b).reshape(len(x), -1).sum(1, dtype=np.float64)
        size += a[0].size
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
