"""What persists from one exposure to the next: static maps, profiles and variances of the same pixels, compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy  # its parts are imported when they are used

from hsnoise.statistics._exposures import BOUND, Exposures, normalised
from hsnoise.statistics._sheet import Entry, fisher, log_ratio

OUTLIERS = (1, 2, 3, 5)
MOST_VARIANCE = 50.0  # of a pixel, in units of its row's: one hit must not stand for all pixels
MOST_MAP_SIDE = 512


@dataclass(frozen=True)
class View:
    """The static part of one exposure, or of its even or odd frames.

    half: 0 low, 1 high (even, odd). pixel [plane, row, column] in units of its robust spread; row [plane, row] and
    column [plane, column], DN; temporal [plane, row, column], the variance over time, empty with too few frames.
    """

    half: int
    pixel: np.ndarray
    row: np.ndarray
    column: np.ndarray
    temporal: np.ndarray


def views_of(x: Exposures, halves: Sequence[int]) -> list[View]:
    """A view of each exposure."""
    maps = (x.map, x.row, x.column, x.temporal)
    return [View(half, *(of[i] for of in maps)) for i, half in enumerate(halves)]


def even_and_odd(x: Exposures) -> list[View]:
    """Views of the even and of the odd frames of one exposure, for captures that have no other."""
    views = []
    for parity, (pixel, temporal) in enumerate(zip(x.half_pixel[0], x.half_temporal[0], strict=True)):
        row, column = (moving[0, :, parity::2].mean(1) for moving in (x.row_frame, x.column_frame))
        views.append(View(parity, normalised(pixel), x.row[0] + row, x.column[0] + column, temporal))
    return views


def persistence(views: list[View], names: tuple[str, str]) -> dict[tuple[str, str], Entry]:
    """Correlations of maps and profiles between exposures: both short, short and long, both long."""
    pixel = np.stack([view.pixel for view in views], 1)
    bounded = np.clip(pixel, -BOUND, BOUND)
    out = _pairs(views, names, pixel, "static pixels", "raw map")
    out |= _pairs(views, names, bounded, "static pixels", "map")
    out |= _pairs(views, names, np.stack([view.row for view in views], 1), "static rows", "profile")
    out |= _pairs(views, names, np.stack([view.column for view in views], 1), "static columns", "profile")
    timed = [view for view in views if view.temporal.size]
    if len(timed) > 1:
        variance = np.stack([view.temporal for view in timed], 1)
        out |= _pairs(timed, names, np.log(variance), "pixels over time", "log variance")
        np.minimum(variance, np.float32(MOST_VARIANCE), out=variance)
        out |= _pairs(timed, names, variance, "pixels over time", "variance")
    return out


def _pairs(
    views: list[View], names: tuple[str, str], maps: np.ndarray, group: str, what: str
) -> dict[tuple[str, str], Entry]:
    """artanh of the correlations of maps [plane, view, ...], averaged over planes and the pairs of each kind.

    The maps lose their means.
    """
    planes, n_views = maps.shape[:2]
    flat = maps.reshape(planes, n_views, -1)
    flat -= flat.mean(-1, keepdims=True)
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


def outlier_counts(outliers: np.ndarray) -> dict[tuple[str, str], Entry]:
    """From outliers [plane, row, column], the number of frames in which a pixel lies far from its mean.

    Square root of the number of pixels with so many outliers: hits come alone, jumping pixels repeat.
    """
    out = {}
    for number in OUTLIERS:
        exact = number < 3
        found = np.count_nonzero(outliers == number if exact else outliers >= number)
        what = f"pixels with {number}{'' if exact else ' or more'} outliers"
        out["pixels over time", what] = Entry(float(np.sqrt(found)), 0.5)
    return out
