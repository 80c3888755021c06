"""Poisson draws: enumerated over all uniform numbers, and drawn."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from hsnoise._poisson import poisson, poisson_of_bits

CELLS = 2**23


@pytest.mark.parametrize(
    ("mean", "distance"),
    [(1e-4, 1e-6), (0.3, 1e-6), (3.0, 1e-6), (11.99, 2e-6), (12.01, 3e-5), (20.0, 1e-5), (60.0, 1e-5), (1000.0, 2e-5)],
)
def test_all_uniform_numbers_give_the_law(mean, distance):
    counts = np.asarray(jax.jit(poisson_of_bits)(jnp.arange(CELLS, dtype=jnp.uint32), jnp.full(CELLS, mean)))
    assert np.all(np.diff(counts) >= 0)
    drawn = np.bincount(counts.astype(int)) / CELLS
    law = stats.poisson.pmf(np.arange(len(drawn)), np.float32(mean))
    assert 0.5 * (np.abs(drawn - law).sum() + 1 - law.sum()) < distance
    # No uniform number runs to the end of a sum or a tail that ought not be reached.
    assert stats.poisson.sf(counts.max() - 1, mean) > 1e-9


@pytest.mark.parametrize("mean", [1e5, 1e6])
def test_large_means_keep_their_moments(mean):
    counts = np.asarray(poisson(jax.random.key(1), jnp.full(1_000_000, mean)), np.float64)
    assert abs(counts.mean() - mean) < 4 * np.sqrt(mean / counts.size) + 0.1
    assert counts.var() / mean == pytest.approx(1, abs=4 * np.sqrt(2 / counts.size))


def test_means_differ_from_pixel_to_pixel():
    mean = np.geomspace(0.1, 300, 64).astype(np.float32)
    counts = np.asarray(poisson(jax.random.key(2), jnp.broadcast_to(mean, (20_000, 64))))
    deviation = (counts.mean(0) - mean) / np.sqrt(mean / 20_000)
    assert np.abs(deviation).max() < 4.5
    np.testing.assert_allclose(counts.var(0) / mean, 1, atol=0.1)


def test_no_light_gives_no_electrons():
    assert not np.any(poisson(jax.random.key(3), jnp.zeros((64, 64))))
