"""What flats tell of a sensor's pixels: how their response to light differs (PRNU)."""

from __future__ import annotations

import numpy as np
import scipy  # its parts are imported when they are used

from hsnoise.likelihood.flat_gain import FlatGain
from hsnoise.statistics.pixels.population import root_of, shared_variance
from hsnoise.statistics.pixels.structure import double_differences, of_blocks, plane_rows
from hsnoise.statistics.pixels.survey import Survey

LEAST_SIGNAL_DN = 1.0  # of a flat: with less, rounding is all that differs
LEAST_LIT = 0.2  # of the mean signal of a flat: corners that get less tell little
SAME_LIGHT = 1.01  # signals of one level above black levels that were reckoned apart
MOST_SATURATED = 0.01  # share of a flat's pixels that reach its highest count
CONTRADICTION = 1e-3  # chance of levels of light that scatter so much beyond their errors


def linear_to_dn(flats: FlatGain) -> np.ndarray:
    """The brightest flat in the range that determines the gain, DN above black [channel]."""
    return np.where(flats.used, flats.signal_dn, 0.0).max(0)


def photo_response(found: Survey, c: int, black_dn: float, offset_dn: float, lit_dn: float) -> tuple[float, float]:
    """Relative standard deviation of the pixels' response to light (PRNU), and its error, from 2 x 2 blocks.

    From flats up to `lit_dn` that do not saturate: charge that spills over evens out pixels that are nearly full.
    Dust and vignetting hardly vary within a block, whose own signal counts. Without any, the error is infinite. If the
    levels disagree, it holds their scatter.
    """
    several: list[tuple[float, float]] = []
    contrasts: list[int] = []
    for group in found.groups:
        if group.kind != "flat" or group.n_frames < 2:
            continue
        signal = float(np.mean([p.row_mean_dn.mean() for p in group.of(c)])) - black_dn
        highest = group.pixels(c, "highest")
        if not LEAST_SIGNAL_DN <= signal <= SAME_LIGHT * lit_dn or (highest == highest.max()).mean() > MOST_SATURATED:
            continue
        rows = len(found.sampled_rows) * plane_rows(found)
        levels = [p.halves.level_dn for p in group.of(c)]
        blocks = np.concatenate([double_differences(of, rows) for of in levels], axis=1)
        here = np.concatenate([of_blocks(of.mean(0), rows) for of in levels]) - black_dn
        lit = here > LEAST_LIT * signal
        variance, error = shared_variance(blocks[:, lit] / here[lit])
        several.append((variance - (offset_dn / signal) ** 2, max(error, 1e-12)))
        contrasts.append(lit.sum())
    if not several:
        return 0.0, np.inf
    apart = _between(*np.array(several).T)
    # Variances, not their roots, are averaged: a root of what may be negative is too large on average.
    sigma, error = root_of(*weighted_mean([(of, float(np.hypot(error, apart))) for of, error in several]))
    # All levels show the same pixels: more of them do not make up for how few these are.
    return sigma, max(error, sigma / float(np.sqrt(2 * max(contrasts))))


def _between(values: np.ndarray, errors: np.ndarray) -> float:
    """Standard deviation of what differs between values with these errors; 0 unless they contradict each other.

    Reference: Paule, Mandel, "Consensus values and weighting factors", J. Research NBS 87 (1982).
    """
    dof = len(values) - 1

    def misfit(between: float) -> float:
        weight = 1 / (errors**2 + between**2)
        return float(weight @ (values - weight @ values / weight.sum()) ** 2)

    if not dof or scipy.stats.chi2.sf(misfit(0.0), dof) > CONTRADICTION:
        return 0.0
    return scipy.optimize.brentq(lambda between: misfit(between) - dof, 0.0, 2 * np.ptp(values))


def weighted_mean(pairs: list[tuple[float, float]]) -> tuple[float, float]:
    """Mean of values with these errors, weighted by their inverse variances, and its error."""
    values, errors = np.array(pairs, float).T
    weight = errors**-2
    return float(weight @ values / weight.sum()), float(weight.sum() ** -0.5)
