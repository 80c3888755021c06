"""Row noise of two banks of converters that take turns: even rows wander together, and so do odd rows."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax

from hsnoise._core.coloured import coloured_normal, power_of_banks
from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker, either_side
from hsnoise.effects._parameters import param


class RowBankNoise(AbstractEffect):
    """Offset of each row, e-, new in each frame, where even and odd rows are converted by banks of their own.

    Fast sensors read two rows at a time, even ones by converters above the pixels and odd ones by those below, or from
    two references. The offset of each bank wanders from one of its rows to its next, with power k^-exponent (k cycles
    per frame); a share of the variance, of the same exponent, is common to both. The sum is one stationary series over
    all sensor rows, the same for all colours of a row, whose spectrum rises at both ends: the banks' part is as strong
    at half a cycle per row as at 0. DC terms fade out toward an exponent of 1, as in `row_noise`, which it becomes if
    all is shared.

    In dark frames: horizontal streaks that change from frame to frame and look combed; a row resembles the next but one
    more than the next. In a Bayer sensor the two banks have different colours: rows of one colour resemble each other
    more than the rows between them.

    Attributes:
        after_gain: whether it arises after the gain: equal in DN in all colours, and independent of the row gain.
            Its electrons are then DN divided by the mean gain of the pixels.

    Reference: Kawahito, "Column-parallel ADCs for CMOS image sensors and their FoM-based evaluations", IEICE Trans.
    Electron. E101-C, 2018 (converters of columns); Janesick, *Photon Transfer*, SPIE 2007.
    """

    name: ClassVar[str] = "row_bank_noise"
    stage: ClassVar[Stage] = Stage.READ
    selection_nats: ClassVar[float] = 15.0  # any row noise is also one of banks: two numbers more, fitted to the rows
    sigma: Scalar = param("e-", low=0, amplitude=True, doc="standard deviation over rows")
    exponent: Scalar = param("1", default=1.0, doc="power falls as row frequency to minus this: 0 white, 1 is 1/f")
    shared: Scalar = param("1", low=0, high=1, default=0.0, doc="share of the variance that is common to both banks")
    after_gain: bool = eqx.field(static=True, default=False)

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        frames, rows, _ = signal.shape
        offset = self.sigma * coloured_normal(key, (frames, rows, 1), self._power(rows), signal.dtype)
        return signal + capture.offset(offset, self.after_gain)

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker:
        # A quarter of the read noise, as for other rows. White banks, or a common part alone, would be row noise.
        read = facts.read_noise_e
        return lambda size, rng: cls(
            0.25 * size * read, rng.uniform(0.7, 1.5), rng.uniform(0, 0.6), after_gain=either_side(rng)
        )

    def components(self, capture: Capture) -> dict[str, float]:
        variance = capture.offset_variance(self.sigma**2, self.after_gain)
        lines, whole = capture.spread_of_lines(0, self._power(capture.shape[0]))
        return {"row_x_frame": lines * variance, "frame": whole * variance}

    def _power(self, rows: int) -> jax.Array:
        """Spectrum [rows] of the series, of mean 1."""
        return power_of_banks(rows, self.exponent, self.shared)
