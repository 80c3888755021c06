"""Random telegraph noise: a few pixels jump between two levels."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from scipy.special import gamma

from hsnoise._core.poisson import uniform_of_pixels
from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import param

DEPTH, SECOND = 1, 2  # what sets the random keys of amplitudes, and of the second sample, apart


class RandomTelegraphNoise(AbstractEffect):
    """A fraction of the pixels, the same in all frames, reads up to `amplitude` more electrons in its high state.

    A trap in the oxide of the pixel's source follower catches and frees a single carrier. Every pixel has a trap with
    probability `fraction`; its state is new in each frame (traps are faster than the frame rate) and high with
    probability `duty`. The low level is the pixel's ordinary level, so its mean rises by amplitude * duty.

    Traps lie at different depths: with `spread`, amplitudes of pixels are Weibull distributed, amplitude * E^spread /
    Gamma(1 + spread), E exponential. At 0 they are all alike, at 1 exponential, as in most sensors; `amplitude` is
    their mean.

    Most CMOS sensors subtract two samples of each pixel, before and after the charge is moved (correlated double
    sampling). The trap may have changed in between, in either direction: three levels, and a mean that stays.

    In dark frames: histograms of single pixels over time have two peaks, or three; the distribution over pixels of the
    variance over time has a long tail, the same in all exposures.

    Attributes:
        double_sampling: whether each count is the difference of two samples with independent states of the trap.

    References: Wang, Rao, Mierop, Theuwissen, "Random telegraph signal in CMOS image sensor pixels", IEDM 2006; Chao et
    al., "Statistical analysis of the random telegraph noise in a 1.1 um pixel, 8.3 MP CMOS image sensor using on-chip
    time constant extraction method", Sensors 17, 2017 (exponential amplitudes, three levels).
    """

    name: ClassVar[str] = "random_telegraph_noise"
    stage: ClassVar[Stage] = Stage.READ
    measurable: ClassVar[bool] = True
    fraction: Scalar = param("1", low=0, high=1, doc="fraction of pixels that jump")
    amplitude: Scalar = param("e-", low=0, amplitude=True, doc="mean distance of the two levels")
    duty: Scalar = param("1", low=0, high=1, default=0.5, doc="probability of the high level")
    spread: Scalar = param(
        "1", low=0, high=2, default=0.0, held="at bounds", doc="of amplitudes over pixels: 0 alike, 1 exponential"
    )
    double_sampling: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        if self.double_sampling not in (True, False):
            raise ValueError(
                f"random_telegraph_noise.double_sampling: expected True or False, got {self.double_sampling!r}."
            )

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        fixed, shape = capture.fixed_key(self.name), (1, *signal.shape[1:])
        where = jax.random.uniform(fixed, shape, signal.dtype)
        depth = jax.random.exponential(jax.random.fold_in(fixed, DEPTH), shape, signal.dtype)
        depth = jnp.maximum(depth, jnp.finfo(signal.dtype).tiny)  # the slope of 0^spread is infinite
        jump = self.amplitude * depth**self.spread / jnp.exp(jax.scipy.special.gammaln(1 + self.spread))
        change = self._is_high(key, signal)
        if self.double_sampling:
            change = change - self._is_high(jax.random.fold_in(key, SECOND), signal)
        return signal + jnp.where(where < self.fraction, jump * change, 0)

    def _is_high(self, key: RandomKey, signal: Frames) -> Frames:
        return (uniform_of_pixels(key, signal.shape, signal.dtype) <= self.duty).astype(signal.dtype)

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker:
        # Two pixels in a hundred, with jumps beyond the read noise: smaller ones show no two peaks.
        read = facts.read_noise_e
        return lambda size, rng: cls(0.02 * size, rng.uniform(2.5, 6.0) * read, rng.uniform(0.15, 0.85))

    def components(self, capture: Capture) -> dict[str, float]:
        fraction, duty, spread = float(self.fraction), float(self.duty), float(self.spread)
        together = float(gamma(1 + 2 * spread) / gamma(1 + spread) ** 2)  # mean square over squared mean
        one = capture.offset_variance(self.amplitude**2)
        temporal = fraction * together * duty * (1 - duty) * one
        if self.double_sampling:
            return {"temporal": 2 * temporal}
        return {"pixel": fraction * (together - fraction) * duty**2 * one, "temporal": temporal}
