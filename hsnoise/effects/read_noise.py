"""Noise of the readout circuit."""

from __future__ import annotations

from typing import ClassVar

from hsnoise._core.poisson import normal_of_pixels
from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import PIXELS, AbstractEffect, Capture, Stage
from hsnoise.effects._parameters import param


class ReadNoise(AbstractEffect):
    """Read noise: Normal(0, sigma^2) in each pixel, referred to electrons.

    Effects that modify it (heavy tails, another sigma in each pixel) are factors of mean square 1, so sigma remains
    the standard deviation, rms over pixels.

    Reference: Janesick, *Photon Transfer*, SPIE 2007.
    """

    name: ClassVar[str] = "read_noise"
    stage: ClassVar[Stage] = Stage.READ
    scaled_by: ClassVar[tuple[str, ...]] = ("read_noise_scale",)
    in_likelihood: ClassVar[bool] = True
    stream: ClassVar[str] = PIXELS
    sigma: Scalar = param("e-", low=0, amplitude=True, doc="standard deviation of the read noise")

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        noise = self.sigma * normal_of_pixels(key, signal.shape, signal.dtype)
        return signal + (noise if capture.read_noise_scale is None else noise * capture.read_noise_scale)

    def components(self, capture: Capture) -> dict[str, float]:
        return {"temporal": capture.offset_variance(self.sigma**2)}
