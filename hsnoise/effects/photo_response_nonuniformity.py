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
    shot noise follows. Whole rows and columns may differ likewise, by what they share when the masks of the sensor are
    drawn, and even ones from odd ones, where neighbours are mirror images or share a readout; in a Bayer sensor even
    from odd ones of a colour.

    In dark frames: nothing; flats show a grain that stays when frames are averaged and grows in proportion to light,
    and stripes that do.

    Reference: EMVA Standard 1288, release 4.0, 2021 (PRNU of pixels, rows and columns).
    """

    name: ClassVar[str] = "photo_response_nonuniformity"
    stage: ClassVar[Stage] = Stage.LIGHT
    sigma: Scalar = param("1", low=0, amplitude=True, doc="relative standard deviation over pixels")
    row_sigma: Scalar = param(
        "1", low=0, default=0.0, held="at bounds", doc="the same over whole rows; simulated fits hold 0"
    )
    column_sigma: Scalar = param(
        "1", low=0, default=0.0, held="at bounds", doc="the same over whole columns; simulated fits hold 0"
    )
    row_parity: Scalar = param(
        "1", low=-1, high=1, default=0.0, held=True, doc="odd rows less even ones, relative; simulated fits hold it"
    )
    column_parity: Scalar = param(
        "1", low=-1, high=1, default=0.0, held=True, doc="odd columns less even ones, relative; simulated fits hold it"
    )

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        _, rows, columns = signal.shape
        pattern = 1 + self.sigma * jax.random.normal(capture.fixed_key(self.name), (1, rows, columns), signal.dtype)
        for axis, part, sigma, parity, shape in (
            (0, ".rows", self.row_sigma, self.row_parity, (1, rows, 1)),
            (1, ".columns", self.column_sigma, self.column_parity, (1, 1, columns)),
        ):
            z = jax.random.normal(capture.fixed_key(self.name + part), shape, signal.dtype)
            odd = jnp.asarray(capture.alternating(axis), signal.dtype).reshape(shape)
            pattern = pattern + sigma * z + parity * odd
        return signal * jnp.maximum(pattern, 0)

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker | None:
        if not facts.shows_signal or facts.light_e == 0:
            return None
        # A third of the relative noise of a pixel in the brightest flat.
        noise = np.sqrt(facts.light_e + facts.read_noise_e**2) / facts.light_e
        return lambda size, rng: cls(0.3 * size * noise)
