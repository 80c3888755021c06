"""Interference: a sinusoid across the frame, along rows and columns at once, its phase new in each frame."""

from __future__ import annotations

from numbers import Real
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from hsnoise._core.types import Frames, RandomKey, Scalar, cfa_tile
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker, either_side
from hsnoise.effects._parameters import param

MOST_OTHERS, LARGEST = 256, 1e6


def as_tuples(others):
    """Waves as a setting can hold them; files have lists."""
    others = others.tolist() if isinstance(others, np.ndarray) else others
    if not isinstance(others, list | tuple):
        return others
    return tuple(tuple(one) if isinstance(one, list) else one for one in others)


class Interference(AbstractEffect):
    """Offset amplitude * sin(2 pi (row_frequency i + column_frequency j) + phase) of row i and column j, e-.

    A clock or a supply that swings faster than rows are read couples into the pixels: what it is at the start of each
    row decides how the stripes lean. Its phase is uniform in each frame. The variance is amplitude^2 / 2.

    In dark frames: oblique stripes, a herringbone or a chequerboard that move from frame to frame. Waves along rows or
    columns alone are `periodic_banding`. A fit takes the frequencies from the strongest waves, and holds them.

    Attributes:
        others: further waves, such as a clock's harmonics: amplitude over that of the first, cycles per row and cycles
            per column of each. Their phases are new in each frame, too.
        after_gain: whether it arises after the gain: equal in DN in all colours, and independent of the row gain.
            Its electrons are then DN divided by the mean gain of the pixels.

    Reference: Janesick, *Photon Transfer*, SPIE 2007 (pick-up noise); EMVA Standard 1288, release 4.0, 2021
    (spectrograms).
    """

    name: ClassVar[str] = "interference"
    stage: ClassVar[Stage] = Stage.READ
    selection_nats: ClassVar[float] = 5.0  # its frequencies are those of the highest of all waves of the capture
    amplitude: Scalar = param("e-", low=0, amplitude=True, doc="amplitude of the sinusoid")
    row_frequency: Scalar = param("cycles/pixel", low=-0.5, high=0.5, held=True, doc="cycles per row; fits hold it")
    column_frequency: Scalar = param("cycles/pixel", low=0, high=0.5, held=True, doc="cycles per column; fits hold it")
    after_gain: bool = eqx.field(static=True, default=False)
    others: tuple[tuple[float, float, float], ...] = eqx.field(static=True, default=(), converter=as_tuples)

    def __check_init__(self):
        for other in self.others if isinstance(self.others, tuple) else (self.others,):
            numbers = isinstance(other, tuple) and len(other) == 3
            numbers = numbers and all(isinstance(x, Real) and not isinstance(x, bool) for x in other)
            if not numbers or not (0 <= other[0] <= LARGEST and abs(other[1]) <= 0.5 and 0 <= other[2] <= 0.5):
                expected = "expected for each its amplitude over the first, cycles per row and per column within 0.5"
                raise ValueError(f"interference.others: {expected}, got {other!r:.60}.")
        if len(self.others) > MOST_OTHERS:
            raise ValueError(f"interference.others: expected at most {MOST_OTHERS} waves, got {len(self.others)}.")

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        frames, rows, columns = signal.shape
        # Turns of each line are folded first: thousands of turns have no digits for a phase in single precision.
        down = jnp.arange(rows, dtype=signal.dtype)[None, :, None] * self.row_frequency % 1
        across = jnp.arange(columns, dtype=signal.dtype)[None, None] * self.column_frequency % 1
        phase = jax.random.uniform(key, (frames, 1, 1), signal.dtype)
        wave = self.amplitude * jnp.sin(2 * np.pi * (down + across + phase))
        if self.others:
            wave = wave + self.amplitude * self._others(signal, key)
        return signal + capture.offset(wave, self.after_gain)

    def _others(self, signal: Frames, key: RandomKey) -> Frames:
        """The further waves, over the amplitude of the first: sums over waves of products of a row and a column."""
        frames, rows, columns = signal.shape
        size, of_row, of_column = jnp.asarray(self.others, signal.dtype).T
        phase = jax.random.uniform(jax.random.fold_in(key, 1), (frames, 1, len(self.others)), signal.dtype)
        down = 2 * np.pi * (jnp.arange(rows, dtype=signal.dtype)[None, :, None] * of_row[None, None] % 1 + phase)
        across = 2 * np.pi * (jnp.arange(columns, dtype=signal.dtype)[None, :] * of_column[:, None] % 1)
        parts = jnp.concatenate([size[None, None] * jnp.sin(down), size[None, None] * jnp.cos(down)], -1)
        turned = jnp.concatenate([jnp.cos(across), jnp.sin(across)], 0)
        return jnp.matmul(parts, turned, precision=jax.lax.Precision.HIGHEST)

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker | None:
        if not facts.waves:
            return None
        (_, row, column), *others = facts.waves
        # A tenth of the read noise: one point of the spectrum of two directions shows it.
        return lambda size, rng: cls(0.1 * size * facts.read_noise_e, row, column, either_side(rng), tuple(others))

    def components(self, capture: Capture) -> dict[str, float]:
        waves = ((1.0, float(self.row_frequency), float(self.column_frequency)), *self.others)
        parts = [self._components(capture, *wave) for wave in waves]
        return {name: sum(part[name] for part in parts) for name in parts[0]}

    def _components(
        self, capture: Capture, size: float, row_frequency: float, column_frequency: float
    ) -> dict[str, float]:
        step = len(cfa_tile(capture.cfa))
        whole = capture.offset_variance((size * self.amplitude) ** 2 / 2, self.after_gain)
        # In pixels of one colour a wave may turn slowly along an axis: shares of it in the means of lines and frames.
        rows, columns = (n // step for n in capture.shape)
        down = _in_mean(rows, step * row_frequency)
        across = _in_mean(columns, step * column_frequency)
        temporal = whole * (1 - down) * (1 - across) * rows * columns / ((rows - 1) * (columns - 1))
        of_rows = whole * (1 - down) * across * rows / (rows - 1) - temporal / columns
        of_columns = whole * down * (1 - across) * columns / (columns - 1) - temporal / rows
        frame = whole * down * across - of_rows / rows - of_columns / columns - temporal / (rows * columns)
        return {"frame": frame, "row_x_frame": of_rows, "column_x_frame": of_columns, "temporal": temporal}


def _in_mean(lines: int, frequency: float) -> float:
    """The share of the power of a sinusoid that is in its mean over so many lines."""
    return float(abs(np.exp(2j * np.pi * frequency * np.arange(lines)).mean()) ** 2)
