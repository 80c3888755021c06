"""What too few frames of an exposure leave open."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.special import polygamma

from hsnoise.fitting.result import FitResult
from hsnoise.statistics.pixels.survey import Survey

FEWEST = 4  # frames that tell pixels that differ in noise from noise with tails
NOTABLE = 0.15  # standard deviation of the logarithm of noise over pixels
MOST_STILL = 0.01  # share of pixels that hardly change, of which a logarithm says nothing


def single_frames(result: FitResult, found: Survey) -> Iterator[str]:
    """Darks without two frames at any exposure, which cannot show whether pixels differ."""
    if found.darks and all(g.n_frames < 2 for g in found.darks):
        yield (
            "Each exposure has one dark frame, so differences between pixels cannot be distinguished from noise and"
            " can make gain and read noise wrong by large factors. Take at least two frames of each exposure, better"
            " eight."
        )


def few_frames(result: FitResult, found: Survey) -> Iterator[str]:
    """Noise that is not alike in all pixels and frames, of which two or three frames do not say more.

    The logarithm of the variance of n normal numbers has a variance of trigamma((n - 1) / 2); what pixels have beyond
    is their own, or tails.
    """
    group, several = found.shortest, max((g.n_frames for g in found.darks), default=0)
    if result.transfer is None or group is None or several >= FEWEST or "read_noise_nonuniformity" in result.params:
        return
    variance = np.concatenate([plane.halves.pair_variance_dn2 for plane in group.planes])
    moving = variance[variance > 0]
    if len(moving) < (1 - MOST_STILL) * len(variance) or group.noise_dn < 1:  # rounding shapes narrower noise
        return
    excess = float(np.log(moving.astype(np.float64)).var() - polygamma(1, (group.n_frames - 1) / 2))
    spread = float(np.sqrt(max(excess, 0.0))) / 2
    if spread > NOTABLE:
        yield (
            f"The noise of pixels differs by {spread:.0%}, or has tails: {several} frames do not tell which, and the"
            " model draws all pixels with the same noise. Take eight frames."
        )
