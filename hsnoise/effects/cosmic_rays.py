"""Cosmic rays: rare large hits in single frames."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from hsnoise._core.poisson import pixel_words, uniform_of_bits
from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import param


class CosmicRays(AbstractEffect):
    """Hits of single pixels, Poisson in space and time, each with an exponentially distributed charge.

    Muons and decays in the sensor's surroundings leave some 80 electrons per micrometre of silicon that they cross.
    Tracks over several pixels are not modelled. Two hits of one pixel in one exposure count as one.

    In dark frames: bright single pixels in different places in each frame. Their number is proportional to exposure,
    apart from hits while a frame waits to be read.

    Reference: Groom, "Cosmic rays and other nonsense in astronomical CCD imagers", Exp. Astron. 14, 2002.
    """

    name: ClassVar[str] = "cosmic_rays"
    stage: ClassVar[Stage] = Stage.ELECTRONS
    measurable: ClassVar[bool] = True
    adds: ClassVar[bool] = True
    rate: Scalar = param(
        "1/(Mpixel s)", low=0, held="at bounds", amplitude=True, doc="hits of a million pixels in a second"
    )
    charge: Scalar = param("e-", low=0, doc="mean charge of a hit")
    at_readout: Scalar = param(
        "1/Mpixel",
        low=0,
        default=0.0,
        held="at bounds",
        amplitude=True,
        doc="hits of a million pixels whatever the exposure",
    )

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        probability = -jnp.expm1(-1e-6 * (self.rate * capture.exposure_s + self.at_readout))
        # Two numbers for one: hits may be rarer than a word of 32 bits can tell.
        root = jnp.sqrt(jax.lax.stop_gradient(probability))
        one, other = (uniform_of_bits(word).astype(signal.dtype) for word in pixel_words(key, signal.shape))
        # Where a number lies below the root, it is uniform up to there.
        charge = jnp.round(-self.charge * jnp.log(one / jnp.maximum(root, 1e-30)))
        return signal + jnp.where((one < root) & (other < root), charge, 0)

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker:
        def make(size: float, rng: np.random.Generator) -> CosmicRays:
            hits = 40.0 * size  # of a million pixels: a few in each frame of a small capture
            if not facts.has_exposure:
                return cls(0.0, rng.uniform(15, 80) * facts.read_noise_e, hits)
            at_readout = rng.choice([0.05, 0.5, 0.95])  # of the hits in the longest exposure
            charge = rng.uniform(15, 80) * facts.read_noise_e  # far above the read noise
            return cls(hits * (1 - at_readout) / facts.longest_s, charge, hits * at_readout)

        return make

    def components(self, capture: Capture) -> dict[str, float]:
        probability = -np.expm1(-1e-6 * float(self.rate * capture.exposure_s + self.at_readout))
        # Exponential charges have twice the square of their mean as their mean square.
        square = probability * (2 - probability) * float(self.charge) ** 2
        return {"temporal": capture.offset_variance(square)}
