"""Poisson draws: enumerated over all uniform numbers, and drawn."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from hsnoise._core.poisson import normal_of_bits, pixel_words, poisson_of_bits, uniform_of_bits, words_at

CELLS = 2**23


def poisson(key, mean):
    return poisson_of_bits(jax.random.bits(key, mean.shape, jnp.uint32), mean)


@pytest.mark.parametrize(
    ("mean", "distance"),
    [
        (1e-4, 1e-6),
        (0.3, 1e-6),
        (3.0, 1e-6),
        (8.99, 2e-6),
        (9.01, 2e-6),
        (12.0, 2e-6),
        (20.0, 3e-6),
        (40.0, 1e-5),
        (60.0, 1e-5),
        (79.9, 1e-5),
        (80.1, 1e-5),
        (1000.0, 2e-5),
    ],  # fmt: skip
)
def test_all_uniform_numbers_give_the_law(mean, distance):
    bits = jnp.arange(CELLS, dtype=jnp.uint32) << 9
    counts = np.asarray(jax.jit(poisson_of_bits)(bits, jnp.full(CELLS, mean)))
    np.testing.assert_array_equal(jax.jit(poisson_of_bits)(bits, jnp.float32(mean)), counts)
    assert np.all(np.diff(counts) >= 0)
    drawn = np.bincount(counts.astype(int)) / CELLS
    law = stats.poisson.pmf(np.arange(len(drawn)), np.float32(mean))
    assert 0.5 * (np.abs(drawn - law).sum() + 1 - law.sum()) < distance
    # No uniform number runs to the end of a sum or a tail that ought not be reached.
    assert stats.poisson.sf(counts.max() - 1, mean) > 1e-9


def test_all_uniform_numbers_give_the_normal_law():
    drawn = np.asarray(jax.jit(normal_of_bits)(jnp.arange(CELLS, dtype=jnp.uint32) << 9))
    np.testing.assert_allclose(drawn, stats.norm.ppf((np.arange(CELLS) + 0.5) / CELLS), rtol=3e-6, atol=3e-7)


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


def test_words_are_those_of_threefry():
    """JAX's 32 random bits are both words of a block, one xor the other."""
    key = jax.random.key(4)
    first, second = pixel_words(key, (1, 8, 16))
    own = jax.random.wrap_key_data(jax.random.bits(key, (2,), jnp.uint32))
    with jax.threefry_partitionable(True):
        np.testing.assert_array_equal(first ^ second, jax.random.bits(own, (1, 8, 16), jnp.uint32))


def test_words_count_frames_and_pixels():
    key = jax.random.key(5)
    some, more = pixel_words(key, (2, 6, 8)), pixel_words(key, (5, 6, 8))
    for word, longer in zip(some, more, strict=True):
        np.testing.assert_array_equal(word, longer[:2])
        assert len(np.unique(longer)) == longer.size


@pytest.mark.parametrize(("mean", "regime"), [(3.0, "few"), (8.99, "few"), (80.0, "many"), (400.0, "many")])
def test_regimes_agree(mean, regime):
    bits = jnp.arange(CELLS, dtype=jnp.uint32) << 9
    jitted = jax.jit(poisson_of_bits, static_argnums=2)
    np.testing.assert_array_equal(jitted(bits, jnp.float32(mean), regime), jitted(bits, jnp.float32(mean)))


def test_uniform_numbers_are_above_zero_and_as_fine_near_it():
    bits = jnp.asarray([0, 1, 2, 2**20, 2**31, 2**32 - 1], jnp.uint32)
    found = np.asarray(uniform_of_bits(bits), float)
    np.testing.assert_allclose(found, (np.asarray(bits, float) + 0.5) / 2**32, rtol=1e-6)
    assert 0 < found[0] < found[1] < found[2] and found[-1] <= 1


def test_words_of_single_pixels_are_those_of_all():
    key = jax.random.key(5)
    every = pixel_words(key, (3, 5, 7))
    frame, pixel = jnp.asarray([[0], [2]], jnp.uint32), jnp.asarray([[0, 11, 34]], jnp.uint32)
    for one, other in zip(words_at(key, frame, pixel), every, strict=True):
        np.testing.assert_array_equal(one, other.reshape(3, -1)[np.asarray(frame), np.asarray(pixel)])
