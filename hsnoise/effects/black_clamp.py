"""The camera subtracts (part of) the mean of the dark current."""

from __future__ import annotations

from typing import ClassVar

from hsnoise._core.types import Frames, PerChannel, RandomKey
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import param


class BlackClamp(AbstractEffect):
    """The camera subtracts rate * exposure DN, estimated from pixels that see no light.

    Optically black pixels collect dark electrons like the others. Subtracting their mean keeps the black level in
    place, but does not remove the shot noise. The clamp is complete if `rate` is gain times dark current.

    In dark frames: the mean does not follow the exposure (or follows it too little), the variance does. In darks alone,
    only skewness, clipping and row gains distinguish it from another gain and dark current; a flat decides.

    Reference: Janesick, *Photon Transfer*, SPIE 2007 (optical black, clamping).
    """

    name: ClassVar[str] = "black_clamp"
    stage: ClassVar[Stage] = Stage.BLACK
    in_likelihood: ClassVar[bool] = True
    confounded_with: ClassVar[str] = "gain"
    decided_by: ClassVar[str] = "flats (evenly lit frames of two or more brightnesses) measure the gain by itself"
    rate: PerChannel = param(
        "DN/s", low=0, per_channel=True, amplitude=True, doc="dark level that the camera subtracts"
    )

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        return signal - capture.per_pixel(self.rate * capture.exposure_s)

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker | None:
        if not (facts.exposures_differ and facts.shows_dark_current):
            return None
        # Most of the dark current that the fit found, all at most: a clamp takes a share of what there is.
        level = facts.gain * facts.dark_e_per_s
        return lambda size, rng: cls(level * min(0.7 * size, 1.0))
