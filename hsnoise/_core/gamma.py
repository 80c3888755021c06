"""Gamma-distributed numbers for many pixels at once.

`jax.random.gamma` draws each pixel from a key of its own and all of them again until the last is accepted. Here numbers
of one shape come from a table of quantiles; where each pixel has its own, a first attempt is made for all pixels, and
further ones only for the few that it left.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.scipy.special import gammaln

from hsnoise._core.poisson import by_quantiles, normal_of_bits, pixel_words, uniform_of_bits, uniform_of_pixels
from hsnoise._core.types import RandomKey, Scalar

LARGEST_LOGIT = 22.9  # of a uniform number of 32 bits
KNOTS, FINE_KNOTS = 1024, 4096
LEFT, SPARE = 8, 64  # the first attempt leaves 5 % of the pixels at most: room for an eighth of them, and so many more


def log_gamma_of_pixels(key: RandomKey, a: Scalar, shape: tuple[int, ...]) -> jax.Array:
    """Logarithms of gamma variables of shape parameter `a` over a, for pixels of `shape` (frames, rows, columns).

    The quantile function, from a table over the logit of a uniform number: both tails are straight lines there, nearly.
    """
    bits, _ = pixel_words(key, shape)
    return by_quantiles(bits, log_quantiles(a), LARGEST_LOGIT)


def log_quantiles(a: Scalar) -> jax.Array:
    """Logarithms of the quantiles of a gamma variable over its shape a, at equal steps of the logit [knot].

    From sums of its density on a fine grid: functions for both tails take several times as long to compile.
    """
    t = LARGEST_LOGIT + 2.0
    # The distribution function lies below x^a / Gamma(a + 1); with a chance of less than exp(-t) each, a variable is
    # below a - sqrt(2 a t), or above a + sqrt(2 a t) + t (Laurent and Massart, Annals of Statistics 28, 2000).
    width = jnp.sqrt(2 * t / a)
    low = jnp.maximum((gammaln(a + 1) - t) / a - jnp.log(a), jnp.log(jnp.maximum(1 - width, 1e-30)))
    high = jnp.log1p(width + t / a)
    u = low + (high - low) * jnp.linspace(0, 1, FINE_KNOTS, dtype=a.dtype)
    slope = -jnp.expm1(u)  # of the logarithm of the density of u, over a
    density = jnp.exp(a * (slope + u))
    pieces = (density[1:] + density[:-1]) * ((high - low) / (2 * (FINE_KNOTS - 1)))
    # Beyond both ends it falls exponentially.
    first, last = density[0] / (a * slope[0]), -density[-1] / (a * slope[-1])
    below = jnp.cumsum(jnp.concatenate([first[None], pieces]))
    above = jnp.cumsum(jnp.concatenate([last[None], pieces[::-1]]))[::-1]
    knots = jnp.linspace(-LARGEST_LOGIT, LARGEST_LOGIT, KNOTS, dtype=a.dtype)
    found = jnp.interp(knots, jnp.log(below) - jnp.log(above), u)
    return jnp.sort(found)  # as it is: else XLA computes an entry again for each pixel that looks it up


@jax.custom_jvp
def gamma(key: RandomKey, shape: jax.Array) -> jax.Array:
    """Gamma(shape) of scale 1, like `shape`, which must be positive; derivatives by implicit reparametrisation.

    References: Marsaglia, Tsang, "A simple method for generating gamma variables", ACM Trans. Math. Softw. 26, 2000;
    Figurnov, Mohamed, Mnih, "Implicit reparameterization gradients", NeurIPS 2018.
    """
    first, again, boost = jax.random.split(key, 3)
    raised = jnp.where(shape < 1, shape + 1, shape).ravel()
    drawn, accepted = _attempt(first, raised)
    left = jnp.flatnonzero(~accepted, size=min(raised.size, raised.size // LEFT + SPARE), fill_value=raised.size)
    drawn = drawn.at[left].set(_until_accepted(again, raised.at[left].get(mode="clip")), mode="drop")
    # A power of a uniform number takes one from the shape.
    ones = -jnp.log(uniform_of_pixels(boost, (1, 1, raised.size), raised.dtype))
    drawn = drawn.reshape(shape.shape)
    return jnp.where(shape < 1, drawn * jnp.exp(-ones.reshape(shape.shape) / shape), drawn)


@gamma.defjvp
def _(primals, tangents):
    key, shape = primals
    drawn = gamma(key, shape)
    return drawn, jax.lax.random_gamma_grad(shape, drawn) * tangents[1]


def _attempt(key: RandomKey, shape: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Proposals for shapes of 1 or more [pixel], and whether they are accepted."""
    of_uniform, of_normal = (word.reshape(shape.shape) for word in pixel_words(key, (1, 1, shape.size)))
    d = shape - 1 / 3
    x = normal_of_bits(of_normal).astype(shape.dtype)
    v = (1 + x / jnp.sqrt(9 * d)) ** 3
    below = jnp.log(uniform_of_bits(of_uniform)).astype(shape.dtype)
    return d * v, (v > 0) & (below < x**2 / 2 + d - d * v + d * jnp.log(jnp.maximum(v, 1e-30)))


def _until_accepted(key: RandomKey, shape: jax.Array) -> jax.Array:
    """Gamma numbers for shapes of 1 or more [pixel]."""

    def again(state):
        number, kept, done = state
        drawn, accepted = _attempt(jax.random.fold_in(key, number), shape)
        return number + 1, jnp.where(done, kept, drawn), done | accepted

    begun = 0, jnp.zeros_like(shape), jnp.zeros(shape.shape, bool)
    return jax.lax.while_loop(lambda state: ~state[2].all(), again, begun)[1]
