"""Interference: a sinusoid over rows or columns, its phase new in each frame."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage, param


class PeriodicBanding(AbstractEffect):
    """Offset amplitude * sin(2 pi frequency i + phase) of row (column) i, e-, with a uniform phase in each frame.

    A clock or a power supply couples into the readout; its frequency keeps no step with the frames. Its variance is
    amplitude^2 / 2.

    In dark frames: bands that run from frame to frame, one sharp line in the spectrum of row (column) means. `diagnose`
    takes the frequency from there; a fit holds it and finds the amplitude.

    Attributes:
        axis: "row" for a sinusoid over rows (horizontal bands), "column" for one over columns.
        after_gain: whether it arises behind the gain: alike in DN in all colours, and free of the row gain. Its
            electrons are then DN over the mean gain of the pixels.

    Reference: Janesick, *Photon Transfer*, SPIE 2007 (pick-up noise).
    """

    name: ClassVar[str] = "periodic_banding"
    stage: ClassVar[Stage] = Stage.READ
    amplitude: Scalar = param("e-", low=0, doc="amplitude of the sinusoid")
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
