"""Laws of shot noise, dark current and read noise."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from hsnoise.effects import DarkCurrent, ReadNoise, ShotNoise
from hsnoise.model import NoiseModel, sample, sample_dark

KEY = jax.random.key(11)
P_VALUE = 1e-5  # with fixed keys a correct law fails never, a wrong one always


def mono(*effects):
    return NoiseModel(effects, cfa="mono", shutter="rolling", exposure_s=0.05)


def poisson_p_value(draws, mean):
    """Chi-square of whole numbers against Poisson(mean); classes below 10 expected draws are pooled."""
    draws = np.asarray(draws).ravel()
    assert np.array_equal(draws, np.round(draws)) and draws.min() >= 0
    expected = len(draws) * stats.poisson.pmf(np.arange(int(draws.max()) + 1), mean)
    low, high = np.flatnonzero(expected >= 10)[[0, -1]]
    edges = np.concatenate([[-0.5], np.arange(low, high) + 0.5, [np.inf]])
    classes = np.diff(stats.poisson.cdf(edges, mean)) * len(draws)
    return stats.chisquare(np.histogram(draws, edges)[0], classes).pvalue


@pytest.mark.parametrize("mean_e", [0.3, 6.0, 80.0])
def test_shot_noise_is_poisson(mean_e):
    assert poisson_p_value(sample(KEY, np.full((1, 200, 200), mean_e), mono(ShotNoise())), mean_e) > P_VALUE


def test_no_light_no_photoelectrons():
    assert np.all(np.asarray(sample_dark(KEY, 2, (20, 20), mono(ShotNoise()))) == 0)


def test_dark_current_is_poisson_in_rate_times_exposure():
    model = mono(DarkCurrent(51.7))
    assert poisson_p_value(sample_dark(KEY, 1, (200, 200), model), 51.7 * 0.05) > P_VALUE
    assert poisson_p_value(sample_dark(KEY, 1, (200, 200), model, exposure_s=0.2), 51.7 * 0.2) > P_VALUE
    assert np.all(np.asarray(sample_dark(KEY, 1, (20, 20), model, exposure_s=0.0)) == 0)


def test_read_noise_is_normal():
    drawn = np.asarray(sample_dark(KEY, 1, (200, 200), mono(ReadNoise(3.5)))).ravel()
    assert stats.kstest(drawn / 3.5, "norm").pvalue > P_VALUE


def test_read_noise_gradient_is_the_pathwise_one():
    def second_moment(sigma):
        return jnp.mean(sample_dark(KEY, 1, (50, 50), mono(ReadNoise(sigma))) ** 2)

    # x = sigma e: d mean(x^2) / d sigma = 2 mean(x^2) / sigma, exactly.
    np.testing.assert_allclose(jax.grad(second_moment)(3.5), 2 * second_moment(3.5) / 3.5, rtol=1e-12)


def test_light_and_dark_electrons_are_one_poisson_number_and_read_noise_is_independent():
    clean, shape = np.full((1, 200, 200), 5.0), (200, 200)
    shot, dark, read = ShotNoise(), DarkCurrent(100.0), ReadNoise(2.0)
    electrons, noise = sample(KEY, clean, mono(dark, shot)), sample_dark(KEY, 1, shape, mono(read))
    assert poisson_p_value(electrons, 10.0) > P_VALUE
    np.testing.assert_allclose(sample(KEY, clean, mono(read, dark, shot)), electrons + noise, rtol=1e-6, atol=1e-6)
    correlation = np.corrcoef(np.ravel(electrons), np.ravel(noise))[0, 1]
    assert abs(correlation) < 5 / np.sqrt(clean.size)
