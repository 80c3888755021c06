"""Poisson and normal numbers by inversion of one uniform number a pixel: no rejection, so pixels run in parallel.

Each pixel has two words of random bits, one block of Threefry (Salmon et al., "Parallel random numbers: as easy as 1,
2, 3", SC 2011) at a counter of frame and pixel: they do not depend on how frames are batched or sharded. On CPUs that
is three to six times as fast as the numbers of `jax.random`.

Counts below SUM_TERMS come from an unrolled sum of the distribution function. Higher counts come from a normal quantile
by Temme's uniform expansion, with the polynomials of Giles ("Algorithm 955: approximation of the inverse Poisson
cumulative distribution function", ACM Trans. Math. Softw. 42, 2016). These are valid for quantiles from -0.68 to 1.78
root means: with 23 random bits, quantiles outside belong to counts that the sum covers.
"""

from __future__ import annotations

import math
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

Regime = Literal["few", "many", "any"]  # known of the means: all below FEW_BELOW; none below MANY_FROM; nothing
ROTATIONS, PARITY = ((13, 15, 26, 6), (17, 29, 16, 24)), np.uint32(0x1BD11BDA)

# With 23 bits, means below FEW_BELOW give only counts below SUM_TERMS, and means from MANY_FROM on none below it.
FEW_BELOW, MANY_FROM, SUM_TERMS = 9.0, 80.0, 32
SUM_END = 1 - 10 * 2.0**-24  # the sum of all terms may fall short of 1 by slightly less, because each is rounded

# Highest order first: r(s) = 1 + s + s^2 RATIO(s); the terms of order 1 and 1 / mean, by r - 1.
RATIO = (
    2.82298751e-07, -2.58136133e-06, 1.02118025e-05, -2.37996199e-05, 4.05347462e-05, -6.63730967e-05, 0.000124762566,
    -0.000256970731, 0.000558953132, -0.00133129194, 0.00370367937, -0.0138888706, 0.166666667,
)  # fmt: skip
ORDER_ONE = (
    1.86386867e-05, -0.000207319499, 0.0009689451, -0.00247340054, 0.00379952985, -0.00386717047, 0.00346960934,
    -0.00414125511, 0.00586752093, -0.00838583787, 0.0132793933, -0.027775536, 0.333333333,
)  # fmt: skip
ORDER_INVERSE = (
    -0.00014585224, 0.00146121529, -0.00610328845, 0.0138117964, -0.0186988746, 0.0168155118, -0.013394797,
    0.0135698573, -0.0155377333, 0.0174065334, -0.0198011178,
)  # fmt: skip
# Giles, "Approximating the erfinv function", GPU Computing Gems 2, 2011: by w - 2.5, and by sqrt(w) - 3 from w = 5.
ERFINV_CENTRE = (
    2.81022636e-08, 3.43273939e-07, -3.5233877e-06, -4.39150654e-06, 0.00021858087, -0.00125372503, -0.00417768164,
    0.246640727, 1.50140941,
)  # fmt: skip
ERFINV_TAIL = (
    -0.000200214257, 0.000100950558, 0.00134934322, -0.00367342844, 0.00573950773, -0.0076224613, 0.00943887047,
    1.00167406, 2.83297682,
)  # fmt: skip


def pixel_words(key: jax.Array, shape: tuple[int, ...]) -> tuple[jax.Array, jax.Array]:
    """Two random words (uint32) for each pixel of `shape` (frames, rows, columns): Threefry-2x32 of 20 rounds."""
    frame, row, column = (jax.lax.broadcasted_iota(jnp.uint32, shape, axis) for axis in range(3))
    return words_at(key, frame, row * np.uint32(shape[2]) + column)


