"""Hits: pixels that are far above their level in a single frame, as cosmic rays leave them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls

from hsnoise._core.robust import robust_sigma

FEWEST_FRAMES, FEWEST_TWICE = 4, 6  # from which one frame, and two, can be told from the others
FAR, CALM = 8.0, 5.0  # deviations of a hit, at least, and of the pixel's other frames, at most
ALIKE = 0.1  # share of the hits that may look like tails or jumps: below the level, or twice in a pixel
FEWEST = 10


class Hits(NamedTuple):
    """Of one plane and exposure: charges above the level, DN, from `least_dn`; numbers of what is no hit; of counts."""

    charge_dn: np.ndarray
    least_dn: float
    others: int
    counts: int


class Rays(NamedTuple):
    """Hits as `cosmic_rays` has them, in DN, each value with its error."""

    rate: tuple[float, float]
    charge_dn: tuple[float, float]
    at_readout: tuple[float, float]


def hits_of(values: np.ndarray) -> Hits | None:
    """Of values [frame, pixel] without what frames, rows and columns share, DN; None of too few frames."""
    frames = len(values)
    if frames < FEWEST_FRAMES:
        return None
    ordered = np.sort(values, axis=0)
    middle = ordered[frames // 2]
    typical = robust_sigma(values - middle) * np.sqrt(frames / (frames - 1))

    def deviation(calm: np.ndarray) -> np.ndarray:
        """Of a pixel from its calm frames, with the shot noise of hot pixels, in units of the typical pixel's."""
        own = calm.std(0, ddof=1)
        return typical * np.maximum(own / max(float(np.median(own)), 1e-6), 1.0)

    sigma, up, down = deviation(ordered[1:-1]), ordered[-1] - middle, middle - ordered[0]
    is_hit = (up > FAR * sigma) & (ordered[-2] - middle < CALM * sigma)
    others = int(((down > FAR * sigma) & (middle - ordered[1] < CALM * sigma)).sum())
    if frames >= FEWEST_TWICE:
        sigma = deviation(ordered[1:-2])
        others += int(((ordered[-2] - middle > FAR * sigma) & (ordered[-3] - middle < CALM * sigma)).sum())
    return Hits(up[is_hit].astype(np.float64), FAR * typical, others, values.size)


def rays_of(hits: Sequence[tuple[float, Hits]]) -> Rays | None:
    """Cosmic rays from the hits of several exposures, s; None where these are few, or as many look like tails or jumps.

    Charges are taken as exponential: beyond any limit, they exceed it by their mean.
    """
    found = np.concatenate([of.charge_dn for _, of in hits]) if hits else np.zeros(0)
    number = len(found)
    if number < FEWEST or sum(of.others for _, of in hits) > ALIKE * number:
        return None
    beyond = np.concatenate([of.charge_dn - of.least_dn for _, of in hits])
    charge, of_least = float(beyond.mean()), float(np.mean([of.least_dn for _, of in hits]))
    whole = float(np.exp(of_least / charge))  # of all hits, over those above the limit
    counts = np.array([len(of.charge_dn) for _, of in hits])
    size, exposure_s = np.array([of.counts / 1e6 for _, of in hits]), np.array([t for t, _ in hits])
    at_bias = np.ptp(exposure_s) > 0 or not exposure_s.any()  # darks of one exposure do not tell when they are hit
    error = whole * np.sqrt(np.maximum(counts, 1))
    design = size[:, None] * np.stack([exposure_s, np.full(len(hits), float(at_bias))], 1) / error[:, None]
    values, _ = nnls(design, whole * counts / error)
    free = values > 0
    errors = np.zeros(2)
    errors[free] = np.sqrt(np.diagonal(np.linalg.inv(design[:, free].T @ design[:, free])))
    rate, at_readout = ((float(value), float(one)) for value, one in zip(values, errors, strict=True))
    return Rays(rate, (charge, charge / float(np.sqrt(number))), at_readout)
