"""Gamma-distributed numbers for many pixels at once.

`jax.random.gamma` draws each pixel from a key of its own and all of them again until the last is accepted. Here a first
attempt is made for all pixels, and further ones only for the few that it left.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hsnoise._core.types import RandomKey

LEFT, SPARE = 8, 64  # the first attempt leaves 5 % of the pixels at most: room for an eighth of them, and so many more


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
    ones = jax.random.exponential(boost, raised.shape, raised.dtype)
    drawn = drawn.reshape(shape.shape)
    return jnp.where(shape < 1, drawn * jnp.exp(-ones.reshape(shape.shape) / shape), drawn)


@gamma.defjvp
def _(primals, tangents):
    key, shape = primals
    drawn = gamma(key, shape)
    return drawn, jax.lax.random_gamma_grad(shape, drawn) * tangents[1]


def _attempt(key: RandomKey, shape: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Proposals for shapes of 1 or more [pixel], and whether they are accepted."""
    of_normal, of_uniform = jax.random.split(key)
    d = shape - 1 / 3
    x = jax.random.normal(of_normal, shape.shape, shape.dtype)
    v = (1 + x / jnp.sqrt(9 * d)) ** 3
    below = -jax.random.exponential(of_uniform, shape.shape, shape.dtype)
    return d * v, (v > 0) & (below < x**2 / 2 + d - d * v + d * jnp.log(jnp.maximum(v, 1e-30)))


def _until_accepted(key: RandomKey, shape: jax.Array) -> jax.Array:
    """Gamma numbers for shapes of 1 or more [pixel]."""

    def again(state):
        number, kept, done = state
        drawn, accepted = _attempt(jax.random.fold_in(key, number), shape)
        return number + 1, jnp.where(done, kept, drawn), done | accepted

    begun = 0, jnp.zeros_like(shape), jnp.zeros(shape.shape, bool)
    return jax.lax.while_loop(lambda state: ~state[2].all(), again, begun)[1]
