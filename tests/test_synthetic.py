"""Standard errors of joint refits by simulated statistics."""

from __future__ import annotations

import numpy as np
import pytest

from hsnoise.synthetic import _as_scattered

STATISTICS, NUMBERS = 60, 3
SLOPES = np.random.default_rng(0).standard_normal((STATISTICS, NUMBERS))


def linear_fit(weight):
    """Covariance that weights claim, and the way from statistics to the score."""
    return np.linalg.inv(SLOPES.T @ weight @ SLOPES), SLOPES.T @ weight


def draws(covariance, n=12, seed=1):
    z = np.random.default_rng(seed).multivariate_normal(np.zeros(STATISTICS), covariance, n)
    return z - z.mean(0)


def test_errors_of_right_weights_stay():
    covariance, gain = linear_fit(np.eye(STATISTICS))
    widened = np.mean([_as_scattered(covariance, gain, draws(np.eye(STATISTICS), seed=s)) for s in range(40)], 0)
    assert np.sqrt(np.diagonal(widened) / np.diagonal(covariance)) == pytest.approx(1.0, abs=0.15)


def test_errors_of_weights_that_hide_a_correlation_are_widened():
    together = SLOPES[:, 0] / np.linalg.norm(SLOPES[:, 0])
    true = np.eye(STATISTICS) + 8.0 * np.outer(together, together)  # the first number's own direction scatters thrice
    covariance, gain = linear_fit(np.eye(STATISTICS))
    widened = np.mean([_as_scattered(covariance, gain, draws(true, seed=s)) for s in range(40)], 0)
    ratio = np.sqrt(np.diagonal(widened) / np.diagonal(covariance))
    assert 2.0 < ratio[0] < 3.5 and np.all(ratio >= 1.0)
