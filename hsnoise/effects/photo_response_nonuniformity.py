"""Gain of each pixel for light, the same in all frames."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp

from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage, param


class PhotoResponseNonuniformity(AbstractEffect):
    """Sensitivity of each pixel, max(1 + sigma z, 0) with z normal, the same in all frames of a sensor.

    Areas, micro-lenses and quantum efficiencies of pixels differ. It multiplies the expected photoelectrons, so their
    shot noise follows.

    In dark frames: nothing; flats show a grain that stays when frames are averaged and grows in proportion to light.

    Reference: EMVA Standard 1288, release 4.0, 2021 (PRNU).
    """

    name: ClassVar[str] = "photo_response_nonuniformity"
    stage: ClassVar[Stage] = Stage.LIGHT
    sigma: Scalar = param("1", low=0, doc="relative standard deviation over pixels")

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        pattern = jax.random.normal(capture.fixed_key(self.name), (1, *signal.shape[1:]), signal.dtype)
        return signal * jnp.maximum(1 + self.sigma * pattern, 0)
