"""Warm pixels of darks of one exposure, and what flats of other exposures tell of how their charge grows."""

from __future__ import annotations

import numpy as np

from hsnoise._core.robust import OF_MEDIAN, robust_sigma
from hsnoise.fitting.pixel_flats import between, saturates, weighted_mean
from hsnoise.statistics.pixels.population import FEWEST_HOT, WARM_SIGMAS, Warm, beyond_neighbours, warm_of
from hsnoise.statistics.pixels.survey import Group, Survey


def warm_in(found: Survey, c: int) -> Warm | None:
    """The warm pixels of a channel at the shortest repeated darks; None where there are none."""
    darks = found.shortest
    if darks is None:
        return None
    columns = len(darks.of(c)[0].column_mean_dn)
    off = beyond_neighbours(darks.pixels(c, "level_dn"), columns)
    warm = warm_of(off)
    return None if warm is None else warm._replace(growth=_growth(found, c, darks.exposure_s, off, columns))


def _growth(found: Survey, c: int, darks_s: float, off: np.ndarray, columns: int) -> tuple[float, float]:
    """By how much the extra level of warm pixels grows in a second, relative to that of the darks, and its error.

    off [half, pixel]: levels of the darks beyond their neighbours. Light is alike for neighbours, dark current is not:
    a flat shows warm pixels as a dark of its exposure would. Pixels are chosen in one half of the darks and measured in
    the other, as the largest levels are too large by chance. Infinite error: flats do not tell.
    """
    chosen = off[0] > WARM_SIGMAS * robust_sigma(off[0] - np.median(off[0]))
    told = []
    for group in found.groups:
        if group.kind != "flat" or group.exposure_s == darks_s:
            continue
        level, highest = _levels(group, c)
        kept = chosen & (off[1] > 0) & (highest < found.full_scale_dn)
        if kept.sum() <= FEWEST_HOT or saturates(highest):
            continue
        ratio = beyond_neighbours(level[None], columns)[0, kept] / off[1, kept]
        error = OF_MEDIAN * robust_sigma(ratio - np.median(ratio)) / np.sqrt(kept.sum())
        apart = group.exposure_s - darks_s
        told.append(((np.median(ratio) - 1) / apart, max(error, 1e-12) / abs(apart)))
    if not told:
        return 0.0, np.inf
    scatter = between(*np.array(told).T)
    return weighted_mean([(value, float(np.hypot(error, scatter))) for value, error in told])


def _levels(group: Group, c: int) -> tuple[np.ndarray, np.ndarray]:
    """The levels of an exposure's pixels [pixel], and the highest count of each, DN."""
    if group.n_frames == 1:
        level = np.concatenate([plane.single_dn for plane in group.of(c)])
        return level, level
    return group.pixels(c, "level_dn").mean(0), group.pixels(c, "highest")
