"""Electrons go to neighbours that have fewer of them."""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp

from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import param

LEAST_FILL_E = 1000  # 1 % of this a neighbour would be twenty times what is known of any sensor


class BrighterFatter(AbstractEffect):
    """Pixels that fill repel electrons: each pair of neighbours of x and y electrons moves strength (x^2 - y^2) / 2.

    The field of collected charge shifts the borders of pixels, in proportion to the charge on both sides: bright stars
    are fatter, and flats are less noisy than their electrons are. At a mean of n electrons a neighbour takes the share
    strength n of what a pixel has in excess; the variance of shot noise, and of the pixels' response, is multiplied by
    1 - 8 strength n, to first order, and neighbours share what is missing. Charge is conserved: none leaves the frame.

    In dark frames: almost nothing; flats show a photon transfer curve that bends while the mean follows the light, and
    noise of neighbours that is correlated the more, the brighter they are.

    Reference: Antilogus et al., "The brighter-fatter effect and pixel correlations in CCD sensors", JINST 9 C03048
    (2014); the four next neighbours alone, all alike.
    """

    name: ClassVar[str] = "brighter_fatter"
    stage: ClassVar[Stage] = Stage.COUPLING
    strength: Scalar = param(
        "1/e-", low=0, amplitude=True, doc="share of its excess that a pixel gives each neighbour, for each electron"
    )

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        square = jnp.pad(signal, ((0, 0), (1, 1), (1, 1)), mode="edge") ** 2
        down, across = jnp.diff(square[:, :, 1:-1], axis=1), jnp.diff(square[:, 1:-1], axis=2)
        return signal + self.strength / 2 * (jnp.diff(down, axis=1) + jnp.diff(across, axis=2))

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker | None:
        if facts.signal_e < LEAST_FILL_E or not (facts.may_share(1) and facts.may_share(1, axis=1)):
            return None
        # A neighbour takes 1 % at the brightest level, which is 8 % of the variance.
        return lambda size, rng: cls(0.01 * size / (facts.signal_e + 2 * facts.read_noise_e))
