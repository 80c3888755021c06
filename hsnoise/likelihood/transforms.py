"""Transforms between the values of parameters and unconstrained coordinates."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

LEAST = 1e-9  # above a lower bound, for a logarithm
LEAST_RATIO = 1e-6  # of a value to the scale of a softplus: below, nothing shows
OFF_BOUNDS = 1e-9  # a share that is fitted stays this far from 0 and 1, where it would be held
OFF_ENDS = 0.02  # share of the range between two bounds: at a bound itself, nothing could move a logit
FARTHEST_EXPONENT = 30.0


class Transform(NamedTuple):
    """One of them: coordinate = forward(value, low, high, scale), value = inverse(coordinate, low, high, scale).

    They work element by element. Of bounds and scale each uses what it needs.
    """

    forward: Callable
    inverse: Callable


def _limited(x):
    return jnp.clip(x, -FARTHEST_EXPONENT, FARTHEST_EXPONENT)


def _inverse_softplus(value, low, high, scale):
    ratio = jnp.maximum((value - low) / scale, LEAST_RATIO)
    return ratio + jnp.log(-jnp.expm1(-ratio))


def _to_between(value, low, high, scale):
    ratio = jnp.maximum((value - low) / scale, LEAST_RATIO)
    left = jnp.maximum((high - low) / scale - ratio, LEAST_RATIO)
    return ratio + jnp.log(jnp.expm1(-ratio) / jnp.expm1(-left))


def _from_between(x, low, high, scale):
    value = low + scale * (jax.nn.softplus(x) - jax.nn.softplus(x - (high - low) / scale))
    return jnp.clip(value, low + OFF_BOUNDS, high - OFF_BOUNDS)


def _logit(value, low, high, scale):
    share = (value - low) / (high - low)
    share = jnp.where(share < LEAST_RATIO, OFF_ENDS, jnp.minimum(share, 1 - OFF_ENDS))
    return jnp.log(share / (1 - share))


IDENTITY = Transform(lambda value, low, high, scale: value / scale, lambda x, low, high, scale: x * scale)
LOGARITHM = Transform(
    lambda value, low, high, scale: jnp.log(jnp.maximum(value - low, LEAST)),
    lambda x, low, high, scale: low + jnp.exp(_limited(x)),
)
LOGIT = Transform(_logit, lambda x, low, high, scale: low + (high - low) * jax.nn.sigmoid(_limited(x)))
# The value over a scale that the data resolve, bent to the lower bound, and likewise to the upper one.
SOFTPLUS = Transform(_inverse_softplus, lambda x, low, high, scale: low + scale * jax.nn.softplus(x))
SOFTPLUS_BETWEEN = Transform(_to_between, _from_between)


def of_bounds(low: float | None, high: float | None) -> Transform:
    """The transform of a number with these bounds, of which nothing more is known."""
    if low is None:
        return IDENTITY
    return LOGARITHM if high is None else LOGIT
