"""A pixel keeps part of the previous one along the readout."""

from __future__ import annotations

from typing import ClassVar

from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage, step_from_previous
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import param


class ReadoutBandwidth(AbstractEffect):
    """Pixel j of a row reads (1 - fraction) of itself and `fraction` of pixel j - 1, read just before it.

    The output amplifier has not settled when the next pixel is sampled. This also affects the read noise; in a Bayer
    sensor the previous pixel has another colour. The first pixel of a row follows its own level, so means do not
    change.

    In dark frames: noise of neighbours along the row is correlated and its variance multiplied by (1 - f)^2 + f^2, at
    all exposures; noise of neighbours along the column is not correlated.

    Reference: Janesick, *Scientific Charge-Coupled Devices*, SPIE 2001 (settling of the video signal).
    """

    name: ClassVar[str] = "readout_bandwidth"
    stage: ClassVar[Stage] = Stage.READOUT
    fraction: Scalar = param("1", low=0, high=1, amplitude=True, doc="part of the previous pixel in a pixel's reading")

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        return signal - self.fraction * step_from_previous(signal)

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker | None:
        # Correlations of neighbours are measured to some thousandths.
        return (lambda size, rng: cls(0.03 * size)) if facts.may_share(1) else None
