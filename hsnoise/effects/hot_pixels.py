"""A few pixels with much larger dark current."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp

from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage, draw_poisson, param

PAIRS = 1  # what sets the random key of electrons that come in pairs apart


class HotPixels(AbstractEffect):
    """Extra dark electrons, Poisson(rate_i * exposure + at_readout_i), in a fraction of the pixels, always the same.

    Defects of the silicon, many by radiation, generate charge. Every pixel is hot with probability `fraction`,
    independently; the rates of hot pixels are exponentially distributed with mean `rate`. They go on while a frame
    waits to be read, for the same time in each: `at_readout` is in proportion to the rate.

    A single generation centre emits a hole, then an electron: where both steps take as long, every second arrival of a
    Poisson process is an electron, and the variance of many is half of their mean. `fano` is that ratio for large
    charges: a share 2 (1 - fano) of the charge comes so, the rest is Poisson.

    In dark frames: bright dots at fixed places that grow with exposure, each with its own shot noise, and of slow
    sensors fainter in bias frames, too.

    References: Cox, *Renewal Theory*, 1962; Hopkinson, Dale, Marshall, "Proton effects in charge-coupled devices", IEEE
    Trans. Nucl. Sci. 43, 1996.
    """

    name: ClassVar[str] = "hot_pixels"
    stage: ClassVar[Stage] = Stage.ELECTRONS
    adds: ClassVar[bool] = True
    fraction: Scalar = param("1", low=0, high=1, doc="fraction of pixels that are hot")
    rate: Scalar = param("e-/s", low=0, held="at bounds", doc="mean extra dark current of a hot pixel")
    at_readout: Scalar = param(
        "e-", low=0, default=0.0, held="at bounds", doc="mean extra electrons of a hot pixel whatever the exposure"
    )
    fano: Scalar = param("1", low=0.5, high=1, default=1.0, held="at bounds", doc="variance over mean of hot charge")

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        where, how_much = jax.random.split(capture.fixed_key(self.name))
        shape = (1, *signal.shape[1:])
        hot = jax.random.uniform(where, shape, signal.dtype) < self.fraction
        strength = jax.random.exponential(how_much, shape, signal.dtype)
        mean = jnp.where(hot, strength * (self.rate * capture.exposure_s + self.at_readout), 0)
        in_pairs = 2 * (1 - self.fano)
        single = draw_poisson(key, (1 - in_pairs) * mean, signal.shape)
        steps, phase = jax.random.split(jax.random.fold_in(key, PAIRS))

        def second_steps():
            begun = jax.random.bernoulli(phase, 0.5, signal.shape)
            return jnp.floor((draw_poisson(steps, 2 * in_pairs * mean, signal.shape) + begun) / 2)

        return signal + single + jax.lax.cond(in_pairs > 0, second_steps, lambda: jnp.zeros_like(signal))
