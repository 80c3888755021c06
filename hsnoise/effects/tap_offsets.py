"""Blocks of columns that different output taps read."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax

from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker, either_side
from hsnoise.effects._parameters import param


class TapOffsets(AbstractEffect):
    """Each of `taps` equal blocks of columns has its own offset, Normal(0, sigma^2) in e-, the same in all frames.

    Fast sensors read blocks of columns through separate outputs, whose offsets are only trimmed to some accuracy. The
    mean of so few offsets is not zero; a fit sees it as part of the black level.

    In dark frames: vertical panels with sharp edges, the same in all exposures.

    Attributes:
        taps: number of outputs, at least 2.
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

    def __check_init__(self):
        if not isinstance(self.taps, int) or self.taps < 2:
            raise ValueError(f"tap_offsets.taps: expected a whole number of at least 2, got {self.taps!r}.")

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        tap = capture.columns * self.taps // capture.sensor_shape[1]
        offsets = jax.random.normal(capture.fixed_key(self.name), (self.taps,), signal.dtype)
        return signal + capture.offset(self.sigma * offsets[tap][None, None], self.after_gain)

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker:
        # A quarter of the read noise between blocks of many columns; sensors have two outputs, four or eight.
        read = facts.read_noise_e
        return lambda size, rng: cls(0.25 * size * read, int(rng.choice([2, 4, 8])), either_side(rng))
