"""A few pixels with much larger dark current."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage, draw_poisson
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import param

PAIRS, KINDS = 1, 2  # what sets the random keys of electrons that come in pairs, and of kinds of defects, apart


class HotPixels(AbstractEffect):
    """Extra dark electrons, Poisson(rate_i * exposure + at_readout_i), in a fraction of the pixels, always the same.

    Defects of the silicon, many by radiation, generate charge. Every pixel is hot with probability `fraction`,
    independently; the rates of hot pixels are exponentially distributed with mean `rate`, or, as defects differ in
    energy and field, exponential about means that are log-normal: `spread` is the standard deviation of their
    logarithm, and a few pixels are then hundreds of times as hot as most. They generate charge also while a frame waits
    to be read, for the same time in each frame: `at_readout` is proportional to the rate.

    A single generation centre emits a hole, then an electron: if both steps take equally long, every second arrival of
    a Poisson process is an electron, and the variance of many is half of their mean. `fano` is that ratio for large
    charges: a share 2 (1 - fano) of the charge arrives this way, the rest is Poisson.

    In dark frames: bright dots at fixed places that grow with exposure, each with its own shot noise; in slow sensors
    they also show, fainter, in bias frames.

    References: Cox, *Renewal Theory*, 1962; Hopkinson, Dale, Marshall, "Proton effects in charge-coupled devices", IEEE
    Trans. Nucl. Sci. 43, 1996.
    """

    name: ClassVar[str] = "hot_pixels"
    stage: ClassVar[Stage] = Stage.ELECTRONS
    measurable: ClassVar[bool] = True
    adds: ClassVar[bool] = True
    fraction: Scalar = param("1", low=0, high=1, doc="fraction of pixels that are hot")
    rate: Scalar = param("e-/s", low=0, held="at bounds", amplitude=True, doc="mean extra dark current of a hot pixel")
    at_readout: Scalar = param(
        "e-",
        low=0,
        default=0.0,
        held="at bounds",
        amplitude=True,
        doc="mean extra electrons of a hot pixel whatever the exposure",
    )
    fano: Scalar = param("1", low=0.5, high=1, default=1.0, held="at bounds", doc="variance over mean of hot charge")
    spread: Scalar = param(
        "1", low=0, default=0.0, held="at bounds", doc="standard deviation of ln of hot pixels' mean rates"
    )

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        where, how_much = jax.random.split(capture.fixed_key(self.name))
        shape = (1, *signal.shape[1:])
        hot = jax.random.uniform(where, shape, signal.dtype) < self.fraction
        strength = jax.random.exponential(how_much, shape, signal.dtype)
        kind = jax.random.normal(jax.random.fold_in(how_much, KINDS), shape, signal.dtype)
        strength = strength * jnp.exp(self.spread * kind - self.spread**2 / 2)
        mean = jnp.where(hot, strength * (self.rate * capture.exposure_s + self.at_readout), 0)
        in_pairs = 2 * (1 - self.fano)
        single = draw_poisson(key, (1 - in_pairs) * mean, signal.shape)
        steps, phase = jax.random.split(jax.random.fold_in(key, PAIRS))

        def second_steps():
            begun = jax.random.bernoulli(phase, 0.5, signal.shape)
            return jnp.floor((draw_poisson(steps, 2 * in_pairs * mean, signal.shape) + begun) / 2)

        return signal + single + jax.lax.cond(in_pairs > 0, second_steps, lambda: jnp.zeros_like(signal))

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker:
        def make(size: float, rng: np.random.Generator) -> HotPixels:
            # From just above the read noise to far beyond it, in three pixels of a thousand: a few dozen in any frame.
            charge = np.exp(rng.uniform(np.log(4), np.log(120))) * facts.read_noise_e
            fraction = min(0.003 * size, 0.2)
            if not facts.has_exposure:  # collected while bias frames wait to be read
                return cls(fraction, 0.0, charge)
            rate = charge / facts.longest_s
            # In some sensors a hundredth of the charge while a frame waits to be read, which only a bias frame tells.
            return cls(fraction, rate, rng.choice([0.0, 0.01]) * rate * facts.longest_s if facts.has_bias else 0.0)

        return make

    def components(self, capture: Capture) -> dict[str, float]:
        if self.fano < 1:  # the variance of a few electrons in pairs has no simple formula
            return {}
        mean = float(self.rate * capture.exposure_s + self.at_readout)
        # Exponential charges have twice the square of their mean as their mean square.
        square = 2 * np.exp(float(self.spread) ** 2)
        static = float(self.fraction) * (square - float(self.fraction)) * mean**2
        return {
            "pixel": capture.offset_variance(static),
            "temporal": capture.offset_variance(float(self.fraction) * mean),
        }
