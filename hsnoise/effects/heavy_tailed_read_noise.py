"""Read noise with heavier tails than a Gaussian."""

from __future__ import annotations

import math
from typing import ClassVar

import jax.numpy as jnp

from hsnoise._core.gamma import log_gamma_of_pixels
from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import param


class HeavyTailedReadNoise(AbstractEffect):
    """Read noise follows Student's t with `dof` degrees of freedom, its standard deviation unchanged.

    Switching traps make the noise of transistors non-normal. Student's t is a normal variable whose variance is new in
    each pixel and frame: the factor is sqrt((dof - 2) / chi2(dof)), of mean square 1. The excess kurtosis is
    6 / (dof - 4) for dof > 4. The larger dof, the closer to a Gaussian.

    In dark frames: more far outliers of both signs, anywhere, in new places in each frame.

    Reference: Wei, Fu, Zheng, Yang, "Physics-based noise modeling for extreme low-light photography", IEEE TPAMI 2021
    (long-tailed read noise).
    """

    name: ClassVar[str] = "heavy_tailed_read_noise"
    stage: ClassVar[Stage] = Stage.READ
    measurable: ClassVar[bool] = True
    dof: Scalar = param(
        "1", low=2.05, amplitude=True, absent=math.inf, doc="degrees of freedom of Student's t; infinite is normal"
    )

    def read_noise_scale(self, capture: Capture, shape: tuple[int, ...], *, key: RandomKey) -> Frames:
        # chi2(dof) is twice a gamma variable of dof / 2.
        return jnp.exp((jnp.log1p(-2 / self.dof) - log_gamma_of_pixels(key, self.dof / 2, shape)) / 2)

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        """The signal unchanged: the effect that draws the read noise applies the scale."""
        return signal

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker:
        # Six degrees of freedom: an excess kurtosis of 3.
        return lambda size, rng: cls(2.05 + 4.0 / size)
