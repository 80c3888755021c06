"""Read noise below the width of a count: an estimate despite rounding, and an upper bound.

A pixel at level mu with noise sigma < 0.5 DN mostly holds one count, or two if mu lies near the edge between them. Its
variance over time depends on where between two counts its level lies, and is not sigma^2 + 1/12. The measured pooled
histogram and mean variance over time are averages over the unknown levels of the pixels; a sigma is possible if some
distribution of levels has these averages.
"""

from __future__ import annotations

import numpy as np
import scipy  # its submodules are imported on first use

from hsnoise._core.quadrature import normal_nodes

SIGMAS_DN = np.geomspace(0.02, 1.0, 120)
STEPS_PER_DN = 50  # of the grid of levels
NEAR = 2e-3  # tolerated misfit of shares and variance: noise is not quite normal
MOST_COUNTS = 64
MOST_PIXELS = 1_000_000


def narrow_read_noise(counts) -> tuple[float, float]:
    """Read noise of darks of one exposure and colour [frame, row, column], DN: an estimate, and an upper bound.

    The estimate assumes normally distributed levels; it is NaN where that is impossible. The bound allows any
    distribution of levels but assumes that a pixel's noise is normal. Both are infinite for noise wider than 1 DN.

    Raises:
        ValueError: fewer than two frames.
    """
    counts = np.asarray(counts)
    if counts.ndim != 3 or len(counts) < 2:
        raise ValueError(f"counts: expected two frames or more [frame, row, column], got an array of {counts.shape}")
    y = counts.reshape(len(counts), -1)
    y = y[:, :: max(y.shape[1] // MOST_PIXELS, 1)].astype(np.float64)
    within = float(y.var(0, ddof=1).mean() - y.mean(1).var(ddof=1))  # offsets of frames are not pixel noise
    lowest, highest = np.quantile(y, (1e-4, 1 - 1e-4), method="nearest")  # a count, not what lies between two
    if within > 1 or highest - lowest > MOST_COUNTS:
        return np.inf, np.inf
    codes = np.arange(lowest - 2, highest + 3)
    share = np.array([(y == k).mean() for k in codes])
    estimate = _estimate(codes, share, within) if within > 0 else np.nan
    return estimate, float(np.fmax(_bound(codes, share, within), estimate))


def law_of_counts(codes: np.ndarray, levels_dn: np.ndarray, sigma_dn: float) -> np.ndarray:
    """Probability of each count at each level [code, level]."""
    upper = scipy.special.ndtr((codes[:, None] + 0.5 - levels_dn) / sigma_dn)
    return np.diff(upper, axis=0, prepend=0.0)


def _moments(codes: np.ndarray, law: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance of the counts at each level [level]."""
    mean = codes @ law
    return mean, codes**2 @ law - mean**2


def _bound(codes: np.ndarray, share: np.ndarray, variance: float) -> float:
    """The smallest sigma above all that are possible with these shares of counts and this variance over time."""
    levels = np.linspace(codes[0], codes[-1], STEPS_PER_DN * (len(codes) - 1) + 1)
    possible = [i for i, s in enumerate(SIGMAS_DN[:-1]) if _misfit(codes, levels, s, share, variance) < NEAR]
    return float(SIGMAS_DN[max(possible) + 1]) if possible else np.inf


def _misfit(codes: np.ndarray, levels: np.ndarray, sigma: float, share: np.ndarray, variance: float) -> float:
    law = law_of_counts(codes, levels, sigma)
    _, variances = _moments(codes, law)
    design = np.concatenate([law, variances[None], np.ones((1, len(levels)))])
    return float(scipy.optimize.nnls(design, np.concatenate([share, [variance, 1.0]]))[1])


def _estimate(codes: np.ndarray, share: np.ndarray, variance: float) -> float:
    """Sigma of normal noise on normally distributed levels with this mean, variance and variance over time."""
    mean = codes @ share
    spread = codes**2 @ share - mean**2
    z, weight = normal_nodes(61)

    def off(x):
        levels, sigma = x[0] + np.exp(x[1]) * z, np.exp(x[2])
        means, variances = _moments(codes, law_of_counts(codes, levels, sigma))
        middle = weight @ means
        return [
            middle - mean,
            (weight @ variances + weight @ means**2 - middle**2) / spread - 1,
            weight @ variances / variance - 1,
        ]

    starts = [(mean, np.log(s), np.log(n)) for s in (0.1, 0.4) for n in (0.1, 0.3)]
    found = [scipy.optimize.least_squares(off, x, bounds=([-np.inf, -6, -6], [np.inf, 4, 1])) for x in starts]
    best = min(found, key=lambda one: one.cost)
    return float(np.exp(best.x[2])) if best.cost < NEAR**2 else np.nan
