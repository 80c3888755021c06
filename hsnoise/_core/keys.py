"""Random keys: from a seed, or named after what they draw, so that adding a draw does not change the others."""

from __future__ import annotations

import operator
import zlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hsnoise._core.naming import named
from hsnoise._core.types import RandomKey, is_traced

LARGEST_SEED = 2**32 - 1  # without 64-bit types JAX keeps only the lower 32 bits


def key_of(name: str, value: Any) -> RandomKey:
    """`value` as a random key: a key, new-style or old-style, is returned as it is; a whole number is made into one.

    Raises:
        TypeError: it is neither, or several keys; ValueError: a number outside 0 to LARGEST_SEED (a traced number
            cannot be checked). They name the argument, `name`.
    """
    dtype, shape = getattr(value, "dtype", None), getattr(value, "shape", None)
    if dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key) and shape == ():
        return value
    if dtype == np.uint32 and shape == jax.eval_shape(jax.random.PRNGKey, 0).shape:
        return value
    if is_traced(value) and shape == () and jnp.issubdtype(dtype, jnp.integer):
        return jax.random.key(value)
    seed = _whole(value) if shape in (None, ()) and not is_traced(value) else None
    expected = (
        f"{named(name)}: expected a whole number from 0 to {LARGEST_SEED} or one random key, such as jax.random.key(0)"
    )
    if seed is None:
        came = repr(value) if dtype is None else f"an array of {dtype} of shape {shape}"
        raise TypeError(f"{expected}, got {came}")
    if not 0 <= seed <= LARGEST_SEED:
        raise ValueError(f"{expected}, got {seed}")
    return jax.random.key(seed)


def _whole(value: Any) -> int | None:
    """`value` as an int; None if it is not a whole number, or True or False, which are hardly meant as seeds."""
    if isinstance(value, bool | np.bool_):
        return None
    try:
        return operator.index(value)
    except TypeError:
        return None


def named_key(key: RandomKey, name: str) -> RandomKey:
    """The key for `name`, derived from `key`.

    The hash is CRC-32 of the UTF-8 name: unlike Python's `hash`, it is the same in every process.
    """
    return jax.random.fold_in(key, np.uint32(zlib.crc32(name.encode())))


@jax.jit
def numbered_keys(key: RandomKey, numbers: np.ndarray) -> RandomKey:
    """A key for each of `numbers`, derived from `key` as by `jax.random.fold_in`."""
    return jax.vmap(jax.random.fold_in, (None, 0))(key, numbers)
