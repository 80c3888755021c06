"""Read noise with heavier tails than a Gaussian."""

from __future__ import annotations

import math
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax.scipy.special import gammainc, gammaincc, gammaln

from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import param

LARGEST_LOGIT = 22.9  # of a uniform number of 32 bits
KNOTS, FINE_KNOTS = 1024, 4096


class HeavyTailedReadNoise(AbstractEffect):
    """Read noise follows Student's t with `dof` degrees of freedom, its standard deviation unchanged.

    Switching traps make the noise of transistors non-normal. Student's t is a normal variable whose variance is new in
    each pixel and frame: the factor is sqrt((dof - 2) / chi2(dof)), of mean square 1. The excess kurtosis is
    6 / (dof - 4) for dof > 4. The larger dof, the closer to a Gaussian.

    In dark frames: more far outliers of both signs, anywhere, in new places in each frame.

    Reference: Wei, Fu, Zheng, Yang, "Physics-based noise modeling for extreme low-light photography", IEEE TPAMI 2021
    (long-tailed read noise).
    """

    name: ClassVar[str] = "heavy_tailed_read_noise"
    stage: ClassVar[Stage] = Stage.READ
    measurable: ClassVar[bool] = True
    dof: Scalar = param(
        "1", low=2.05, amplitude=True, absent=math.inf, doc="degrees of freedom of Student's t; infinite is normal"
    )

    def read_noise_scale(self, capture: Capture, shape: tuple[int, ...], *, key: RandomKey) -> Frames:
        # chi2(dof) is twice a gamma variable of dof / 2.
        log_gamma = _log_gamma(key, self.dof / 2, shape)
        return jnp.exp((jnp.log(self.dof / 2 - 1) - log_gamma) / 2)

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        """The signal unchanged: the effect that draws the read noise applies the scale."""
        return signal

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker:
        # Six degrees of freedom: an excess kurtosis of 3.
        return lambda size, rng: cls(2.05 + 4.0 / size)


def _log_gamma(key: RandomKey, a: Scalar, shape: tuple[int, ...]) -> jax.Array:
    """Logarithms of gamma variables: the quantile function, from a table over the logit of a uniform number.

    Both tails are straight lines there, nearly, and `jax.random.loggamma`, which rejects, is ten times slower.
    """
    bits = jax.random.bits(key, shape, jnp.uint32)
    odds = [jnp.log(b.astype(a.dtype) + 0.5) for b in (bits, ~bits)]
    place = (odds[0] - odds[1]) * ((KNOTS - 1) / (2 * LARGEST_LOGIT)) + (KNOTS - 1) / 2
    table = log_quantiles(a)
    below = jnp.clip(place.astype(jnp.int32), 0, KNOTS - 2)
    share = place - below
    return table[below] * (1 - share) + table[below + 1] * share


def log_quantiles(a: Scalar) -> jax.Array:
    """Logarithms of the quantiles of a gamma variable at equal steps of the logit [knot]."""
    t = LARGEST_LOGIT + 2.0
    # The distribution function lies below x^a / Gamma(a + 1); with a chance of less than exp(-t) each, a variable is
    # below a - sqrt(2 a t), or above a + sqrt(2 a t) + t (Laurent and Massart, Annals of Statistics 28, 2000).
    width = jnp.sqrt(2 * a * t)
    low = jnp.maximum((gammaln(a + 1) - t) / a, jnp.log(jnp.maximum(a - width, 1e-30)))
    high = jnp.log(a + width + t)
    log_x = low + (high - low) * jnp.linspace(0, 1, FINE_KNOTS, dtype=a.dtype)
    x = jnp.exp(log_x)
    logit = jnp.log(gammainc(a, x)) - jnp.log(gammaincc(a, x))
    return jnp.interp(jnp.linspace(-LARGEST_LOGIT, LARGEST_LOGIT, KNOTS, dtype=a.dtype), logit, log_x)
