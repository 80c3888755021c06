"""Covariances of estimates, widened where they claim too much."""

from __future__ import annotations

import numpy as np
from scipy import special

from hsnoise.likelihood.parameters import numbers_of
from hsnoise.model import NoiseModel

SURE = 1e-6  # of its standard error, by which a number varies that is held
MOST_GROWTH = 10.0  # of an error; more is a parameter that the base fit did not know


def as_scattered(covariance: np.ndarray, gain: np.ndarray, prior: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Covariance [number, number] of estimates by linear weights, as draws show it: a sandwich.

    The inverse information, `covariance`, is right for weights that are the statistics' own inverse covariance, which
    few draws do not give. gain [number, statistic] leads from statistics to the score. prior [number]: inverse
    variances that hold numbers near the start. z: draws about their mean [draw, statistic], other ones than the weights
    are from. The noise of a mean of as many draws is included, and errors that so few draws tell are widened until
    1.96 of them hold 95 % (Student's t).
    """
    n = len(z)
    estimates = z @ (covariance @ gain).T
    few = (special.stdtrit(n - 1, 0.975) / special.ndtri(0.975)) ** 2
    return estimates.T @ estimates * few * (1 + 1 / n) / (n - 1) + (covariance * prior) @ covariance


def given(covariance: np.ndarray, held: list[int]) -> np.ndarray:
    """`covariance` of the other numbers if those of `held` are what they are; theirs is hardly more than 0."""
    conditional = covariance.copy()
    others = [i for i in range(len(covariance)) if i not in held and np.isfinite(covariance[i, i])]
    across = covariance[np.ix_(others, held)]
    known = across @ np.linalg.solve(covariance[np.ix_(held, held)], across.T)
    conditional[np.ix_(others, others)] -= known
    least = SURE**2 * np.diagonal(covariance)[held]
    conditional[held], conditional[:, held] = 0.0, 0.0
    conditional[held, held] = least
    return conditional


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


def with_gain(covariance: np.ndarray, params: NoiseModel, names: list[str], first: int) -> np.ndarray:
    """Covariance of numbers of which those from `first` on are independent in DN: electrons are DN over the mean gain.

    Without it, what was measured in DN to a percent would seem so in electrons, too, where the gain is known to four.
    """
    numbers, gains = {n.name: n for n in numbers_of(params)}, np.asarray(params["gain"].value, float)
    of_gain = [i for i, name in enumerate(names) if numbers[name].place == ("gain", "value")]
    slopes = np.zeros((len(names), len(of_gain)))
    for i, number in enumerate(map(numbers.__getitem__, names)):
        if i >= first and number.is_in_electrons:
            slopes[i] = -number.value_in(params) / (len(of_gain) * gains.mean())
    covariance = covariance + slopes @ covariance[of_gain]  # errors of others may be infinite
    return covariance + covariance[:, of_gain] @ slopes.T