def words_at(key: jax.Array, frame: jax.Array, pixel: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The words that `pixel_words` has in these frames at these pixels, counted along rows (uint32, of one shape)."""
    first, second = jax.random.bits(key, (2,), jnp.uint32)
    keys = (first, second, first ^ second ^ PARITY)
    a, b = frame + keys[0], pixel + keys[1]
    for i in range(5):
        for rotation in ROTATIONS[i % 2]:
            a = a + b
            b = a ^ ((b << np.uint32(rotation)) | (b >> np.uint32(32 - rotation)))
        a, b = a + keys[(i + 1) % 3], b + keys[(i + 2) % 3] + np.uint32(i + 1)
    return a, b


def regime_of(low: float, high: float) -> Regime:
    """The regime of means between `low` and `high`."""
    return "few" if high < FEW_BELOW else "many" if low >= MANY_FROM else "any"


def poisson_of_bits(bits: jax.Array, mean: jax.Array, regime: Regime = "any") -> jax.Array:
    """Poisson counts, float32, from each pixel's random bits (uint32) and mean (or one mean for all).

    The first 23 bits choose one of the equal cells of the unit interval. The regime only saves work: every regime that
    holds gives the same counts.
    """
    uniform, mean = _middle_of_cell(bits), mean.astype(jnp.float32)
    if regime == "few":
        count = _by_sum(uniform, mean)
    elif regime == "many":
        count = _by_normal(uniform, mean)
    else:
        count = _by_sum(uniform, mean)
        summed = (mean < FEW_BELOW) | (count < SUM_TERMS)
        count = jnp.where(summed, count, _by_normal(uniform, jnp.maximum(mean, FEW_BELOW)))
    return jnp.where(mean > 0, count, 0.0)


def uniform_of_bits(bits: jax.Array) -> jax.Array:
    """Uniform numbers above 0, float32, from all of the random bits (uint32): small ones are as fine as large ones."""
    return (bits.astype(jnp.float32) + 0.5) * jnp.float32(2.0**-32)


def normal_of_bits(bits: jax.Array) -> jax.Array:
    """Standard normal numbers, float32, from the first 23 of the random bits (uint32)."""
    return _normal_quantile(_middle_of_cell(bits))


def uniform_of_pixels(key: jax.Array, shape: tuple[int, ...], dtype=float) -> jax.Array:
    """Uniform numbers above 0 from the first word of each pixel of `shape` (frames, rows, columns)."""
    return uniform_of_bits(pixel_words(key, shape)[0]).astype(dtype)


def normal_of_pixels(key: jax.Array, shape: tuple[int, ...], dtype=float) -> jax.Array:
    """Standard normal numbers from the second word of each pixel of `shape` (frames, rows, columns)."""
    return normal_of_bits(pixel_words(key, shape)[1]).astype(dtype)


def by_quantiles(bits: jax.Array, quantiles: jax.Array, largest_logit: float) -> jax.Array:
    """Numbers of the distribution with these quantiles [knot], from random bits (uint32).

    Knots are at equal steps of the logit, up to the largest; beyond, the outermost stand for all.
    """
    odds = [jnp.log(word.astype(quantiles.dtype) + 0.5) for word in (bits, ~bits)]
    last = len(quantiles) - 1
    place = jnp.clip((odds[0] - odds[1]) / (2 * largest_logit) + 0.5, 0, 1) * last
    below = jnp.clip(place.astype(jnp.int32), 0, last - 1)
    share = place - below
    return quantiles[below] * (1 - share) + quantiles[below + 1] * share


def _middle_of_cell(bits: jax.Array) -> jax.Array:
    # 23 bits and the middle of the cell are exact in float32, and never 0 or 1.
    return ((bits >> 9).astype(jnp.float32) + 0.5) * jnp.float32(2.0**-23)


def _normal_quantile(uniform):
    # 1 - x^2 of erfinv's argument x = 2 u - 1, without the cancellation in the tails
    w = -jnp.log(4 * uniform * (1 - uniform))
    tail = jnp.sqrt(jnp.maximum(w, 5.0)) - 3
    factor = jnp.where(w < 5, _polynomial(ERFINV_CENTRE, w - 2.5), _polynomial(ERFINV_TAIL, tail))
    return factor * jnp.float32(2**0.5) * (2 * uniform - 1)


def _by_sum(uniform, mean):
    """The count, or SUM_TERMS if it is not below that."""
    uniform = jnp.minimum(uniform, jnp.float32(SUM_END))
    power = below = jnp.exp(-mean)
    count = (uniform > below).astype(jnp.int32)
    for k in range(1, SUM_TERMS):
        power = power * mean
        below = below + power * jnp.float32(1 / math.factorial(k))
        count = count + (uniform > below).astype(jnp.int32)
    return count.astype(uniform.dtype)


def _by_normal(uniform, mean):
    s = _normal_quantile(uniform) / jnp.sqrt(mean)
    excess = s + s * s * _polynomial(RATIO, s)
    correction = _polynomial(ORDER_ONE, excess) + _polynomial(ORDER_INVERSE, excess) / mean
    return jnp.floor(mean + (correction + mean * excess))


def _polynomial(coefficients, x):
    value = jnp.full_like(x, coefficients[0])
    for c in coefficients[1:]:
        value = value * x + c
    return value
