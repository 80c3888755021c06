"""Dark signal that is there without exposure, or that the camera subtracts: of both, the noise stays."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hsnoise._core.robust import robust_sigma
from hsnoise.fitting.result import FitResult
from hsnoise.statistics.pixels.classes import Levels, hot_from, levels_of, slope_over
from hsnoise.statistics.pixels.sample import covariance_of
from hsnoise.statistics.pixels.structure import MOST_DN_PER_E, rise_dn
from hsnoise.statistics.pixels.survey import Survey

FAR = 6.0  # deviations of an offset at which it is cut
SURE = 5.0  # standard errors of the time
NOTABLE = 0.05  # share of the variance of read noise
GROWN = 1.5  # factor of a variance


def waiting(result: FitResult, found: Survey) -> Iterator[str]:
    """Offsets of pixels that go with their dark current, as if exposures were longer than stated."""
    if result.transfer is None or not result.has_gain or len(found.channels) != 1:
        return
    pixels, read_e = levels_of(found, 0), result.table["read_noise.sigma"][0]
    if pixels is None or read_e <= 0:
        return
    seconds, error = _waiting_s(pixels)
    share = result.table["dark_current.rate"][0] * seconds / read_e**2
    if seconds > SURE * error and NOTABLE < share < 1:
        yield (
            f"Pixels with more dark current have higher offsets, too, as if every exposure lasted {seconds:.2g} s"
            f" longer: is the time of readout not in it? {share:.0%} of the variance of the read noise is shot noise of"
            " that time."
        )


def _waiting_s(pixels: Levels) -> tuple[float, float]:
    """Covariance of offset and growth of ordinary pixels over the variance of growth, s, and its error.

    Each product takes the offset from one half of the frames and the growth from the other.
    """
    t, growth = pixels.exposure_s, slope_over(pixels.exposure_s, pixels.level)
    ordinary = growth.max(0) < hot_from(growth)
    growth = growth[:, ordinary]
    offset = pixels.level[..., ordinary].mean(0, dtype=np.float64) - growth * t.mean()
    spread = covariance_of(growth[0], growth[1])
    if spread <= 0:
        return 0.0, np.inf
    off, of_growth = (one - np.median(one, axis=1, keepdims=True) for one in (offset, growth))
    width = FAR * robust_sigma(off)
    off = np.clip(off, -width, width)
    terms = (off * (of_growth[::-1] - of_growth.mean())).mean(0)
    return float(terms.mean() / spread), float(terms.std() / np.sqrt(len(terms)) / spread)


def noise_alone(result: FitResult, found: Survey) -> Iterator[str]:
    """Noise that grows with exposure where no signal does: a pooled fit gives the mean of all exposures."""
    darks = sorted(found.repeated_darks, key=lambda group: group.exposure_s)
    if result.has_gain or len(darks) < 2 or darks[-1].exposure_s == darks[0].exposure_s:
        return
    short, long = darks[0], darks[-1]
    grown = long.noise_dn**2 - short.noise_dn**2
    if grown > (GROWN - 1) * short.noise_dn**2 and MOST_DN_PER_E * rise_dn(short, long) < grown:
        yield (
            f"The noise of pixels grows from {short.noise_dn:.3g} DN at {short.exposure_s:g} s to {long.noise_dn:.3g}"
            f" DN at {long.exposure_s:g} s, but their level does not: the camera subtracts its dark signal, or a dark"
            " frame from each. Switch that off."
        )
