"""Growth of the typical pixel's level with exposure, and the level without signal."""

from __future__ import annotations

import numpy as np

from hsnoise.fitting.pixel_joint import UNKNOWN
from hsnoise.statistics.pixels.survey import Plane, Survey


def growth_of_means(found: Survey, c: int) -> tuple[tuple[float, float], tuple[float, float]]:
    """Growth of the median pixel with exposure, DN/s, and level without signal, DN, each with its standard error."""
    darks = found.darks
    t = np.array([g.exposure_s for g in darks])
    planes = [g.of(c) for g in darks]
    level = np.array([np.mean([_level(p) for p in of]) for of in planes])
    frames = [
        np.mean([p.frame_means_dn if p.halves is None else p.halves.frame_means_dn for p in of], axis=0)
        for of in planes
    ]
    scatter = np.sqrt(np.mean([of.var(ddof=1) for of in frames if len(of) > 1] or [1.0]))
    error = np.array([max(scatter, 1e-6) / np.sqrt(len(of)) for of in frames])
    if np.ptp(t) == 0:
        mean_error = float(1 / np.sqrt((error**-2.0).sum()))
        return (0.0, UNKNOWN), (float(level.mean()), mean_error if t.max() == 0 else UNKNOWN)
    design = np.stack([np.ones_like(t), t], 1) / error[:, None]
    covariance = np.linalg.inv(design.T @ design)
    theta = covariance @ design.T @ (level / error)
    left = (level - theta[0] - theta[1] * t) / error
    covariance = covariance * max(float(left @ left) / max(len(t) - 2, 1), 1.0)
    slope_error = float(np.sqrt(covariance[1, 1]))
    # Pixels differ in growth, so the median does not grow linearly: extrapolate to 0 s from the shortest exposure.
    shortest = int(t.argmin())
    black = float(level[shortest] - theta[1] * t[shortest])
    return (float(theta[1]), slope_error), (black, float(np.hypot(error[shortest], slope_error * t[shortest])))


def _level(plane: Plane) -> float:
    """Level of the typical pixel of a plane, DN; hits and hot pixels do not move it."""
    if plane.narrow_dn is not None:  # most pixels have the same count, which is the median
        return float(plane.row_mean_dn.mean())
    return float(np.median(plane.row_mean_dn if plane.halves is None else plane.halves.level_dn))
