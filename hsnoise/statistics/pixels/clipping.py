"""Correcting the mean and temporal variance of a class of pixels for clipping at 0.

A pixel's counts are max(normal, 0). Offsets of the pixels of a class scatter with a known deviation, so the measured
mean and variance are averages over pixels that clip more or less. Two equations, two unknowns.
"""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from hsnoise._core.quadrature import normal_nodes

NODES = 15  # over the offsets of a class
STEPS = 60
TOLERANCE = 1e-10
MOST_CLIPPED = 0.4  # share of a class's counts: beyond it, too little information is left
EDGE_DN = -0.5  # values below it would round to a negative count


def unclipped(mean: float, variance: float, scatter: float) -> tuple[float, float, float]:
    """Mean and temporal variance without clipping (DN, DN^2), and the factor by which an error of the variance grows.

    mean, variance: of the clipped counts of a class, variance the pixels' average; scatter: standard deviation of the
    pixels' levels, DN. NaN where no normal noise has these moments, or most counts are clipped.
    """
    level, sigma2 = mean, variance
    for _ in range(STEPS):
        m, v = clipped_moments(level, np.sqrt(sigma2), scatter)
        step = mean - m
        level += step
        sigma2 = float(np.clip(sigma2 * variance / max(v, 1e-12), 0.2 * sigma2, 5 * sigma2))
        if abs(step) < TOLERANCE * sigma2**0.5 and abs(v / variance - 1) < TOLERANCE:
            break
    else:
        return float("nan"), float("nan"), float("inf")
    share = float(ndtr((EDGE_DN - level) / np.hypot(np.sqrt(sigma2), scatter)))
    if share > MOST_CLIPPED:
        return float("nan"), float("nan"), float("inf")
    return level, sigma2, _growth_of_error(level, sigma2, scatter)


def clipped_moments(level: float, sigma: float, scatter: float) -> tuple[float, float]:
    """Mean and average variance of max(normal(level + offset, sigma^2), 0) over pixels with normal offsets."""
    z, weight = normal_nodes(NODES)
    off = level + scatter * z - EDGE_DN
    t = off / sigma
    density = np.exp(-0.5 * t**2) / np.sqrt(2 * np.pi)
    first = off * ndtr(t) + sigma * density
    second = (off**2 + sigma**2) * ndtr(t) + off * sigma * density
    # Clipped values have count 0, half a count above the edge.
    first_dn = first + EDGE_DN + 0.5 * ndtr(-t)
    variance = second + 0.25 * ndtr(-t) - (first + 0.5 * ndtr(-t)) ** 2
    return float(weight @ first_dn), float(weight @ variance)


def _growth_of_error(level: float, sigma2: float, scatter: float) -> float:
    """d(true variance) / d(measured variance) at a fixed measured mean."""
    step = 1e-3
    base = np.array(clipped_moments(level, np.sqrt(sigma2), scatter))
    by_level = np.array(clipped_moments(level + step, np.sqrt(sigma2), scatter)) - base
    by_variance = np.array(clipped_moments(level, np.sqrt(sigma2 + step), scatter)) - base
    slopes = np.stack([by_level, by_variance], 1) / step
    return float(np.linalg.inv(slopes)[1, 1])
