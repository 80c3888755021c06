"""Levels over exposure: growth of the typical pixel, the level without signal, what the camera subtracts."""

from __future__ import annotations

import numpy as np

from hsnoise.fitting.pixel_joint import UNKNOWN
from hsnoise.statistics.pixels.classes import Levels, slope_over
from hsnoise.statistics.pixels.jump_search import Jumps
from hsnoise.statistics.pixels.population import Warm
from hsnoise.statistics.pixels.survey import Plane, Survey
from hsnoise.statistics.pixels.transfer import Transfer

LITTLE_DN = 0.02  # dark signal that does not matter for a level
FALLS = 4.0  # standard errors of a level that falls with exposure


def growth_of_means(found: Survey, c: int) -> tuple[tuple[float, float], tuple[float, float]]:
    """Growth of the median pixel with exposure, DN/s, and level without signal, DN, each with its standard error."""
    darks = found.darks
    t = np.array([g.exposure_s for g in darks])
    planes = [g.of(c) for g in darks]
    narrow = any(p.narrow_dn is not None for of in planes for p in of)
    reference = None if found.shortest is None else found.shortest.of(c)
    level = np.array(
        [
            np.mean([_level(p, narrow, None if reference is None else reference[i]) for i, p in enumerate(of)])
            for of in planes
        ]
    )
    frames = [
        np.mean([p.frame_means_dn if p.halves is None else p.halves.frame_means_dn for p in of], axis=0)
        for of in planes
    ]
    scatter = np.sqrt(np.mean([of.var(ddof=1) for of in frames if len(of) > 1] or [1.0]))
    error = np.array([max(scatter, 1e-6) / np.sqrt(len(of)) for of in frames])
    if np.ptp(t) == 0:
        mean_error = float(1 / np.sqrt((error**-2.0).sum()))
        return (0.0, UNKNOWN), (float(level.mean()), mean_error if t.max() == 0 else UNKNOWN)
    slope, slope_error = _line(t, level, error)
    # Pixels differ in growth, so the median does not grow linearly: extrapolate to 0 s from the shortest exposure.
    shortest = int(t.argmin())
    black = float(level[shortest] - slope * t[shortest])
    return (slope, slope_error), (black, float(np.hypot(error[shortest], slope_error * t[shortest])))


def black_of_pixels(pixels: Levels) -> float:
    """Level without signal of the typical pixel, DN, extrapolated from the shortest exposure pixel by pixel.

    In short exposures offsets and noise hide how skewed dark currents are, in long ones they do not, so that a line
    through the medians of all pixels has the growth of no pixel.
    """
    t = pixels.exposure_s
    shortest = int(t.argmin())
    return float(np.median(pixels.level[shortest] - slope_over(t, pixels.level) * t[shortest]))


def _line(exposure_s: np.ndarray, level_dn: np.ndarray, error_dn: np.ndarray) -> tuple[float, float]:
    """Slope of a straight line through levels [exposure], DN/s, and its error, widened by how far they lie off it."""
    error = np.maximum(error_dn, 1e-6)
    design = np.stack([np.ones_like(exposure_s), exposure_s], 1) / error[:, None]
    covariance = np.linalg.inv(design.T @ design)
    theta = covariance @ design.T @ (level_dn / error)
    left = level_dn / error - design @ theta
    covariance = covariance * max(float(left @ left) / max(len(left) - 2, 1), 1.0)
    return float(theta[1]), float(np.sqrt(covariance[1, 1]))


def _level(plane: Plane, narrow: bool, reference: Plane | None) -> float:
    """Level of the typical pixel of a plane, DN; hits and hot pixels do not move it.

    reference: the plane of repeated darks. The median pixel of a single frame, noise and all, is not that of means:
    there each pixel is compared with what it has here, so that fixed patterns do not matter.
    narrow: whether noise at some exposure is below a count; most pixels have the same one there, which is the median,
    so that it is the mean pixel at all exposures.
    """
    if narrow:
        return float(plane.row_mean_dn.mean())
    if plane.single_dn is None:
        return float(np.median(plane.halves.level_dn))
    # Counts are whole: their median would be, too.
    single = plane.single_dn + np.random.default_rng(0).uniform(-0.5, 0.5, plane.single_dn.shape)
    if reference is None:
        return float(np.median(single))
    typical = reference.halves.level_dn
    return float(np.median(typical) + np.median(single - typical.mean(0)))


def is_unlit(found: Survey, growth: float) -> bool:
    """Whether the shortest exposure hardly has dark signal, so that its mean is the level without signal.

    growth: DN/s.
    """
    group = found.shortest
    return group is not None and (not found.has_exposures or growth * group.exposure_s < LITTLE_DN)


def mean_black(found: Survey, c: int, warm: Warm | None, jumps: Jumps | None) -> float:
    """The mean of the shortest exposure without warm pixels' charge and jumps, DN."""
    black = found.shortest.mean_dn(c)
    if warm is not None:
        black -= warm.fraction[0] * warm.extra_dn[0]
    if jumps is not None and not jumps.double_sampling:
        black -= jumps.fraction[0] * jumps.amplitude_dn[0] * jumps.duty[0]
    return black


def subtracted(transfer: Transfer | None, growth: tuple[float, float]) -> tuple[float, float]:
    """Dark signal that the camera subtracts, DN/s, and its error: how fast pedestals fall if they moved, or the level.

    growth: of the typical pixel's level, DN/s, with its error.
    """
    if transfer is None or not transfer.moved.any():
        return (-growth[0], growth[1]) if growth[0] < -FALLS * growth[1] else (0.0, np.inf)
    slope, error = _line(transfer.classes.exposure_s, transfer.pedestal_dn, transfer.pedestal_error_dn)
    return -slope, error
