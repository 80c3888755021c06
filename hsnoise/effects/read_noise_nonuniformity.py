"""Read noise that differs between pixels."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp

from hsnoise._core.types import Frames, PixelMap, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import param


class ReadNoiseNonuniformity(AbstractEffect):
    """Every pixel has its own read-noise sigma, the same in all frames: log-normal, with an unchanged rms over pixels.

    Source followers differ in their flicker noise. The factor exp(spread z - spread^2) with z normal has mean square
    1, so the sigma of the read noise stays its rms over pixels.

    In dark frames: variance over time differs between pixels by more than chance, equally in all exposures; the
    histogram of all pixels has heavy tails.

    Reference: Janesick, Andrews, Elliott, "Fundamental performance differences between CMOS and CCD imagers",
    Proc. SPIE 6276, 2006.
    """

    name: ClassVar[str] = "read_noise_nonuniformity"
    stage: ClassVar[Stage] = Stage.READ
    measurable: ClassVar[bool] = True
    spread: Scalar = param("1", low=0, amplitude=True, doc="standard deviation of ln sigma over pixels")

    def read_noise_scale(self, capture: Capture, shape: tuple[int, ...], *, key: RandomKey) -> PixelMap:
        z = jax.random.normal(capture.fixed_key(self.name), (1, *shape[1:]))
        return jnp.exp(self.spread * z - self.spread**2)

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        """The signal unchanged: the effect that draws the read noise applies the scale."""
        return signal

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker:
        # Sigmas that differ by a third, as the sample sigmas of five frames do by chance.
        return lambda size, rng: cls(0.3 * size)
