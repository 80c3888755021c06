"""Read noise of which a part goes on from one pixel to the next."""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from hsnoise._core.coloured import coloured_normal, power_of_ringing
from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import param


class CorrelatedReadNoise(AbstractEffect):
    """A share of the read noise's variance is noise that goes on along the readout, from pixel to pixel of a row.

    One amplifier reads pixel after pixel. Its 1/f noise, what correlated double sampling leaves of it, and interference
    outlast the time of a pixel: pixels k apart in a row, of any colour, have the correlation

        share * memory^k * cos(2 pi frequency k).

    A frequency of 0 is slow noise, 0.5 swings from pixel to pixel, between them lies interference. The sigma of
    the read noise stays that of both parts together; rows are independent.

    In dark frames: noise of neighbours along the row is correlated or anticorrelated, that of neighbours along the
    column is not. Unlike in `readout_bandwidth` and `readout_overshoot`, which act on the signal, the shot noise is
    not: correlations fall where it dominates, hot pixels have no trail, and the photon transfer line keeps its slope.

    Reference: Janesick, *Scientific Charge-Coupled Devices*, SPIE 2001 (noise power of correlated double sampling).
    """

    name: ClassVar[str] = "correlated_read_noise"
    stage: ClassVar[Stage] = Stage.READ
    share: Scalar = param("1", low=0, high=1, amplitude=True, doc="share of the read noise's variance")
    frequency: Scalar = param(
        "1/pixel", low=0, high=0.5, held="at bounds", doc="cycles per pixel around which it swings"
    )
    memory: Scalar = param("1", low=0, high=0.99, doc="what is left of a swing one pixel later")

    def read_noise_scale(self, capture: Capture, shape: tuple[int, ...], *, key: RandomKey) -> Frames:
        return jnp.sqrt(1 - self.share) * jnp.ones((1, 1, 1), self.share.dtype)

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        if capture.read_noise is None:
            return signal
        frames, rows, columns = signal.shape
        power = power_of_ringing(columns, self.frequency, self.memory).astype(signal.dtype)
        along = coloured_normal(key, (frames * rows, columns, 1), power, signal.dtype).reshape(signal.shape)
        return signal + jnp.sqrt(self.share) * capture.read_noise * along

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker:
        def make(size: float, rng: np.random.Generator) -> CorrelatedReadNoise:
            # Correlations of neighbours are measured to some thousandths.
            frequency = rng.choice([0.0, 0.5, rng.uniform(0.0, 0.5)])
            return cls(min(0.06 * size, 0.9), frequency, rng.uniform(0.2, 0.9))

        return make
