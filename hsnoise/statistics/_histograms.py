"""Histograms of counts: their skewness, how they jump from code to code, and what lies at their ends."""

from __future__ import annotations

import math

import numpy as np

MOST_CODES = 1 << 16
FEWEST_PER_CODE = 8.0
ENOUGH_PER_CODE = 64.0  # that none is empty by chance, not even at the far quantiles
FOURTH_DIFFERENCE = np.array([1.0, -4.0, 6.0, -4.0, 1.0])


def histogram_shape(counts: np.ndarray, white_level: float | None) -> tuple[float, float, float, float, float]:
    """Skewness from quantiles, log roughness, and arcsin of the roots of shares.

    The shares are those of codes that are left out, and of counts at zero and at the white level.
    """
    low, high = int(counts.min()), int(counts.max())
    if 0 <= low and high <= MOST_CODES:
        histogram = np.bincount(counts.ravel())[low:]
    else:
        histogram = np.bincount(np.minimum(counts.ravel() - low, MOST_CODES))
    zero = int(histogram[0]) if low == 0 else 0
    white = 0 if white_level is None else int(histogram[max(int(white_level) - low, 0) :].sum())
    at_zero, at_white = (math.asin(math.sqrt(number / counts.size)) for number in (zero, white))
    return *_skewness_and_gaps(low, histogram), at_zero, at_white


def _skewness_and_gaps(low: int, histogram: np.ndarray) -> tuple[float, float, float]:
    """Skewness, log roughness and left out codes, from the first code and a histogram of counts."""
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
        return skewness, 0.0, 0.0
    # Square roots have variance 1 whatever the expected number; a fourth difference does not see a smooth law.
    rough = np.convolve(2 * np.sqrt(some + 0.375), FOURTH_DIFFERENCE, "valid")
    roughness = math.log(1 + float(rough @ rough) / len(rough) / float(FOURTH_DIFFERENCE @ FOURTH_DIFFERENCE))
    left_out = np.mean(some == 0) if some.mean() >= ENOUGH_PER_CODE else 0.0
    return skewness, roughness, math.asin(math.sqrt(left_out))
