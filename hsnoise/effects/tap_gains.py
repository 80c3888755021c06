"""Blocks of the frame whose outputs have gains of their own."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import param
from hsnoise.effects._taps import check_taps, tap_of


class TapGains(AbstractEffect):
    """Each of `row_taps` x `taps` equal blocks has its own gain, log-normal about 1, the same in all frames.

    The outputs of a CCD read at its corners, of a sensor whose halves are read up and down, or of fast sensors with one
    output for some hundred columns, have amplifiers and converters of their own. Signal and read noise are multiplied
    alike. The mean over so few outputs is not 1; a fit sees it as part of the gain.

    In dark frames: noise, and dark signal, change at sharp seams. In flats: panels that differ in brightness and, by
    the same factor, in variance over signal, which tells them from vignetting.

    Attributes:
        taps, row_taps: number of outputs over the columns and over the rows; at least 2 in all.

    Reference: Janesick, *Photon Transfer*, SPIE 2007 (gain of each amplifier from its own photon transfer).
    """

    name: ClassVar[str] = "tap_gains"
    stage: ClassVar[Stage] = Stage.READOUT
    measurable: ClassVar[bool] = True
    spread: Scalar = param("1", low=0, amplitude=True, doc="standard deviation of the logarithm of gain over outputs")
    taps: int = eqx.field(static=True, default=4)
    row_taps: int = eqx.field(static=True, default=1)

    def __check_init__(self):
        check_taps(self.name, self.taps, self.row_taps)

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        normal = jax.random.normal(capture.fixed_key(self.name), (self.row_taps * self.taps,), signal.dtype)
        gains = jnp.exp(self.spread * normal - self.spread**2 / 2)
        return signal * gains[tap_of(capture, self.taps, self.row_taps)][None]

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker | None:
        if not facts.may_be_outputs:
            return None
        # Five percent of the noise of many pixels; sensors have two outputs, four or eight, or one at each corner.
        layouts = ((2, 1), (4, 1), (8, 1), (1, 2), (2, 2))
        return lambda size, rng: cls(0.05 * size, *layouts[rng.integers(len(layouts))])
