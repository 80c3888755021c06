"""Covariances of estimates from simulated statistics, widened where they claim too much."""

from __future__ import annotations

import numpy as np

DRAWS_OF_ALL = 10.0  # what all numbers say of the scatter of one counts as so many draws
MOST_GROWTH = 10.0  # of an error; more is a parameter that the base fit did not know


def as_scattered(covariance: np.ndarray, gain: np.ndarray, z: np.ndarray) -> np.ndarray:
    """`covariance` [number, number], widened if estimates from draws scatter more than weights without correlation say.

    gain [number, statistic] leads from statistics to the score; z are draws about their mean [draw, statistic].
    """
    estimates, known = z @ (covariance @ gain).T, len(z) - 1
    ratio = (estimates**2).sum(0) / known / np.diagonal(covariance)
    # Few draws: what they say of one number is averaged with what they say of all.
    of_all = DRAWS_OF_ALL / (known + DRAWS_OF_ALL)
    factor = np.sqrt(np.maximum((1 - of_all) * ratio + of_all * ratio.mean(), 1.0))
    return covariance * factor[:, None] * factor[None, :]


def not_surer_than(base: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """`covariance`, widened where it claims to know base parameters better than the likelihood did without the effects.

    The effects' own errors are widened by as much.
    """
    n, known = len(base), np.isfinite(np.diagonal(base))
    before = np.where(known, np.diagonal(base), 0.0)
    growth = np.sqrt(np.maximum(before / np.maximum(np.diagonal(covariance)[:n], 1e-300), 1.0))
    few = growth[known & (growth < MOST_GROWTH)]
    factor = np.concatenate([growth, np.full(len(covariance) - n, np.median(few) if few.size else 1.0)])
    widened = covariance * factor[:, None] * factor[None, :]
    widened[np.flatnonzero(~known), np.flatnonzero(~known)] = np.inf  # still not determined
    return widened
