"""A response that bends, from the photon transfer of flats: electrons that spread to neighbours bend that, too."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hsnoise.likelihood.flat_gain import FlatGain, variance_curve
from hsnoise.statistics.pixels.structure import plane_rows
from hsnoise.statistics.pixels.survey import Group, Survey

FEWEST_LEVELS = 3  # a line goes through two
ABOVE_TOP = 1.01  # black levels that were reckoned apart
LEAST_RANGE = 0.2  # of the brightest level, that levels must span
SURE = 3.0  # standard errors from which neighbours share what is missing
LIKELY, MOSTLY = 2.0, 0.4  # likewise, where they share so much of it that chance explains the rest
LEAST_SHARED = 0.1  # of the variance that is missing
NONE = (0.0, np.inf)


class Bend(NamedTuple):
    """What bends the curve of a colour's variance.

    curvature_per_e: relative loss of response for each electron of signal, and its error; infinite if there is none.
    spread_per_e: share of its excess that a pixel gives each neighbour, for each electron, likewise.
    shared: part of the variance at the brightest level that determines the gain that neighbours have come to share
        since low signal.
    """

    curvature_per_e: tuple[float, float] = NONE
    spread_per_e: tuple[float, float] = NONE
    shared: float = 0.0

    @property
    def spreads(self) -> bool:
        """Whether electrons spread to neighbours as pixels fill (brighter-fatter effect)."""
        return bool(np.isfinite(self.spread_per_e[1]))

    @property
    def is_curved(self) -> bool:
        """Whether the response bends."""
        return bool(np.isfinite(self.curvature_per_e[1]))


STRAIGHT = Bend()


def bend_of(found: Survey, flats: FlatGain, c: int) -> Bend:
    """The bend of channel c, from flats of three levels or more.

    A response x - a x^2 has the variance gain^2 (1 - 2 a x)^2 x. Electrons that spread to neighbours take variance,
    too, but leave it in the covariance with them: what neighbours share is theirs, and the rest is the response's, or
    chance.

    Reference: Janesick, *Photon Transfer*, SPIE 2007 (nonlinearity); Antilogus et al., "The brighter-fatter effect and
    pixel correlations in CCD sensors", JINST 9 C03048 (2014).
    """
    used = flats.used[:, c]
    if not flats.described[c] or not flats.bend[c].any() or used.sum() < FEWEST_LEVELS:
        return STRAIGHT
    top_dn, gain = float(flats.signal_dn[used, c].max()), float(flats.gain[c])
    missing = float(variance_curve(flats, c, top_dn)) - 1
    brightest = np.flatnonzero(used)[flats.signal_dn[used, c].argmax()]
    of_top = flats.level_error[brightest, c] / flats.level_gain[brightest, c]
    is_line = flats.bend[c, 1] == 0
    error = float(flats.bend_error[c, 0] if is_line else np.hypot(of_top, flats.standard_error[c] / gain))
    shared, of_shared = _shared(found, c, top_dn)
    per_e = gain / top_dn
    together = float(np.hypot(error, of_shared)) if np.isfinite(of_shared) else error
    rest = (1 + missing) / (1 - shared + 20 * (shared / 8) ** 2) - 1
    if shared > max(LIKELY * of_shared, -MOSTLY * missing) and abs(rest) < LIKELY * together and missing < 0:
        return Bend(NONE, _spread(missing, error, per_e), shared)
    if shared <= max(SURE * of_shared, -LEAST_SHARED * missing):
        return Bend(_curved(missing, together, per_e), NONE, shared)
    return Bend(_curved(rest, together, per_e), (shared / 8 * per_e, of_shared / 8 * per_e), shared)


def _curved(missing: float, error: float, per_e: float) -> tuple[float, float]:
    """Curvature: (1 - 2 u)^2 / (1 - u) = 1 + missing, with u of the response missing at the brightest level."""
    u = (3 - missing - np.sqrt((3 - missing) ** 2 + 16 * missing)) / 8
    return float(u * (1 - u) * per_e), float(abs(u / missing if missing else 1 / 3) * error * per_e)


def _spread(missing: float, error: float, per_e: float) -> tuple[float, float]:
    """Share that goes to a neighbour: (1 - 4 k)^2 + 4 k^2 = 1 + missing at the brightest level."""
    k = (8 - np.sqrt(max(64 + 80 * missing, 0.0))) / 40
    return float(k * per_e), float(k / -missing * error * per_e)


def _shared(found: Survey, c: int, top_dn: float) -> tuple[float, float]:
    """By how much more of its variance a pixel shares with its neighbours at a signal of `top_dn` than at none.

    Its error is infinite with fewer than three levels, and if they are of the same light.
    """
    if not found.repeated_darks:
        return 0.0, np.inf
    black = found.repeated_darks[0].mean_dn(c)
    signals = [group.mean_dn(c) - black for group in found.repeated_flats]
    lit = [i for i, signal in enumerate(signals) if 0 < signal < ABOVE_TOP * top_dn]
    if len(lit) < FEWEST_LEVELS or np.ptp(np.array(signals)[lit]) < LEAST_RANGE * top_dn:
        return 0.0, np.inf
    share, error = np.array([_with_neighbours(found.repeated_flats[i], c, found) for i in lit]).T
    slope, covariance = np.polyfit(np.array(signals)[lit] / top_dn, share, 1, w=1 / error, cov="unscaled")
    return float(slope[0]), float(np.sqrt(covariance[0, 0]))


def _with_neighbours(group: Group, c: int, found: Survey) -> tuple[float, float]:
    """Sum of the correlations of a pixel's noise with the next ones of its colour on all four sides, and its error.

    Rows that are not next to each other tell nothing of rows: both directions count as columns then.
    """
    rows = len(found.sampled_rows) * plane_rows(found)
    adjacent = len(found.sampled_rows) == found.shape[0]
    several = []
    for plane in group.of(c):
        level = plane.halves.level_dn
        noise = (level[0] - level[1]).astype(np.float64).reshape(int(rows), -1)
        low, high = np.quantile(noise, (0.001, 0.999))
        noise = np.clip(noise, low, high)
        noise -= noise.mean()
        across = (noise[:, 1:] * noise[:, :-1]).mean()
        down = (noise[1:] * noise[:-1]).mean() if adjacent and rows > 1 else across
        several.append(2 * (across + down) / max(noise.var(), 1e-12))
    pixels = sum(plane.halves.level_dn.shape[1] for plane in group.of(c))
    return float(np.mean(several)), float((2 if adjacent else 4) * np.sqrt((2 if adjacent else 1) / pixels))
