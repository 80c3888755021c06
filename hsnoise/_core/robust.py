"""Scatter that a few outliers do not change."""

from __future__ import annotations

import numpy as np

NORMAL = 1.4826  # standard deviation of normal values over the median of their sizes
OF_MEDIAN = 1.2533  # standard error of a median over that of a mean, of normal values


def robust_sigma(off: np.ndarray) -> float:
    """Standard deviation of normal values about 0, of which a few may lie anywhere: from the median of their sizes."""
    return NORMAL * float(np.median(np.abs(off)))
