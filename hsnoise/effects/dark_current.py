"""Dark current and its shot noise."""

from __future__ import annotations

from typing import ClassVar

from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage, draw_poisson
from hsnoise.effects._parameters import param


class DarkCurrent(AbstractEffect):
    """Dark electrons: Poisson(rate * exposure) in each pixel.

    Reference: Janesick, *Photon Transfer*, SPIE 2007.
    """

    name: ClassVar[str] = "dark_current"
    stage: ClassVar[Stage] = Stage.ELECTRONS
    scaled_by: ClassVar[tuple[str, ...]] = ("dark_current_scale",)
    in_likelihood: ClassVar[bool] = True
    adds: ClassVar[bool] = True
    rate: Scalar = param("e-/s", low=0, amplitude=True, doc="dark electrons of a pixel in a second")

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        mean = self.rate * capture.exposure_s
        scale = capture.dark_current_scale
        return signal + draw_poisson(key, mean if scale is None else mean * scale, signal.shape)

    def components(self, capture: Capture) -> dict[str, float]:
        return {"temporal": capture.offset_variance(self.rate * capture.exposure_s)}
