"""Histograms of counts: their skewness, how they jump from code to code, and what lies at their ends."""

from __future__ import annotations

import math

import numpy as np

MOST_CODES = 1 << 16
FEWEST_PER_CODE = 8.0
FOURTH_DIFFERENCE = np.array([1.0, -4.0, 6.0, -4.0, 1.0])


def histogram_shape(counts: np.ndarray, white_level: float | None) -> tuple[float, float, float, float]:
    """Skewness from quantiles, log roughness, and arcsin of the roots of the shares at zero and at the white level."""
    low, high = int(counts.min()), int(counts.max())
    if 0 <= low and high <= MOST_CODES:
        histogram = np.bincount(counts.ravel())[low:]
    else:
        histogram = np.bincount(np.minimum(counts.ravel() - low, MOST_CODES))
    zero = int(histogram[0]) if low == 0 else 0
    white = 0 if white_level is None else int(histogram[max(int(white_level) - low, 0) :].sum())
    skewness, roughness = _skewness_and_roughness(low, histogram)
    at_zero, at_white = (math.asin(math.sqrt(number / counts.size)) for number in (zero, white))
    return skewness, roughness, at_zero, at_white


def _skewness_and_roughness(low: int, histogram: np.ndarray) -> tuple[float, float]:
    """From the first code and a histogram of counts."""
    cumulative = np.cumsum(histogram)
    shares = np.array([0.05, 0.5, 0.95])
    cumulative = cumulative / cumulative[-1]
    code = np.searchsorted(cumulative, shares, "right")
    below = np.where(code > 0, cumulative[code - 1], 0.0)
    q05, q50, q95 = (code + (shares - below) / (cumulative[code] - below)).tolist()
    skewness = (q95 + q05 - 2 * q50) / max(q95 - q05, 1e-6)
    # The codes between the far quantiles; code 0 holds all that is clipped there.
    some = histogram[max(int(q05), 1 - low) : int(q95) + 1].astype(np.float64)
    if len(some) < len(FOURTH_DIFFERENCE) or some.mean() < FEWEST_PER_CODE:
        return skewness, 0.0
    # Square roots have variance 1 whatever the expected number; a fourth difference does not see a smooth law.
    rough = np.convolve(2 * np.sqrt(some + 0.375), FOURTH_DIFFERENCE, "valid")
    return skewness, math.log(1 + float(rough @ rough) / len(rough) / float(FOURTH_DIFFERENCE @ FOURTH_DIFFERENCE))
