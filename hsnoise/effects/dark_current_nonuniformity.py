"""Dark current that differs between pixels."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp

from hsnoise._core.types import Frames, PixelMap, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import param

WARM = 1  # what sets the random key of the tail apart


class DarkCurrentNonuniformity(AbstractEffect):
    """Every pixel has its own dark current, the same in all frames: log-normal, with an unchanged mean over pixels.

    Defects and fields in the silicon differ from pixel to pixel. The factor exp(spread z - spread^2 / 2) with z normal
    has mean 1, so the rate of the dark current stays its mean over pixels. Where many pixels are warmer than a
    log-normal has them, their logarithm has an exponential part as well, of mean `tail`: the share of pixels above a
    rate falls as its power -1 / tail. A few pixels far above all that are `hot_pixels`.

    In dark frames: a grain that stays when frames are averaged and grows in proportion to exposure, with more shot
    noise where it is bright; none in bias frames.

    References: Janesick, *Photon Transfer*, SPIE 2007 (dark current fixed pattern noise); Reed, Jorgensen, "The double
    Pareto-lognormal distribution", Commun. Stat. 33, 2004 (of one tail here).
    """

    name: ClassVar[str] = "dark_current_nonuniformity"
    stage: ClassVar[Stage] = Stage.ELECTRONS
    measurable: ClassVar[bool] = True
    adds: ClassVar[bool] = True
    spread: Scalar = param("1", low=0, amplitude=True, doc="standard deviation of ln dark current over pixels")
    tail: Scalar = param(
        "1", low=0, high=0.5, default=0.0, held="at bounds", doc="mean of an exponential part of ln dark current"
    )

    def dark_current_scale(self, capture: Capture, shape: tuple[int, ...], *, key: RandomKey) -> PixelMap:
        key = capture.fixed_key(self.name)
        z = jax.random.normal(key, (1, *shape[1:]))
        warm = jax.random.exponential(jax.random.fold_in(key, WARM), z.shape)
        return jnp.exp(self.spread * z - self.spread**2 / 2 + self.tail * warm) * (1 - self.tail)

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
