"""Shot noise of the light."""

from __future__ import annotations

from typing import ClassVar

from hsnoise._core.types import Frames, RandomKey
from hsnoise.effects._base import PIXELS, AbstractEffect, Capture, Stage, draw_poisson


class ShotNoise(AbstractEffect):
    """Photoelectrons: Poisson with the clean signal as its mean.

    Reference: Janesick, *Photon Transfer*, SPIE 2007.
    """

    name: ClassVar[str] = "shot_noise"
    stage: ClassVar[Stage] = Stage.PHOTONS
    in_likelihood: ClassVar[bool] = True
    stream: ClassVar[str] = PIXELS

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        return draw_poisson(key, signal, signal.shape)
