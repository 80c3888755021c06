"""Column noise: an additive offset of each column, new in each frame."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp

from hsnoise._core.coloured import coloured_normal, fading_power
from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker, either_side
from hsnoise.effects._parameters import param


class ColumnNoise(AbstractEffect):
    """Offset of each column, e-, new in each frame, the same for all colours of the column.

    Column amplifiers that sample their reference once a frame hold its noise for all rows. One normal series runs
    over all sensor columns, white or with power k^-exponent (k cycles per frame; the DC term
    fades out toward exponent 1).

    In dark frames: vertical streaks that change from frame to frame, equally strong in all colours and exposures.

    Attributes:
        after_gain: whether it arises after the gain: equal in DN in all colours, and independent of the row gain.
            Its electrons are then DN divided by the mean gain of the pixels.

    Reference: Janesick, *Photon Transfer*, SPIE 2007.
    """

    name: ClassVar[str] = "column_noise"
    stage: ClassVar[Stage] = Stage.READ
    sigma: Scalar = param("e-", low=0, amplitude=True, doc="standard deviation over columns")
    exponent: Scalar = param("1", default=0.0, doc="power falls as column frequency to minus this: 0 white, 1 is 1/f")
    after_gain: bool = eqx.field(static=True, default=False)

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        frames, _, columns = signal.shape
        series = coloured_normal(key, (frames, columns, 1), fading_power(columns, self.exponent), signal.dtype)
        return signal + capture.offset(self.sigma * jnp.swapaxes(series, 1, 2), self.after_gain)

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker:
        # As row noise: a quarter of the read noise stands out of the means of columns.
        read = facts.read_noise_e
        return lambda size, rng: cls(0.25 * size * read, rng.choice([0.0, 1.0]), either_side(rng))

    def components(self, capture: Capture) -> dict[str, float]:
        variance = capture.offset_variance(self.sigma**2, self.after_gain)
        lines, whole = capture.spread_of_lines(1, fading_power(capture.shape[1], self.exponent))
        return {"column_x_frame": lines * variance, "frame": whole * variance}
