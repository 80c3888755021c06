"""Blocks of the frame that different outputs read."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax

from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker, either_side
from hsnoise.effects._parameters import param
from hsnoise.effects._taps import check_taps, tap_of


class TapOffsets(AbstractEffect):
    """Each of `row_taps` x `taps` equal blocks has its own offset, Normal(0, sigma^2) in e-, the same in all frames.

    That of each output may wander, too: Normal(0, frame_sigma^2) is added, new in each frame.

    Fast sensors read blocks of columns through separate outputs, large ones their halves or quarters, and offsets are
    only trimmed to some accuracy. The mean of so few offsets is not zero; a fit sees it as part of the black level.

    In dark frames: panels with sharp edges, the same in all exposures. A fit measures frame_sigma of outputs that lie
    side by side: what rows share would look like that of outputs one above the other.

    Attributes:
        taps, row_taps: number of outputs over the columns and over the rows; at least 2 in all.
        after_gain: whether it arises after the gain: equal in DN in all colours, and independent of the row gain.
            Its electrons are then DN divided by the mean gain of the pixels.

    Reference: EMVA Standard 1288, release 4.0, 2021 (nonuniformity of columns).
    """

    name: ClassVar[str] = "tap_offsets"
    stage: ClassVar[Stage] = Stage.READ
    measurable: ClassVar[bool] = True
    sigma: Scalar = param("e-", low=0, amplitude=True, doc="standard deviation over taps")
    taps: int = eqx.field(static=True, default=4)
    after_gain: bool = eqx.field(static=True, default=False)
    row_taps: int = eqx.field(static=True, default=1)
    frame_sigma: Scalar = param(
        "e-", low=0, default=0.0, held="at bounds", doc="the same from frame to frame; simulated fits hold 0"
    )

    def __check_init__(self):
        check_taps(self.name, self.taps, self.row_taps)

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        outputs, tap = self.row_taps * self.taps, tap_of(capture, self.taps, self.row_taps)
        fixed = jax.random.normal(capture.fixed_key(self.name), (outputs,), signal.dtype)[tap][None]
        moving = jax.random.normal(key, (len(signal), outputs), signal.dtype)[:, tap]
        return signal + capture.offset(self.sigma * fixed + self.frame_sigma * moving, self.after_gain)

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker | None:
        if not facts.may_be_outputs:
            return None
        # A quarter of the read noise between blocks of many columns; sensors have two outputs, four or eight.
        read = facts.read_noise_e
        return lambda size, rng: cls(0.25 * size * read, int(rng.choice([2, 4, 8])), either_side(rng))
