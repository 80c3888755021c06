"""Unequal steps of the converter: differential nonlinearity (DNL)."""

from __future__ import annotations

from numbers import Real
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import param

MOST_CODES = 1 << 16  # of a converter
FEW_CODES = 32  # from 64 on XLA does not vectorise it
LARGEST = 1e6  # error of a pattern, which may have any unit
NARROWEST_DN = 1.2  # of noise over whose codes a pattern shows


def as_tuple(pattern):
    """The pattern as a tuple, which is what a setting can be; files hold lists, fits have arrays."""
    return tuple(np.asarray(pattern).tolist()) if isinstance(pattern, list | np.ndarray) else pattern


class AdcNonuniformity(AbstractEffect):
    """Code k of the converter is 1 + d_k DN wide, d a pattern of `period` codes, of rms sigma, that the sensor keeps.

    Converters work in two steps: coarse ones that are well trimmed, and a fine converter whose own errors come back in
    each of them. The period is the number of its codes: 2 for a ramp whose counter uses both edges of a clock, 4 to 32
    for the last stage of a pipeline or the low bits of a successive approximation. The errors of its steps are
    independent and normal, less their mean, since the coarse step is right, unless `pattern` says what they are; all
    pixels have the same. No code is narrower than 0. The mean error of the period is 0, so mean levels hardly change.

    In dark frames: a comb in the histogram of counts, at the same codes in all exposures, that leaves no code out; in
    captures of few codes nothing. A fit measures the pattern of this sensor, of periods that are powers of 2.

    Attributes:
        period: codes after which the pattern repeats, 2 to MOST_CODES.
        pattern: the errors of codes 0 to period - 1, in any unit, of which sigma is the rms; None draws them.

    References: IEEE Std 1241-2010 (differential nonlinearity; its test by histogram); Doernberg, Lee, and Hodges,
    "Full-speed testing of A/D converters", IEEE J. Solid-State Circuits 19, 1984.
    """

    name: ClassVar[str] = "adc_nonuniformity"
    stage: ClassVar[Stage] = Stage.CONVERSION
    sigma: Scalar = param("DN", low=0, amplitude=True, doc="rms error of the width of a code")
    period: int = eqx.field(static=True, default=2)
    pattern: tuple[float, ...] | None = eqx.field(static=True, default=None, converter=as_tuple)

    def __check_init__(self):
        whole = isinstance(self.period, int) and not isinstance(self.period, bool)
        if not whole or not 2 <= self.period <= MOST_CODES:
            expected = f"expected a whole number from 2 to {MOST_CODES}"
            raise ValueError(f"adc_nonuniformity.period: {expected}, got {self.period!r:.40}.")
        self._check_pattern()

    def _check_pattern(self) -> None:
        if self.pattern is None:
            return
        numbers = isinstance(self.pattern, tuple) and all(
            isinstance(x, Real) and not isinstance(x, bool) and abs(x) <= LARGEST for x in self.pattern
        )
        if not numbers or len(self.pattern) != self.period or np.ptp(self.pattern) < 1 / LARGEST:
            expected = f"expected {self.period} finite numbers (period) that differ"
            raise ValueError(f"adc_nonuniformity.pattern: {expected}, got {self.pattern!r:.60}.")

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        ends = jnp.cumsum(self._widths(capture, signal.dtype))
        above = signal + 0.5 + jnp.mean(ends - jnp.arange(1, self.period + 1))  # where code 0 begins
        within = jnp.mod(above, self.period)
        # Few codes are faster compared one by one than found by halves.
        method = "compare_all" if self.period <= FEW_CODES else "scan"
        code = jnp.round(above - within) + jnp.searchsorted(ends[:-1], within, side="right", method=method)
        # By so many codes it is read wrongly; what rounds and clips is the converter itself.
        return signal + (code - jnp.floor(signal + 0.5)).astype(signal.dtype)

    def _widths(self, capture: Capture, dtype: jnp.dtype) -> jax.Array:
        """Widths of the codes of one period on this sensor, of mean 1: [code], DN."""
        if self.pattern is None:
            steps = jax.random.normal(capture.fixed_key(self.name), (self.period,), dtype)
            errors = (steps - steps.mean()) * np.sqrt(self.period / (self.period - 1)).astype(dtype)
        else:
            known = np.asarray(self.pattern, float)
            errors = jnp.asarray((known - known.mean()) / known.std(), dtype)
        widths = jnp.maximum(1 + self.sigma * errors, 0)
        return widths / widths.mean()

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker | None:
        if np.hypot(facts.read_noise_e, np.sqrt(facts.signal_e)) * facts.gain.max() < NARROWEST_DN:
            return None
        if facts.comb is not None:
            return lambda size, rng: cls(size * facts.comb[0], len(facts.comb[1]), facts.comb[1])
        # A few per cent show in codes that hold thousands of pixels.
        return lambda size, rng: cls(0.04 * size, int(rng.choice([2, 4, 8, 16, 32])))
