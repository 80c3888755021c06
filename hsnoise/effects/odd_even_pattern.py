"""Two readout chains with different offsets and gains."""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp

from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import param


class OddEvenPattern(AbstractEffect):
    """Two readout chains alternate: by columns, in a Bayer sensor by pairs of columns.

    Amplifiers above and below the sensor are never quite equal. The second chain reads `offset` more electrons than the
    first, and its gain is larger by `gain_mismatch`; each differs by half of that from the mean of both, which does not
    change. Bayer sensors use pairs of columns because each chain must read all colours.

    In dark frames: a fine vertical grating, the same in all frames; with a gain mismatch its contrast grows with
    exposure, and the noise of the columns alternates.

    Reference: EMVA Standard 1288, release 4.0, 2021 (spectrograms of periodic nonuniformity).
    """

    name: ClassVar[str] = "odd_even_pattern"
    stage: ClassVar[Stage] = Stage.READOUT
    measurable: ClassVar[bool] = True
    offset: Scalar = param("e-", amplitude=True, doc="second chain minus first")
    gain_mismatch: Scalar = param(
        "1", low=-1, high=1, default=0.0, amplitude=True, doc="relative gain, second chain minus first"
    )

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        width = 1 if capture.cfa == "mono" else 2
        chain = (capture.columns // width) % 2
        half = jnp.asarray(chain - 0.5, signal.dtype)[None, None]
        return signal * (1 + half * self.gain_mismatch) + half * self.offset

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker:
        # A fifth of the read noise between the two halves of the columns, with the sign that the capture shows.
        return lambda size, rng: cls(0.2 * size * facts.read_noise_e * facts.places.second_chain, 0.0)
