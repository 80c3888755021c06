"""Classes of pixels without the variance that is not their noise: of row gain, hits too small to be seen, rounding."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import gammainc

from hsnoise.fitting.pixel_joint import ROW_GAIN_THERE
from hsnoise.statistics.pixels.classes import Classes, Levels, classes_of, least_hit
from hsnoise.statistics.pixels.hits import Rays
from hsnoise.statistics.pixels.transfer import ROUNDING

LEAST = 0.2  # of a variance that is left, however much is subtracted


def classes_less(pixels: Levels, full_scale_dn: float, row_gain: tuple[float, float], rays: Rays | None) -> Classes:
    """The classes of the pixels of a channel; row_gain: its variance and the error of that."""
    classes = _uncertain_where_narrow(classes_of(pixels, full_scale_dn))
    if rays is not None:
        classes = _without_small_hits(classes, pixels.n_frames, rays)
    variance, error = row_gain
    return _without_streaks(classes, variance) if variance > ROW_GAIN_THERE * error else classes


def _uncertain_where_narrow(classes: Classes) -> Classes:
    """With the errors of variances narrower than a count: where a level lies between two counts changes them.

    Rounding adds 1/12 DN^2 and a wave over the level of this amplitude (Widrow and Kollar, *Quantization Noise*, 2008).
    """
    own = np.maximum(classes.variance_dn2 - ROUNDING, 0.0)
    wave = (1 / np.pi**2 + 4 * own) * np.exp(-2 * np.pi**2 * own)
    return replace(classes, error_dn2=np.hypot(classes.error_dn2, wave / np.sqrt(2)))


def _without_streaks(classes: Classes, row_gain: float) -> Classes:
    """Without the variance that a row gain adds to pixels brighter than their row."""
    ordinary = np.median(classes.level_dn[~classes.hot], axis=0) if (~classes.hot).any() else 0.0
    streaks = row_gain * (classes.level_dn - ordinary) ** 2
    return replace(classes, variance_dn2=np.maximum(classes.variance_dn2 - streaks, 1e-3))


def _without_small_hits(classes: Classes, n_frames: np.ndarray, rays: Rays) -> Classes:
    """Without the variance of hits that are too small to be left out; half of it is added to the errors.

    Charges are exponential: of their mean square 2 q^2, those below a limit L make 2 q^2 P(3, L / q).
    """
    charge, hits = rays.charge_dn[0], 1e-6 * (rays.rate[0] * classes.exposure_s + rays.at_readout[0])
    limit = least_hit(np.sqrt(classes.variance_dn2), n_frames)
    small = hits * 2 * charge**2 * gammainc(3.0, limit / charge)
    variance = np.maximum(classes.variance_dn2 - small, LEAST * classes.variance_dn2)
    return replace(classes, variance_dn2=variance, error_dn2=np.hypot(classes.error_dn2, small / 2))
