"""The distribution of dark current over pixels: its law, and the fit of it, against draws."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import gammaln

import hsnoise
from hsnoise.statistics.pixels.dark_currents import Noise, fitted, growth_cdf
from hsnoise.statistics.pixels.population import noise_of

PLAIN, HEAVY = (30.0, 0.4, 0.0, 0.005, 180.0, 0.0), (20.0, 0.2, 0.0, 0.02, 300.0, 1.2)
WARM, BOTH = (20.0, 0.15, 1.0, 0.005, 300.0, 0.0), (20.0, 0.15, 1.0, 0.02, 300.0, 0.8)
GAMMA, WEIBULL = (20.0, 0.3, -0.3, 0.0, 1.0, 0.0), (20.0, 0.5, -1.0, 0.005, 300.0, 0.0)
BESIDE = (10.0, 0.8, -0.8, 0.01, 50.0, 0.0)
TRUTHS = [PLAIN, (20.0, 0.2, 0.0, 0.02, 100.0, 0.0), (5.0, 0.6, 0.0, 0.0, 1.0, 0.0), HEAVY, WARM, BOTH, GAMMA, WEIBULL]
NOISES = [0.8, 4.0, 15.0]  # far narrower than the population, about as wide, wider


def drawn(rng, n, noise, mean, spread, skew, fraction, rate, hot_spread):
    body = mean * np.exp(spread * rng.standard_normal(n) - spread**2 / 2)
    rates = rate * np.exp(hot_spread * rng.standard_normal(n) - hot_spread**2 / 2)
    if skew != 0:
        body = rng.gamma(skew**-2, skew**2, n) ** (-spread / skew)
        body *= mean * np.exp(gammaln(skew**-2) - gammaln(skew**-2 - spread / skew)) * abs(skew) ** (2 * spread / skew)
    hot = np.where(rng.random(n) < fraction, rates * rng.exponential(size=n), 0.0)
    return body + hot + noise * rng.standard_normal(n)


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("truth", TRUTHS, ids=str)
def test_distribution_of_growth_is_that_of_draws(truth, noise):
    growth = drawn(np.random.default_rng(1), 400_000, noise, *truth)
    x = np.quantile(growth, np.linspace(0.001, 0.9995, 300))
    cdf = growth_cdf(x, Noise(noise), *truth)
    measured = np.searchsorted(np.sort(growth), x) / len(growth)
    assert np.abs(cdf - measured).max() < 5 * np.sqrt(0.25 / len(growth))
    assert np.all(np.diff(cdf) > 0)


@pytest.mark.parametrize("noise", NOISES[:2])
@pytest.mark.parametrize("truth", [PLAIN, HEAVY, WARM, BOTH, GAMMA, WEIBULL, BESIDE], ids=str)
def test_population_is_recovered_whatever_the_noise(noise, truth):
    values, errors = fitted(drawn(np.random.default_rng(2), 120_000, noise, *truth), Noise(noise))
    there = (np.array(truth) != 0) & ((np.arange(6) < 3) | (truth[3] > 0))
    pulls = (values - truth)[there] / errors[there]
    assert np.all(np.abs(pulls) < 4), (values, errors)
    assert np.all(errors[there] < 0.3 * np.abs(truth)[there])
    assert np.all(values[~there] == 0)


def test_hot_pixels_of_repeated_darks_beside_a_single_longer_one():
    """Their charge is that of the repeated exposure: over the longest one, they came out ten times too slow."""
    rng, shape, frames = np.random.default_rng(6), (128, 192), 8
    rate = np.where(rng.random(shape) < 0.01, rng.exponential(40.0, shape), 0.0)
    offset, response = rng.normal(0, 1, shape), 1 + 0.01 * rng.standard_normal(shape)

    def counts(n, electrons):
        read = 5 * rng.standard_normal((n, *shape))
        return np.rint(500 + 0.5 * (rng.poisson(np.broadcast_to(electrons, (n, *shape))) + read + offset)).astype("u2")

    stack = hsnoise.FrameStack(
        [counts(frames, rate), counts(1, 10 * rate), *(counts(6, light * response) for light in (2000, 8000))],
        [1.0, 10.0, 0.1, 0.4],
        kind=["dark", "dark", "flat", "flat"],
    )
    fit = hsnoise.fit(stack)
    share, value, error = fit.table["hot_pixels.fraction"][0], *fit.table["hot_pixels.rate"][:2]
    assert abs(share * value - rate.mean()) < 0.15 * rate.mean() and error < 0.3 * value


@pytest.mark.parametrize(("still", "per_growth"), [(0.3, 0.0125), (0.3, 0.0), (0.0, 0.1)])
def test_the_noise_of_growth_is_told_by_halves_that_differ(still, per_growth):
    rng = np.random.default_rng(4)
    growth = 3 * rng.lognormal(-0.5, 1.0, 400_000)
    halves = growth + np.sqrt(2 * (still**2 + per_growth * growth)) * rng.normal(size=(2, len(growth)))
    found = noise_of(halves)
    for at in (0.5, 3.0, 8.0):
        assert found.at(at) == pytest.approx(np.sqrt(still**2 + per_growth * at), rel=0.05)


def test_halves_that_are_mostly_equal_tell_no_growing_noise():
    rng = np.random.default_rng(7)
    halves = np.rint(rng.normal(3.0, 1.0, 40_000)) + (rng.random((2, 40_000)) < 0.1)
    assert noise_of(halves).per_growth == 0.0


@pytest.mark.parametrize(("fraction", "rate"), [(0.0, 1.0), (0.03, 40.0), (0.01, 200.0)])
def test_noise_that_grows_with_dark_current_is_no_skew(fraction, rate):
    """Broad dark currents of a million pixels had a skew of 0.15, and means 4 % too large, with errors of 0.2 %."""
    rng = np.random.default_rng(5)
    growth = 3 * rng.lognormal(-0.5, 1.0, 1_000_000)
    growth += np.where(rng.random(len(growth)) < fraction, rng.exponential(rate, len(growth)), 0.0)
    halves = growth + np.sqrt(2 * (0.3**2 + 0.0125 * growth)) * rng.normal(size=(2, len(growth)))
    values, errors = fitted(halves.mean(0), noise_of(halves))
    truth = np.array([3.0, 1.0, 0.0, fraction, rate * (fraction > 0), 0.0])
    known = np.isfinite(errors)
    assert np.all(np.abs(values - truth)[known] < 4 * errors[known]) and np.all(values[~known] == truth[~known])
