"""What persists between exposures: static maps, profiles and variances of the same pixels are compared."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy  # its submodules are imported on first use

from hsnoise.statistics._anova import BOUND, Exposure
from hsnoise.statistics._pixels import log_temporal_variance
from hsnoise.statistics._sheet import Entry, fisher, log_ratio

OUTLIER = 4.0
OUTLIERS = (1, 2, 3, 5)
MOST_VARIANCE = 50.0  # of a pixel, in units of its row's: one hit must not dominate all pixels
MOST_MAP_SIDE = 512
VARIANCE_FRAMES = 3


@dataclass(frozen=True)
class View:
    """The static part of one exposure, or of its even or odd frames.

    half: 0 short, 1 long (or even, odd). pixel [plane, row, column] in units of its robust spread; row [plane, row] and
    column [plane, column], DN; log_variance [plane, row, column] over time, None if frames are too few.
    """

    half: int
    pixel: np.ndarray
    row: np.ndarray
    column: np.ndarray
    log_variance: np.ndarray | None


def view_of(x: Exposure, half: int, log_variance: np.ndarray | None) -> View:
    return View(half, _normalised(x.pixel), x.row, x.column, log_variance)


def even_and_odd(x: Exposure) -> Iterator[View]:
    """Views of the even and the odd frames of one exposure, for captures with only one."""
    for parity in (0, 1):
        some = x.residual[:, parity::2]
        mean = (some * x.scale[:, parity::2, :, None]).mean(1)
        row, column = x.row_frame[:, parity::2].mean(1), x.column_frame[:, parity::2].mean(1)
        enough = some.shape[1] >= VARIANCE_FRAMES and x.shape[1] // 2 >= VARIANCE_FRAMES
        log_variance = log_temporal_variance(some - some.mean(1, keepdims=True)) if enough else None
        yield View(parity, _normalised(x.pixel + mean), x.row + row, x.column + column, log_variance)


def _normalised(pixel: np.ndarray) -> np.ndarray:
    return pixel / (np.abs(pixel).mean((1, 2), keepdims=True) * np.float32(np.sqrt(np.pi / 2)) + np.float32(1e-6))


def persistence(views: list[View], names: tuple[str, str]) -> dict[tuple[str, str], Entry]:
    """Correlations of maps and profiles between exposures: both short, short and long, both long."""
    pixel = np.stack([view.pixel for view in views], 1)
    out = _pairs(views, names, pixel, "static pixels", "raw map")
    out |= _pairs(views, names, np.clip(pixel, -BOUND, BOUND), "static pixels", "map")
    out |= _pairs(views, names, np.stack([view.row for view in views], 1), "static rows", "profile")
    out |= _pairs(views, names, np.stack([view.column for view in views], 1), "static columns", "profile")
    timed = [(view, view.log_variance) for view in views if view.log_variance is not None]
    if len(timed) > 1:
        log_variance, some = np.stack([values for _, values in timed], 1), [view for view, _ in timed]
        out |= _pairs(some, names, log_variance, "pixels over time", "log variance")
        variance = np.minimum(np.exp(log_variance), np.float32(MOST_VARIANCE))
        out |= _pairs(some, names, variance, "pixels over time", "variance")
    return out


def _pairs(
    views: list[View], names: tuple[str, str], maps: np.ndarray, group: str, what: str
) -> dict[tuple[str, str], Entry]:
    """artanh of the correlations of maps [plane, view, ...], averaged over planes and the pairs of each kind."""
    planes, n_views = maps.shape[:2]
    flat = maps.reshape(planes, n_views, -1)
    flat = flat - flat.mean(-1, keepdims=True)
    gram = (flat @ flat.transpose(0, 2, 1)).astype(np.float64)
    power = np.maximum(np.diagonal(gram, axis1=1, axis2=2), 1e-30)
    values = fisher(gram / np.sqrt(power[:, :, None] * power[:, None]) * (1 - np.eye(n_views))).mean(0)
    kinds: dict[str, list[float]] = {}
    for j in range(n_views):
        for i in range(j):
            kinds.setdefault(f"{names[views[i].half]} and {names[views[j].half]}", []).append(values[i, j])
    error = 1 / np.sqrt(planes * flat.shape[-1])
    return {
        (group, f"correlation of exposures, {what}, {kind}"): Entry(float(np.mean(of)), float(error / np.sqrt(len(of))))
        for kind, of in kinds.items()
    }


def map_peak(views: list[View]) -> float:
    """Log of the largest value of the two-dimensional periodogram of the mean static map, over its median."""
    total = np.clip(sum(view.pixel for view in views), -BOUND * len(views), BOUND * len(views))
    power = np.square(np.abs(scipy.fft.rfft2(total[:, :MOST_MAP_SIDE, :MOST_MAP_SIDE]))).sum(0)[1:, 1:]
    return float(log_ratio(power.max() / max(float(np.median(power)), 1e-12), 1.0))


def outliers_of(x: Exposure) -> np.ndarray:
    """Number of frames [plane, row, column] in which each pixel lies far from its mean."""
    return (np.abs(x.bounded) > OUTLIER).sum(1, dtype=np.uint16)


def outlier_counts(outliers: np.ndarray) -> dict[tuple[str, str], Entry]:
    """Square roots of the numbers of pixels by their number of outliers: hits come alone, jumping pixels repeat."""
    out = {}
    for number in OUTLIERS:
        exact = number < 3
        found = np.count_nonzero(outliers == number if exact else outliers >= number)
        what = f"pixels with {number}{'' if exact else ' or more'} outliers"
        out["pixels over time", what] = Entry(float(np.sqrt(found)), 0.5)
    return out
