"""Signal shared between neighbouring pixels."""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp

from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import param


class Crosstalk(AbstractEffect):
    """Each of the four neighbours of a pixel gets `fraction` of its electrons: (1 - 4 f) x + f (sum of neighbours).

    Capacitance between the sense nodes couples pixels after their charge was collected, so shot noise is shared, too:
    its variance is multiplied by (1 - 4 f)^2 + 4 f^2. (Electrons that diffuse before they are collected remain
    independent Poisson counts: a blur of the light, invisible in dark frames.) Charge is conserved: the share that
    would leave the frame stays in the pixel. In a Bayer sensor neighbours have other colours.

    In dark frames: the noise of the four neighbours is correlated, in proportion to the shot noise, while the mean
    does not change: the slope of the photon transfer line is less than the gain.

    Reference: Moore, Ninkov, Forrest, "Quantum efficiency overestimation and deterministic cross talk resulting from
    interpixel capacitance", Opt. Eng. 45, 2006.
    """

    name: ClassVar[str] = "crosstalk"
    stage: ClassVar[Stage] = Stage.COUPLING
    fraction: Scalar = param(
        "1", low=0, high=0.25, amplitude=True, doc="part of a pixel's electrons that each neighbour gets"
    )

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        padded = jnp.pad(signal, ((0, 0), (1, 1), (1, 1)), mode="edge")
        inside = slice(1, -1)
        above, below = padded[:, :-2, inside], padded[:, 2:, inside]
        left, right = padded[:, inside, :-2], padded[:, inside, 2:]
        return signal + self.fraction * (above + below + left + right - 4 * signal)

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker | None:
        if not (facts.may_share(1) and facts.may_share(1, axis=1)):
            return None
        # Four neighbours get it, and correlations are measured to some thousandths. A fifth is a mean over all five.
        return lambda size, rng: cls(min(0.015 * size, 0.2))
