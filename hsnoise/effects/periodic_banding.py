"""Interference: a sinusoid over rows or columns, its phase new in each frame."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from hsnoise._core.types import Frames, RandomKey, Scalar, cfa_tile
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker, either_side
from hsnoise.effects._parameters import param


class PeriodicBanding(AbstractEffect):
    """Offset amplitude * sin(2 pi frequency i + phase) of row (column) i, e-, with a uniform phase in each frame.

    A clock or a power supply couples into the readout; it is not synchronised with the frames. The variance is
    amplitude^2 / 2.

    In dark frames: bands that move from frame to frame, and one sharp spectral line of the row (column) means.
    `diagnose` takes the frequency from that line; a fit holds it and finds the amplitude.

    Attributes:
        axis: "row" for a sinusoid over rows (horizontal bands), "column" for one over columns.
        after_gain: whether it arises after the gain: equal in DN in all colours, and independent of the row gain.
            Its electrons are then DN divided by the mean gain of the pixels.

    Reference: Janesick, *Photon Transfer*, SPIE 2007 (pick-up noise).
    """

    name: ClassVar[str] = "periodic_banding"
    stage: ClassVar[Stage] = Stage.READ
    selection_nats: ClassVar[float] = 5.0  # its frequency is that of the highest of some hundred lines of the capture
    amplitude: Scalar = param("e-", low=0, amplitude=True, doc="amplitude of the sinusoid")
    frequency: Scalar = param("cycles/pixel", low=0, high=0.5, held=True, doc="cycles per row, or column; fits hold it")
    axis: str = eqx.field(static=True, default="row")
    after_gain: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        if self.axis not in ("row", "column"):
            raise ValueError(f"periodic_banding.axis: expected 'row' or 'column', got {self.axis!r}.")

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        frames, rows, columns = signal.shape
        shape = (1, rows, 1) if self.axis == "row" else (1, 1, columns)
        i = jnp.arange(max(shape), dtype=signal.dtype).reshape(shape)
        phase = jax.random.uniform(key, (frames, 1, 1), signal.dtype, maxval=2 * np.pi)
        wave = self.amplitude * jnp.sin(2 * np.pi * self.frequency * i + phase)
        return signal + capture.offset(wave, self.after_gain)

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker:
        # A third of the read noise on the strongest line of the capture: one line of the spectrum shows it.
        axis, frequency = facts.line
        return lambda size, rng: cls(0.3 * size * facts.read_noise_e, frequency, axis, either_side(rng))

    def components(self, capture: Capture) -> dict[str, float]:
        over_rows = self.axis == "row"
        lines, colours = capture.shape[0 if over_rows else 1], len(cfa_tile(capture.cfa))
        mean = np.exp(2j * np.pi * float(self.frequency) * np.arange(0, lines, colours)).mean()
        whole = capture.offset_variance(self.amplitude**2 / 2, self.after_gain)
        # As much of the sinusoid as the mean of a frame holds is no difference between its lines.
        between = (1 - abs(mean) ** 2) * whole / (1 - colours / lines)
        return {"row_x_frame" if over_rows else "column_x_frame": between, "frame": whole - between}
