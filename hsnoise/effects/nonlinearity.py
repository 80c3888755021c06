"""The response bends with signal."""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import param

LEVELS_OF_A_CURVE = 3  # a straight line goes through any two


class Nonlinearity(AbstractEffect):
    """A signal of x > 0 electrons reads x - curvature x^2.

    The capacitance of the sense node grows as it fills, and the source follower leaves its linear range. With positive
    curvature the response falls behind, and is constant beyond its maximum, x = 1 / (2 curvature). The effect acts
    before the gain, on the signal with its read noise.

    In dark frames: almost nothing, unless long exposures collect many electrons; flats show means that fall behind
    the light, and a photon transfer curve that bends.

    Reference: Janesick, *Photon Transfer*, SPIE 2007 (V/V and V/e- nonlinearity).
    """

    name: ClassVar[str] = "nonlinearity"
    stage: ClassVar[Stage] = Stage.READOUT
    curvature: Scalar = param("1/e-", amplitude=True, doc="relative loss of response for each electron of signal")

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        bends = self.curvature > 0
        summit = jnp.where(bends, 0.5 / jnp.where(bends, self.curvature, 1), jnp.inf)
        positive = jnp.clip(signal, 0, summit)
        return jnp.minimum(signal, summit) - self.curvature * positive**2

    def before(self, signal_e: np.ndarray) -> np.ndarray:
        """The electrons that read `signal_e`; beyond the summit, those of the summit."""
        a = float(self.curvature)
        root = np.sqrt(np.maximum(1 - 4 * a * np.maximum(signal_e, 0.0), 0.0))
        return np.where(signal_e > 0, 2 * signal_e / (1 + root), signal_e)

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker | None:
        if not facts.shows_signal or facts.levels < LEVELS_OF_A_CURVE:
            return None
        # A loss of 8 % at the brightest level, its noise included: the summit stays out of reach.
        return lambda size, rng: cls(0.08 * size / (facts.signal_e + 2 * facts.read_noise_e))
