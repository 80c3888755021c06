"""A black level that drifts along a row or down the frame: the smooth part of the static column or row means."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter

from hsnoise._core.robust import robust_sigma

LENGTHS = (*np.geomspace(0.01, 3.0, 20), 10.0)  # in widths of the frame; the last is a straight line
LEAST_SHARE = 0.3  # of the variance of the means that a shading must explain
THERE = 5.0  # standard errors
NEIGHBOURS = 9  # lines, with whose median a line is compared
FAR = 6.0  # typical deviations beyond which a line has a defect


class Shading(NamedTuple):
    """Exponential drift of row or column means: rms and its error, DN, length in frames, where steepest, its sign."""

    amplitude_dn: float
    error_dn: float
    length: float
    start: str
    above: bool

    def left_of(self, means_dn: np.ndarray) -> np.ndarray:
        """What of static row or column means [n] it does not explain, DN."""
        drift = self.amplitude_dn * _shape(len(means_dn), self.start, self.length)
        return means_dn - means_dn.mean() - (drift if self.above else -drift)


def shading_of(means_dn: np.ndarray, noise_dn: float, chance_dn: float = 0.0) -> Shading | None:
    """The shading of static row or column means [n], DN; None if it explains too little of them.

    noise_dn: standard error of each mean; chance_dn: rms of a shading that noise of lines makes in these means.
    A defect of the first or last line looks like a steep drift, but alone it is none.
    """
    found = _steepest(means_dn, noise_dn, chance_dn)
    if found is None or _holds_without_edge(found, means_dn):
        return found
    means_dn = _without_edge(means_dn, found.start)
    found = _steepest(means_dn, noise_dn, chance_dn)
    return found if found is not None and _holds_without_edge(found, means_dn) else None


def _steepest(means_dn: np.ndarray, noise_dn: float, chance_dn: float) -> Shading | None:
    """The shading of means [n], that of a defect at the edge included."""
    y = _without_defects(means_dn)
    best = None
    for start in ("first", "last"):
        for length in LENGTHS:
            size = _size(y, start, length)
            if best is None or abs(size) > abs(best[0]):
                best = size, length, start
    assert best is not None
    size, length, start = best
    left = max(float(y.var()) - size**2, 0.0)
    error = float(np.sqrt((left + noise_dn**2) / len(y) + chance_dn**2))
    if abs(size) < THERE * error or size**2 < LEAST_SHARE * float(y.var()):
        return None
    return Shading(abs(size), error, length, start, size > 0)


def _holds_without_edge(found: Shading, means_dn: np.ndarray) -> bool:
    rest = _without_defects(_without_edge(means_dn, found.start))
    return abs(_size(rest, found.start, found.length)) >= THERE * found.error_dn


def _without_edge(means_dn: np.ndarray, start: str) -> np.ndarray:
    """Means of lines, the first or last replaced by the next."""
    return np.append(means_dn[1], means_dn[1:]) if start == "first" else np.append(means_dn[:-1], means_dn[-2])


def _size(means_dn: np.ndarray, start: str, length: float) -> float:
    return float((_shape(len(means_dn), start, length) * means_dn).mean())


def _without_defects(means_dn: np.ndarray) -> np.ndarray:
    """Means of lines [n], DN, those far off their neighbours replaced by these."""
    around = median_filter(means_dn, NEIGHBOURS, mode="nearest")
    off = np.abs(means_dn - around)
    return np.where(off > FAR * robust_sigma(off), around, means_dn)


def _shape(lines: int, start: str, length: float) -> np.ndarray:
    """A drift [line] of mean 0 and mean square 1."""
    distance = np.arange(lines) / max(lines - 1, 1)
    shape = np.exp(-(distance if start == "first" else distance[::-1]) / length)
    shape -= shape.mean()
    return shape / np.sqrt((shape**2).mean())
