"""Fixed pattern of columns: an additive offset of each column, the same in all frames."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp

from hsnoise._core.coloured import coloured_normal, fading_power
from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker, either_side
from hsnoise.effects._parameters import param


class ColumnFixedPattern(AbstractEffect):
    """Offset of each column, e-, the same in all frames and exposures of a sensor.

    One normal series runs over the columns, white or, where neighbours resemble each other, with power k^-exponent (k
    cycles over the frame; the DC term fades out toward exponent 1).

    Each column has its own amplifier and converter, whose offset stays; even and odd columns differ by `parity`, in a
    Bayer sensor pairs of columns.

    In dark frames: vertical streaks that stay when frames are averaged.

    Attributes:
        after_gain: whether it arises after the gain: equal in DN in all colours, and independent of the row gain.
            Its electrons are then DN divided by the mean gain of the pixels.

    Reference: EMVA Standard 1288, release 4.0, 2021 (DSNU of columns).
    """

    name: ClassVar[str] = "column_fixed_pattern"
    stage: ClassVar[Stage] = Stage.READ
    measurable: ClassVar[bool] = True
    sigma: Scalar = param("e-", low=0, amplitude=True, doc="standard deviation over columns")
    exponent: Scalar = param(
        "1", default=0.0, held=True, doc="power falls as frequency over columns to minus this; searches hold it"
    )
    parity: Scalar = param("e-", default=0.0, held=True, doc="odd columns less even ones; simulated fits hold it")
    after_gain: bool = eqx.field(static=True, default=False)

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        _, _, columns = signal.shape
        power = fading_power(columns, self.exponent)
        pattern = coloured_normal(capture.fixed_key(self.name), (1, columns, 1), power, signal.dtype).reshape(1, 1, -1)
        odd = jnp.asarray(capture.alternating(1), signal.dtype)[None, None]
        return signal + capture.offset(self.sigma * pattern + self.parity * odd, self.after_gain)

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker:
        # A fifth of the read noise, as of fixed rows: averaging frames brings it out.
        return lambda size, rng: cls(0.2 * size * facts.read_noise_e, after_gain=either_side(rng))

    def components(self, capture: Capture) -> dict[str, float]:
        return {"column": capture.offset_variance(self.sigma**2 + self.parity**2 / 4, self.after_gain)}
