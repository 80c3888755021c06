"""Shot noise, dark current and read noise in one step, and the derivatives of its draws.

A sum of Poisson numbers is Poisson, so shot noise and dark current are drawn as one. A Poisson number alone has no
derivative with respect to its mean. The sum x = Poisson(mean) + Normal(0, sigma^2) has a smooth distribution function
G, and hence the derivative -(dG/dtheta) / (dG/dx) at fixed G, which gives unbiased gradients of expectations (Figurnov,
Mohamed, Mnih, "Implicit reparameterization gradients", NeurIPS 2018).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.special import ndtr

from hsnoise._core.poisson import Regime, normal_of_bits, pixel_words, poisson_of_bits
from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects import AbstractEffect, Capture, DarkCurrent, ReadNoise, ShotNoise, Stage, param
from hsnoise.effects._base import PIXELS

NODES, UNROLLED = 33, 11  # of the sum over numbers of electrons
STIRLING_FROM = 20.0
HALF_LOG_2PI = 0.5 * math.log(2 * math.pi)


class Arrivals(AbstractEffect):
    """Shot noise and dark current in one, with the read noise if only effects that add electrons come between.

    sigma: rms read noise, e-; None if it is drawn later. regime: the known range of the mean electrons.
    """

    name: ClassVar[str] = "arrivals"
    stage: ClassVar[Stage] = Stage.PHOTONS
    scaled_by: ClassVar[tuple[str, ...]] = ("read_noise_scale", "dark_current_scale")
    stream: ClassVar[str] = PIXELS
    rate: Scalar = param("e-/s", low=0)
    sigma: Scalar | None = None
    regime: Regime = eqx.field(static=True, default="any")

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        return self.expose(signal, signal.shape, capture, key=key)

    def expose(self, light: jax.Array, shape: tuple[int, ...], capture: Capture, *, key: RandomKey) -> Frames:
        """Electrons [frame, row, column] from each pixel's expected photoelectrons, or one number for all."""
        dark = self.rate * capture.exposure_s
        mean = light + (dark if capture.dark_current_scale is None else dark * capture.dark_current_scale)
        first, second = pixel_words(key, shape)
        if self.sigma is None:
            return poisson_of_bits(first, jax.lax.stop_gradient(mean), self.regime).astype(mean.dtype)
        sigma = self.sigma if capture.read_noise_scale is None else self.sigma * capture.read_noise_scale
        return poisson_plus_normal(self.regime, first, second, mean, sigma)


def merged(effects: Sequence[AbstractEffect], regime: Regime) -> tuple[AbstractEffect, ...]:
    """The effects; shot noise, dark current and read noise merged if only effects that add electrons are between."""
    shot = next((i for i, effect in enumerate(effects) if isinstance(effect, ShotNoise)), None)
    if shot is None:
        return tuple(effects)
    rate, sigma, rest = jnp.zeros(()), None, []
    for i, effect in enumerate(effects[shot + 1 :], shot + 1):
        if isinstance(effect, DarkCurrent):
            rate = effect.rate
        elif isinstance(effect, ReadNoise):
            sigma = effect.sigma
        else:
            rest.append(effect)
        if sigma is not None or not effect.adds:
            rest.extend(effects[i + 1 :])
            break
    return (*effects[:shot], Arrivals(rate, sigma, regime), *rest)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def poisson_plus_normal(regime: Regime, first, second, mean, sigma) -> jax.Array:
    """Poisson(mean) + Normal(0, sigma^2) from two random words a pixel."""
    electrons = poisson_of_bits(first, mean, regime).astype(mean.dtype)
    return electrons + sigma * normal_of_bits(second).astype(mean.dtype)


@poisson_plus_normal.defjvp
def _derivative(regime, primals, tangents):
    *_, mean, sigma = primals
    x = poisson_plus_normal(regime, *primals)
    by_mean, by_sigma = slopes(x, mean, sigma)
    return x, by_mean * tangents[2] + by_sigma * tangents[3]


def slopes(x: jax.Array, mean: jax.Array, sigma: jax.Array) -> tuple[jax.Array, jax.Array]:
    """dx / dmean and dx / dsigma of a draw x at fixed distribution function; 0 without read noise.

    With w_k = P(k) phi((x - k) / sigma), the weight of k electrons given x, they are the sums over k of
    P(k) [Phi((x - k) / sigma) - Phi((x - k - 1) / sigma)] sigma and of w_k (x - k) / sigma, divided by that of w_k.
    """
    mean, has_noise = jnp.maximum(mean, 1e-20), sigma > 0
    sigma = jnp.where(has_noise, sigma, 1.0)
    share = mean / (mean + sigma**2)
    middle = jnp.maximum(jnp.round(mean + (x - mean) * share), 0.0)
    step = jnp.ceil((5 * sigma * jnp.sqrt(share) + 5) / (NODES // 2))
    level = _log_poisson(middle, mean) - 0.5 * ((x - middle) / sigma) ** 2

    def add(chunk, sums):
        for i in range(UNROLLED):
            k = middle + (chunk * UNROLLED + i - NODES // 2) * step
            log_p = jnp.where(k < 0, -jnp.inf, _log_poisson(jnp.maximum(k, 0.0), mean) - level)
            a = (x - k) / sigma
            weight = jnp.exp(log_p - 0.5 * a**2)
            rise = jnp.exp(log_p) * _between(a - 1 / sigma, a)
            sums = (sums[0] + weight, sums[1] + rise, sums[2] + weight * a)
        return sums

    zero = jnp.zeros_like(x)
    total, rise, deviation = jax.lax.fori_loop(0, NODES // UNROLLED, add, (zero, zero, zero))
    by_mean = rise * sigma * jnp.sqrt(2 * jnp.pi).astype(x.dtype) / total
    return jnp.where(has_noise, by_mean, 0.0), jnp.where(has_noise, deviation / total, 0.0)


def _between(low, high):
    """Phi(high) - Phi(low), computed in the nearer tail."""
    right = low + high > 0
    return ndtr(jnp.where(right, -low, high)) - ndtr(jnp.where(right, -high, low))


def _log_poisson(k, mean):
    low, high = jnp.minimum(k, STIRLING_FROM), jnp.maximum(k, STIRLING_FROM)
    # Stirling's series; for small k of (low + 4)!.
    z = low + 5
    log_factorial = (z - 0.5) * jnp.log(z) - z + HALF_LOG_2PI + 1 / (12 * z) - 1 / (360 * z**3)
    few = low * jnp.log(mean) - mean - log_factorial + jnp.log((z - 1) * (z - 2) * (z - 3) * (z - 4))
    # Near the mean the large terms cancel: take their difference before rounding.
    deviance = high * jnp.log(high / mean) + (mean - high)
    many = -deviance - HALF_LOG_2PI - 0.5 * jnp.log(high) - 1 / (12 * high)
    return jnp.where(k < STIRLING_FROM, few, many)
