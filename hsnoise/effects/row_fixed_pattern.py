"""Fixed pattern of rows: an additive offset of each row, the same in all frames."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp

from hsnoise._core.coloured import coloured_normal, fading_power
from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker, either_side
from hsnoise.effects._parameters import param


class RowFixedPattern(AbstractEffect):
    """Offset of each row, e-, the same in all frames and exposures of a sensor.

    One normal series runs over the rows, white or, where neighbours resemble each other, with power k^-exponent (k
    cycles over the frame; the DC term fades out toward exponent 1).

    Each row has its own select and reset lines; where two banks of converters read even and odd rows, these differ by
    `parity`, in a Bayer sensor pairs of rows.

    In dark frames: horizontal streaks that stay when frames are averaged.

    Attributes:
        after_gain: whether it arises after the gain: equal in DN in all colours, and independent of the row gain.
            Its electrons are then DN divided by the mean gain of the pixels.

    Reference: EMVA Standard 1288, release 4.0, 2021 (DSNU of rows).
    """

    name: ClassVar[str] = "row_fixed_pattern"
    stage: ClassVar[Stage] = Stage.READ
    measurable: ClassVar[bool] = True
    sigma: Scalar = param("e-", low=0, amplitude=True, doc="standard deviation over rows")
    exponent: Scalar = param(
        "1", default=0.0, held=True, doc="power falls as frequency over rows to minus this; searches hold it"
    )
    parity: Scalar = param("e-", default=0.0, held=True, doc="odd rows less even ones; simulated fits hold it")
    after_gain: bool = eqx.field(static=True, default=False)

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        _, rows, _ = signal.shape
        power = fading_power(rows, self.exponent)
        pattern = coloured_normal(capture.fixed_key(self.name), (1, rows, 1), power, signal.dtype)
        odd = jnp.asarray(capture.alternating(0), signal.dtype)[None, :, None]
        return signal + capture.offset(self.sigma * pattern + self.parity * odd, self.after_gain)

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker:
        # A fifth of the read noise: it stays in all frames, so less of it shows than of row noise.
        return lambda size, rng: cls(0.2 * size * facts.read_noise_e, after_gain=either_side(rng))

    def components(self, capture: Capture) -> dict[str, float]:
        return {"row": capture.offset_variance(self.sigma**2 + self.parity**2 / 4, self.after_gain)}
