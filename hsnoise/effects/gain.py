"""System gain."""

from __future__ import annotations

from typing import ClassVar

from hsnoise._core.types import Frames, PerChannel, RandomKey
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._parameters import param


class Gain(AbstractEffect):
    """System gain K of each channel: electrons to DN.

    Reference: Janesick, *Photon Transfer*, SPIE 2007.
    """

    name: ClassVar[str] = "gain"
    stage: ClassVar[Stage] = Stage.GAIN
    in_likelihood: ClassVar[bool] = True
    value: PerChannel = param("DN/e-", low=0, per_channel=True, doc="system gain")

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        return signal * capture.per_pixel(self.value)
