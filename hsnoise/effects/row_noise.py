"""Row noise: an additive offset of each row, new in each frame."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx

from hsnoise._core.coloured import coloured_normal, fading_power
from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker, either_side
from hsnoise.effects._parameters import param


class RowNoise(AbstractEffect):
    """Offset of each row, e-, new in each frame, the same for all colours of the row.

    All pixels of a row are sampled at once, so noise of supplies and references in that moment is common to them;
    circuits know no colours. One normal series runs over all sensor rows, white or with power k^-exponent (k cycles
    per frame; the DC term fades out toward exponent 1); slow noise of the supplies is 1/f. It follows the time of
    readout, so the shutter does not matter.

    In dark frames: horizontal streaks that change from frame to frame, equally strong in all colours and exposures.

    Attributes:
        after_gain: whether it arises after the gain: equal in DN in all colours, and independent of the row gain.
            Its electrons are then DN divided by the mean gain of the pixels.

    Reference: Janesick, *Photon Transfer*, SPIE 2007.
    """

    name: ClassVar[str] = "row_noise"
    stage: ClassVar[Stage] = Stage.READ
    sigma: Scalar = param("e-", low=0, amplitude=True, doc="standard deviation over rows")
    exponent: Scalar = param("1", default=0.0, doc="power falls as row frequency to minus this: 0 white, 1 is 1/f")
    after_gain: bool = eqx.field(static=True, default=False)

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        frames, rows, _ = signal.shape
        offset = self.sigma * coloured_normal(key, (frames, rows, 1), fading_power(rows, self.exponent), signal.dtype)
        return signal + capture.offset(offset, self.after_gain)

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker:
        # A quarter of the read noise: little in a pixel, many standard errors in the means of rows.
        read = facts.read_noise_e
        return lambda size, rng: cls(0.25 * size * read, rng.choice([0.0, 1.0]), either_side(rng))

    def components(self, capture: Capture) -> dict[str, float]:
        variance = capture.offset_variance(self.sigma**2, self.after_gain)
        lines, whole = capture.spread_of_lines(0, fading_power(capture.shape[0], self.exponent))
        return {"row_x_frame": lines * variance, "frame": whole * variance}
