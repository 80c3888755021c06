"""Gain of each pixel for light, the same in all frames."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import param


class PhotoResponseNonuniformity(AbstractEffect):
    """Sensitivity of each pixel, max(1 + sigma z, 0) with z normal, the same in all frames of a sensor.

    Areas, micro-lenses and quantum efficiencies of pixels differ. It multiplies the expected photoelectrons, so their
    shot noise follows.

    In dark frames: nothing; flats show a grain that stays when frames are averaged and grows in proportion to light.

    Reference: EMVA Standard 1288, release 4.0, 2021 (PRNU).
    """

    name: ClassVar[str] = "photo_response_nonuniformity"
    stage: ClassVar[Stage] = Stage.LIGHT
    sigma: Scalar = param("1", low=0, amplitude=True, doc="relative standard deviation over pixels")

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        pattern = jax.random.normal(capture.fixed_key(self.name), (1, *signal.shape[1:]), signal.dtype)
        return signal * jnp.maximum(1 + self.sigma * pattern, 0)

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker | None:
        if not facts.shows_signal or facts.light_e == 0:
            return None
        # A third of the relative noise of a pixel in the brightest flat.
        noise = np.sqrt(facts.light_e + facts.read_noise_e**2) / facts.light_e
        return lambda size, rng: cls(0.3 * size * noise)
