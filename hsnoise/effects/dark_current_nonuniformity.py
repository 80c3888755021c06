"""Dark current that differs between pixels."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp

from hsnoise._core.gamma import log_gamma_of_pixels
from hsnoise._core.poisson import normal_of_pixels
from hsnoise._core.types import Frames, PixelMap, RandomKey, Scalar, is_traced
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import param

SKEWED = 1  # what sets the random key of gamma numbers apart
AS_NORMAL = 0.01  # skew below which the logarithm is normal
LARGE = 10.0  # shape from which Stirling's series is exact to single precision
LEAST_GAMMA = 1e-30


class DarkCurrentNonuniformity(AbstractEffect):
    """Every pixel has its own dark current, the same in all frames: log-normal, with an unchanged mean over pixels.

    Defects and fields in the silicon differ from pixel to pixel. The factor exp(spread z - spread^2 / 2) with z normal
    has mean 1, so the rate of the dark current stays its mean over pixels. With a `skew` other than 0 the factor has a
    generalised gamma distribution: z = -ln(skew^2 G) / skew with G gamma-distributed of shape 1 / skew^2, and again a
    mean of 1. A skew of -spread makes it a gamma, of -1 a Weibull distribution; with a positive one many pixels are
    warm, and the share of those above a rate falls as its power -1 / (spread skew), whose product must be below 1. A
    few pixels far above all that are `hot_pixels`.

    In dark frames: a grain that stays when frames are averaged and grows in proportion to exposure, with more shot
    noise where it is bright; none in bias frames.

    References: Janesick, *Photon Transfer*, SPIE 2007 (dark current fixed pattern noise); Prentice, "A
    log gamma model and its maximum likelihood estimation", Biometrika 61, 1974 (of whose q skew is the negative).
    """

    name: ClassVar[str] = "dark_current_nonuniformity"
    stage: ClassVar[Stage] = Stage.ELECTRONS
    measurable: ClassVar[bool] = True
    adds: ClassVar[bool] = True
    spread: Scalar = param(
        "1", low=0, amplitude=True, doc="standard deviation of ln dark current over pixels, about that with a skew"
    )
    skew: Scalar = param(
        "1",
        low=-2,
        high=2,
        default=0.0,
        held=True,
        doc="skewness of ln dark current, 0 if log-normal; searches hold it",
    )

    def __check_init__(self):
        if any(is_traced(of) or not isinstance(of, jax.Array) for of in (self.spread, self.skew)):
            return  # what is no number has an error of its own
        if 1 <= (product := float(jnp.max(self.spread * self.skew))) < jnp.inf:
            raise ValueError(f"{self.name}.skew: expected spread * skew below 1, for a finite mean, got {product:.3g}.")

    def dark_current_scale(self, capture: Capture, shape: tuple[int, ...], *, key: RandomKey) -> PixelMap:
        key = capture.fixed_key(self.name)
        shape = (1, *shape[1:])

        def log_normal():
            return jnp.exp(self.spread * normal_of_pixels(key, shape) - self.spread**2 / 2)

        return jax.lax.cond(jnp.abs(self.skew) < AS_NORMAL, log_normal, lambda: self._skewed(key, shape))

    def _skewed(self, key: RandomKey, shape: tuple[int, ...]) -> PixelMap:
        skew = jnp.where(jnp.abs(self.skew) < AS_NORMAL, 1.0, self.skew)
        k, power = skew**-2, -self.spread / skew
        drawn = log_gamma_of_pixels(jax.random.fold_in(key, SKEWED), k, shape)
        return jnp.exp(power * drawn - _log_mean(k, power))

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        """The signal unchanged: the effect that draws the dark current applies the scale."""
        return signal

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker | None:
        if not (facts.exposures_differ and facts.shows_dark_current):
            return None
        # A third of the read noise in the longest exposure, as of offsets. Beyond 1.5, a few pixels have all of it.
        grain = 0.35 * facts.read_noise_e / facts.dark_e
        return lambda size, rng: cls(min(grain * size, 1.5))


def _log_mean(k: Scalar, power: Scalar) -> Scalar:
    """Logarithm of the mean of (G / k)^power, G gamma-distributed of shape k; power above -k.

    The difference of two large logarithms of the gamma function would have no digit left: Stirling's series instead.
    """
    large, small = jnp.maximum(k, LARGE), jnp.minimum(k, LARGE)
    above = jnp.maximum(power, -0.9 * large)
    series = (large + above - 0.5) * jnp.log1p(above / large) - above + (1 / (large + above) - 1 / large) / 12
    below = jnp.maximum(power, LEAST_GAMMA - small)
    exact = jax.lax.lgamma(small + below) - jax.lax.lgamma(small) - below * jnp.log(small)
    return jnp.where(k < LARGE, exact, series)
