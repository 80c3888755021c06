"""A few pixels with much larger dark current."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp

from hsnoise._types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage, draw_poisson, param


class HotPixels(AbstractEffect):
    """Extra dark electrons, Poisson(rate_i * exposure), in a fraction of the pixels, the same in all frames.

    Defects of the silicon, many by radiation, generate charge. Every pixel is hot with probability `fraction`,
    independently; the rates of hot pixels are exponentially distributed with mean `rate`.

    In dark frames: bright dots at fixed places that grow in proportion to exposure, each with its own shot noise.

    Reference: Hopkinson, Dale, Marshall, "Proton effects in charge-coupled devices", IEEE Trans. Nucl. Sci. 43, 1996.
    """

    name: ClassVar[str] = "hot_pixels"
    stage: ClassVar[Stage] = Stage.ELECTRONS
    adds: ClassVar[bool] = True
    fraction: Scalar = param("1", low=0, high=1, doc="fraction of pixels that are hot")
    rate: Scalar = param("e-/s", low=0, doc="mean extra dark current of a hot pixel")

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        where, how_much = jax.random.split(capture.fixed_key(self.name))
        shape = (1, *signal.shape[1:])
        hot = jax.random.uniform(where, shape, signal.dtype) < self.fraction
        rates = self.rate * jax.random.exponential(how_much, shape, signal.dtype)
        mean = jnp.where(hot, rates * capture.exposure_s, 0)
        return signal + draw_poisson(key, mean, signal.shape)
