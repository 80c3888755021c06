"""Gamma draws: their law, their derivative, and draws that are mapped."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from hsnoise._core.gamma import gamma

LEAST_P = 1e-3


@pytest.mark.parametrize("shape", [0.3, 0.999, 1.0, 1.7, 20.0, 3000.0])
def test_the_law(shape):
    drawn = np.asarray(gamma(jax.random.key(3), jnp.full(200_000, shape)), float)
    assert stats.kstest(drawn, stats.gamma(shape).cdf).pvalue > LEAST_P
    error = np.sqrt(2 + 6 / shape) / np.sqrt(len(drawn))  # of the variance, relative
    assert abs(np.mean((drawn - shape) ** 2) / shape - 1) < 4 * error


def test_what_the_first_attempt_leaves_has_the_law_too():
    """One pixel in twenty, at shapes about 1: drawn again until it is accepted."""
    shapes = jnp.tile(jnp.array([0.9, 1.0, 1.3, 4.0]), 50_000).reshape(4, 50_000)
    drawn = np.asarray(gamma(jax.random.key(5), shapes), float)
    laws = stats.gamma(np.asarray(shapes)).cdf(drawn)
    assert laws.shape == shapes.shape
    for i in range(4):
        assert stats.kstest(laws.ravel()[i::4], "uniform").pvalue > LEAST_P
    assert abs(np.corrcoef(laws[:2].ravel(), laws[2:].ravel())[0, 1]) < 4 / np.sqrt(laws.size / 2)


def test_few_pixels():
    """Where an eighth of the pixels is less than one, there is still room for what the first attempt leaves."""
    drawn = jax.vmap(lambda key: gamma(key, jnp.ones((1, 2))))(jax.random.split(jax.random.key(1), 20_000))
    assert stats.kstest(np.asarray(drawn, float).ravel(), "expon").pvalue > LEAST_P


@pytest.mark.slow
def test_the_derivative_of_a_mean_square():
    """E x^2 = a (a + 1), of which a small shape is raised by one and lowered again."""
    for shape in (0.5, 6.0):
        keys = jax.random.key(2)
        slope = jax.grad(lambda a, keys=keys: jnp.mean(gamma(keys, jnp.full(100_000, a)) ** 2))(shape)
        assert float(slope) == pytest.approx(2 * shape + 1, rel=0.03)
