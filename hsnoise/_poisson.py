"""Poisson draws by inversion of one uniform number a pixel: no rejection, so that pixels run side by side.

Below SUM_BELOW electrons the distribution function is summed up, unrolled. Above, its inverse is a normal quantile put
through Temme's uniform expansion (Giles, "Algorithm 955: approximation of the inverse Poisson cumulative distribution
function", ACM Trans. Math. Softw. 42, 2016), whose polynomials these are.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.scipy.special import ndtri

SUM_BELOW, SUM_TERMS, SUM_LEAST = 12.0, 44, 1e-9
CENTRAL_FROM = -0.6833501
NEWTON_STEPS = 4

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


def poisson(key: jax.Array, mean: jax.Array) -> jax.Array:
    """Poisson counts of the given means, float32, the shape of `mean`. A negative or NaN mean gives 0."""
    bits = jax.random.bits(key, mean.shape, jnp.uint32)
    return poisson_of_bits(bits >> 9, mean.astype(jnp.float32))


def poisson_of_bits(cell: jax.Array, mean: jax.Array) -> jax.Array:
    """The count for `cell`, one of the 2^23 equal cells into which the unit interval is cut."""
    # 23 bits and the middle of the cell are exact in float32, and never 0 or 1.
    uniform = (cell.astype(jnp.float32) + 0.5) * jnp.float32(2.0**-23)
    few = _by_sum(uniform, jnp.minimum(mean, SUM_BELOW))
    many = _by_normal(uniform, jnp.maximum(mean, SUM_BELOW))
    return jnp.where(mean > 0, jnp.where(mean < SUM_BELOW, few, many), 0.0)


def _by_sum(uniform, mean):
    term = jnp.exp(-mean)
    below, count = term, jnp.zeros_like(mean)
    for k in range(1, SUM_TERMS + 1):
        # The sum may stop short of a uniform number next to 1; counting ends where terms no longer matter.
        count = count + ((uniform > below) & ((term > SUM_LEAST) | (mean > k))).astype(mean.dtype)
        term = term * (mean / k)
        below = below + term
    return count


def _by_normal(uniform, mean):
    s = ndtri(uniform) / jnp.sqrt(mean)
    excess = s + s * s * _polynomial(RATIO, s)
    central = _polynomial(ORDER_ONE, excess) + _polynomial(ORDER_INVERSE, excess) / mean + mean * excess
    return jnp.floor(jnp.maximum(mean + jnp.where(s > CENTRAL_FROM, central, _lower_tail(s, mean) - mean), 0.0))


def _lower_tail(s, mean):
    """Left of where the polynomials hold: r from r log r - r + 1 = s^2 / 2 by Newton's method, from the left."""
    half_square = jnp.minimum(0.5 * s * s, 1.0 - 1e-6)
    r = jnp.full_like(s, 1e-3)
    for _ in range(NEWTON_STEPS):
        log_r = jnp.log(r)
        r = jnp.clip(r - (r * log_r - r + 1 - half_square) / log_r, 1e-7, 0.45)
    order_one = jnp.log(-s * jnp.sqrt(r) / (1 - r)) / jnp.log(r)
    return mean * r + order_one - 0.0218 / (mean * r + 0.065 * mean)


def _polynomial(coefficients, x):
    value = jnp.full_like(x, coefficients[0])
    for c in coefficients[1:]:
        value = value * x + c
    return value
