"""Black level."""

from __future__ import annotations

from typing import ClassVar

from hsnoise._core.types import Frames, PerChannel, RandomKey
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._parameters import param


class BlackLevel(AbstractEffect):
    """Offset of each channel that the camera adds before it quantises, so that noise below zero survives."""

    name: ClassVar[str] = "black_level"
    stage: ClassVar[Stage] = Stage.BLACK
    in_likelihood: ClassVar[bool] = True
    value: PerChannel = param("DN", per_channel=True, doc="mean count of a pixel without electrons")

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        return signal + capture.per_pixel(self.value)
