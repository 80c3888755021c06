"""Wherever a random key is taken, a whole number is its seed; what is neither is named."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import hsnoise
from hsnoise._core.keys import LARGEST_SEED, key_of
from hsnoise.effects import RowFixedPattern
from hsnoise.stlstm import STLSTM

CLEAN = np.full((2, 4, 6), 20.0, np.float32)
MODEL = hsnoise.cameras.grasshopper3().add(RowFixedPattern(5.0))

seeds = st.integers(0, LARGEST_SEED)


def bits(key) -> tuple[int, ...]:
    typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    return tuple(np.asarray(jax.random.key_data(key) if typed else key).tolist())


@given(seeds, st.sampled_from([int, np.int64, np.uint64, np.asarray, jnp.asarray]))
@example(0, np.uint8)
@example(LARGEST_SEED, np.uint32)
def test_a_whole_number_is_the_seed_of_a_key(seed, of):
    assert bits(key_of("key", of(seed))) == bits(jax.random.key(seed))


@given(seeds)
@example(2**31)
@example(LARGEST_SEED)
def test_a_seed_gives_the_same_key_whether_or_not_jax_has_64_bits(seed):
    with jax.enable_x64(False):
        narrow = bits(key_of("key", seed))
    assert narrow == bits(key_of("key", seed)) == (0, seed)


@given(seeds)
def test_keys_of_either_style_stay_as_they_are(seed):
    for key in (jax.random.key(seed), jax.random.PRNGKey(seed), np.asarray(jax.random.PRNGKey(seed))):
        assert key_of("key", key) is key


@given(st.one_of(st.integers(max_value=-1), st.integers(min_value=LARGEST_SEED + 1)))
def test_a_seed_out_of_range_is_named(seed):
    with pytest.raises(
        ValueError, match=f"^sensor_key: expected a whole number from 0 to {LARGEST_SEED} .*got {seed}$"
    ):
        key_of("sensor_key", seed)


WRONG = {
    "true": (True, "got True"),
    "numpy's false": (np.False_, "of bool"),
    "float": (1.0, "got 1.0"),
    "float of numpy": (np.float32(1), "of float32 of shape"),
    "text": ("7", "got '7'"),
    "none": (None, "got None"),
    "list": ([0, 1], r"got \[0, 1\]"),
    "whole numbers": (np.arange(2), r"of int64 of shape \(2,\)"),
    "one in an array": (np.array([3]), r"of int64 of shape \(1,\)"),
    "half a key": (np.zeros(1, np.uint32), r"of uint32 of shape \(1,\)"),
    "two halves too many": (np.zeros(4, np.uint32), r"of uint32 of shape \(4,\)"),
    "several of the old style": (np.zeros((3, 2), np.uint32), r"of uint32 of shape \(3, 2\)"),
    "several of the new": (jax.random.split(jax.random.key(0), 3), r"of key<fry> of shape \(3,\)"),
}


@pytest.mark.parametrize(("value", "came"), WRONG.values(), ids=WRONG)
def test_what_is_neither_key_nor_seed_is_named(value, came):
    with pytest.raises(TypeError, match=f"^key: expected a whole number .* or one random key.*{came}"):
        key_of("key", value)


def test_traced_floats_and_arrays_are_named_too():
    for value in (jnp.ones(()), jnp.arange(3)):
        with pytest.raises(TypeError, match="^key: expected a whole number"):
            jax.jit(lambda x: jax.random.normal(key_of("key", x)))(value)


@given(seeds, seeds)
@settings(max_examples=10)
def test_seeds_draw_what_their_keys_draw(seed, sensor):
    keys = jax.random.key(seed), jax.random.key(sensor)
    drawn = hsnoise.sample(keys[0], CLEAN, MODEL, sensor_key=keys[1])
    np.testing.assert_array_equal(hsnoise.sample(seed, CLEAN, MODEL, sensor_key=sensor), drawn)
    dark = hsnoise.sample_dark(keys[0], 2, (4, 6), MODEL, sensor_key=keys[1])
    np.testing.assert_array_equal(hsnoise.sample_dark(np.int64(seed), 2, (4, 6), MODEL, sensor_key=sensor), dark)


@pytest.mark.slow
def test_a_seed_may_be_traced_and_batched():
    def drawn(key):
        return hsnoise.sample(key, CLEAN, MODEL, sensor_key=1)

    one_by_one = [drawn(seed) for seed in range(3)]
    np.testing.assert_array_equal(jax.jit(drawn)(2), one_by_one[2])
    np.testing.assert_array_equal(jax.vmap(drawn)(jnp.arange(3)), one_by_one)
    keys = jax.vmap(jax.random.key)(jnp.arange(3))
    np.testing.assert_array_equal(jax.vmap(drawn)(keys), one_by_one)
    np.testing.assert_array_equal(jax.vmap(drawn)(jax.vmap(jax.random.key_data)(keys)), one_by_one)


def test_gradients_go_through_a_draw_from_a_seed():
    def level(gain, key):
        model = MODEL.with_value("gain", "value", gain)
        return hsnoise.sample(key, CLEAN, model, differentiable=True).mean()

    slope = jax.grad(level)(1.5, 3)
    assert np.isfinite(slope) and slope > 0
    np.testing.assert_allclose(jax.jit(jax.grad(level))(1.5, 3), slope, rtol=1e-5)
    np.testing.assert_allclose(jax.grad(level)(1.5, jax.random.key(3)), slope, rtol=1e-6)


def test_a_network_takes_a_seed():
    sizes = {"maps": 4, "kernels": (3,)}
    by_seed, by_key = (jax.tree.leaves(STLSTM(key, **sizes)) for key in (5, jax.random.key(5)))
    assert by_seed and len(by_seed) == len(by_key)
    for one, other in zip(by_seed, by_key, strict=True):
        np.testing.assert_array_equal(one, other)
    with pytest.raises(TypeError, match="^key: expected a whole number"):
        STLSTM(0.5, **sizes)
